"""What becomes of a frame that is fed: a black picture, a filter's or an iterated one, and what is noted."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import Calibration
from recon.streams import live as live_module
from recon.streams.live import LiveReconstructor
from recon.streams.pace import Spent
from recon.streams.stillness import SceneState
from tests.recon.live.streams import NOISE, SHAPE, live, spots_psf

NEW, MOVING, STILL = SceneState
MEAN = np.random.default_rng(0).random((1, *SHAPE)).astype(np.float32)


@dataclass
class Fed:
    """What was asked of solver and filter for a frame, what was noted, and which picture was made."""

    told: list[str] = field(default_factory=list)
    took: list[Any] = field(default_factory=list)
    at_most: list[int] = field(default_factory=list)
    done: int | None = 99
    follows: bool = False
    settled: bool = False
    greeted: bool = False


@dataclass(frozen=True)
class State:
    """Of a reconstructor, when a frame comes."""

    affordable: float = 5.0
    lit: bool = True
    greeted: bool = False
    follows: bool = True
    solver: bool = True
    sees: bool = True
    doubt: str = ""
    known: bool = True
    coming: Any = None


@pytest.fixture(name="fed")
def _fed(monkeypatch: pytest.MonkeyPatch) -> Any:
    def feed(scene: SceneState, **state: Any) -> Fed:
        """Feed a frame to a reconstructor in that state; the clock goes on by 10 ms a look."""
        fed, reconstructor, given = Fed(), live(budget_ms=50.0), State(**state)
        clock = iter(range(0, 10_000, 10))
        monkeypatch.setattr(live_module, "_now", lambda: Spent(float(next(clock)), 0.0))

        def take(mean: Any) -> None:
            fed.told.append("takes")
            np.testing.assert_array_equal(mean, MEAN[0])

        def filtered(mean: Any) -> Any:
            fed.told.append("filters")
            np.testing.assert_array_equal(mean, MEAN[0])
            return np.ones((1, *SHAPE), np.float32)

        def iterate(_level: object, _began: object, at_most: int, newer: Any) -> tuple[int, Spent]:
            assert not newer()
            fed.at_most.append(at_most)
            return 3, Spent(1.0, 0.0)

        def picture(_level: object, volume: Any, done: int | None, began: Spent) -> Any:
            assert began == Spent(0.0, 0.0)
            assert volume is level.solved() or volume.shape == (1, *SHAPE)
            assert done is not None or not volume.any()
            fed.done = done
            return SimpleNamespace()

        volume = np.zeros((1, *SHAPE))
        owner = SimpleNamespace(begin=lambda: fed.told.append("begins"), take=take) if given.solver else None
        level: Any = SimpleNamespace(
            binning=1,
            detail=SimpleNamespace(coarseness=2),
            solver=owner,
            filtered=filtered,
            solved=lambda: volume,
        )
        reconstructor._watch = SimpleNamespace(see=lambda _: scene, mean=MEAN)  # type: ignore[assignment]
        reconstructor._fit = SimpleNamespace(  # type: ignore[assignment]
            doubt=given.doubt, is_known=given.known, in_another_light=lambda: fed.told.append("another light")
        )
        reconstructor._pace = SimpleNamespace(  # type: ignore[assignment]
            affordable=lambda *asked: given.affordable if asked == (2, 50) else -1,
            note_filter=lambda spent: fed.took.append(spent.wall_ms),
            note=lambda fixed, steps, done: fed.took.append((fixed.wall_ms, steps.wall_ms, done)),
        )
        monkeypatch.setattr(reconstructor, "_level_for", lambda _: level)
        monkeypatch.setattr(reconstructor, "_sees_light", lambda *_: given.sees)
        monkeypatch.setattr(reconstructor, "_iterate", iterate)
        monkeypatch.setattr(reconstructor, "_picture", picture)
        reconstructor._greeted, reconstructor._follows = given.greeted, given.follows
        reconstructor._coming = given.coming
        reconstructor.feed(np.zeros(SHAPE, np.float32), lit=given.lit)
        fed.follows, fed.settled = reconstructor._follows, reconstructor._settled
        fed.greeted = reconstructor._greeted
        assert reconstructor._dark is not given.sees
        return fed

    return feed


@pytest.mark.parametrize(
    ("scene", "state", "begins"),
    [
        (STILL, {}, False),
        (MOVING, {}, False),
        (STILL, {"follows": False}, True),
        (NEW, {"greeted": True}, True),
        (STILL, {"affordable": 0.5}, False),  # slow, but nothing is missed
        (MOVING, {"affordable": 1.0}, False),
        (STILL, {"sees": False, "doubt": "why"}, False),  # lit: a dim point, perhaps
        (STILL, {"lit": False}, False),
    ],
)
def test_a_scene_that_is_known_is_iterated(
    fed: Any, scene: SceneState, state: dict[str, Any], *, begins: bool
) -> None:
    found = fed(scene, **state)
    told = ["another light"] * (state.get("lit") is False) + ["begins"] * begins + ["takes"]
    assert (found.told, found.done, found.follows) == (told, 3, True)
    assert found.at_most == [max(state.get("affordable", 5.0), 1)]
    assert found.took == ([] if begins else [(9.0, 1.0, 3)])
    assert found.greeted is (scene is NEW)


def test_a_picture_beside_which_another_level_is_made_says_nothing_of_those_to_come(fed: Any) -> None:
    assert fed(STILL, coming="another").took == []


@pytest.mark.parametrize(
    ("scene", "state", "noted"),
    [
        (NEW, {}, []),
        (MOVING, {"affordable": 0.9}, [10.0]),
        (NEW, {"affordable": 0.9, "greeted": True}, [10.0]),
        (STILL, {"solver": False}, []),
    ],
)
def test_a_cut_or_a_frame_too_many_is_shown_by_the_filter(
    fed: Any, scene: SceneState, state: dict[str, Any], noted: list[float]
) -> None:
    found = fed(scene, **state)
    assert (found.told, found.done, found.took) == (["filters"], 0, noted)
    assert (found.follows, found.settled) == (False, False)
    assert found.greeted is (scene is NEW)


@pytest.mark.parametrize("state", [{"sees": False}, {"doubt": "why"}, {"known": False}])
def test_where_nothing_is_lit_and_nothing_is_known_to_be_there_the_picture_is_black(
    fed: Any, state: dict[str, Any]
) -> None:
    found = fed(STILL, lit=False, **state)
    assert (found.told, found.done, found.took) == (["another light"], None, [])
    assert (found.follows, found.settled) == (False, True)


@pytest.mark.parametrize(
    ("known", "at_most", "newer_after", "settles_after", "done"),
    [
        (False, None, 99, 99, 6),  # the first after 50 ms
        (True, None, 99, 99, 3),  # with one more, and half of a picture, it would be 52
        (True, 2, 99, 99, 2),
        (True, None, 1, 99, 1),
        (True, None, 99, 2, 2),
    ],
)
@pytest.mark.parametrize("confirmed", [True, False])
def test_iterations_end_with_the_budget_a_newer_frame_or_nothing_more_to_gain(
    known: bool,
    at_most: int | None,
    newer_after: int,
    settles_after: int,
    done: int,
    confirmed: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reconstructor, now_ms = live(budget_ms=50.0), [100.0]
    monkeypatch.setattr(live_module, "_now", lambda: Spent(now_ms[0], 0.0))

    def advance(tolerance: float) -> bool:
        assert tolerance == 0.5
        now_ms[0] += 10
        return now_ms[0] == 100 + 10 * settles_after

    level: Any = SimpleNamespace(
        detail=SimpleNamespace(coarseness=2),
        tolerance=0.5,
        solver=SimpleNamespace(advance=advance, confirm=lambda: confirmed),
    )
    cost = SimpleNamespace(step=Spent(10.0, 0.0), fixed=Spent(24.0, 0.0)) if known else None
    reconstructor._pace = SimpleNamespace(cost={2: cost}.__getitem__)  # type: ignore[assignment]
    newer = lambda: now_ms[0] == 100 + 10 * newer_after  # noqa: E731
    found = reconstructor._iterate(level, Spent(100.0, 0.0), at_most, newer)
    assert found == (done, Spent(10.0 * done, 0.0))
    assert reconstructor._settled is (confirmed and done == settles_after)


def test_the_clock_is_told_in_milliseconds_with_the_processor_time_of_this_thread() -> None:
    before = time.perf_counter(), time.thread_time()
    now = live_module._now()
    after = time.perf_counter(), time.thread_time()
    assert 1e3 * before[0] <= now.wall_ms <= 1e3 * after[0]
    assert 1e3 * before[1] <= now.work_ms <= 1e3 * after[1]


@dataclass(frozen=True)
class Noticing:
    """A level, and whether it sees light."""

    sees: bool
    lit: bool
    detail: str = "these pixels"
    binning: int = 1
    whole: Any = None

    def sees_light(self, mean: Any, count: int) -> bool:
        np.testing.assert_array_equal(mean, MEAN[0])
        assert count == 7
        return self.sees


@pytest.mark.parametrize(
    ("level", "coming", "made"),
    [
        (Noticing(sees=False, lit=False), None, []),
        (Noticing(sees=True, lit=True), None, []),
        (Noticing(sees=True, lit=False), "another", []),
        (Noticing(sees=True, lit=False), None, ["these pixels"]),
    ],
)
def test_what_was_made_in_the_dark_is_made_anew_once_there_is_light(
    level: Noticing, coming: Any, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    reconstructor, told, seen = live(), list[str](), list[Any]()
    reconstructor._shape = SHAPE
    monkeypatch.setattr(reconstructor, "_make", lambda detail, _: told.append(detail))
    reconstructor._watch = SimpleNamespace(mean=MEAN, count=7)  # type: ignore[assignment]
    reconstructor._fit = SimpleNamespace(advice="look", see=lambda _, *of: seen.append(of))  # type: ignore[assignment]
    reconstructor._level, reconstructor._coming, before = level, coming, reconstructor.warnings  # type: ignore[assignment]
    for _ in range(2):
        given: Any = reconstructor._level
        assert reconstructor._sees_light(given, MEAN) is level.sees
    assert told == made
    assert reconstructor._level == (Noticing(sees=True, lit=True) if made else level)
    assert seen == [(1, reconstructor._scene, 7)] * 2 * level.sees
    assert reconstructor.warnings == (*before, *["look"] * level.sees)


def test_of_all_depths_together_none_is_said_to_fit() -> None:
    psfs = np.stack([spots_psf((32, 40), n) for n in (5, 8)])[:, None]
    calibration = Calibration(psfs, np.array([[0.0, 0.0, 1e4], [0.0, 0.0, 2e4]]))
    together = LiveReconstructor(calibration, noise=NOISE, coarsest=1)
    assert together.fitting_depth_um(np.zeros((32, 40), np.float32)) is None


@pytest.mark.parametrize(
    ("finest", "coarsest", "binnings"),
    [(1, 8, {1, 2, 3, 4}), (1, 2, {1, 2}), (2, 8, {2, 3, 4}), (6, 8, {6})],
)
def test_no_binning_leaves_less_than_sixteen_pixels_but_the_finest(
    finest: int, coarsest: int, binnings: set[int]
) -> None:
    assert SHAPE == (64, 96)
    found = live(finest=finest, coarsest=coarsest)._details.values()
    assert {detail.binning for detail in found} == binnings
