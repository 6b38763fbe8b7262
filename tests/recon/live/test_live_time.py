"""Live pictures in the time allowed: iterations that fit, coarser pixels or the filter where few do."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

from recon.streams.live_picture import Level, LivePicture
from recon.streams.pace import Pace, Spent
from recon.streams.stillness import SceneState
from recon.streams.video import VideoSolver
from tests.recon.live.streams import AMPLE_MS, iterated, live, photograph, taking


def test_a_frame_gets_the_iterations_that_its_time_allows() -> None:
    reconstructor = live(budget_ms=AMPLE_MS, average=1)
    iterated(reconstructor, photograph(0, 1))
    taking(reconstructor, 1.0, AMPLE_MS / 20)
    began = time.monotonic()
    moved = [reconstructor.feed(photograph(0.7 * k, k)) for k in (1, 2)]
    assert moved[-1].iterations > 5, [str(picture.scene) for picture in moved]
    assert 0 < sum(picture.work_ms for picture in moved) <= 1e3 * (time.monotonic() - began)


def test_quality_gives_way_not_time() -> None:
    reconstructor = live(coarsest=8, budget_ms=100.0)
    assert iterated(reconstructor, photograph(0, 0)).binning == 1
    # Room for one iteration and a half: too few, so the pixels get coarser, after a few frames.
    fed = 0
    while reconstructor._coming is None:
        taking(reconstructor, fixed_ms=10, step_ms=60)
        assert reconstructor.feed(photograph(0.5 * (fed % 2), fed)).binning == 1
        fed += 1
    assert fed == 3
    reconstructor._coming.wait()
    assert reconstructor._level is not None
    finer = reconstructor._level.solver
    coarse = reconstructor.feed(photograph(0, 0))
    assert finer is not None
    assert finer.solvers == [None], "its memory is given up"
    assert (coarse.binning, coarse.method) == (2, "admm-sensor")
    assert coarse.image.shape == (32, 48)
    assert "binned 2 x 2" in coarse.quality
    # Room for nothing: the Wiener filter.
    taking(reconstructor, fixed_ms=90, step_ms=60)
    rough = reconstructor.feed(photograph(3, 1))
    assert (rough.method, rough.iterations) == ("wiener", 0)
    assert "Wiener filter" in rough.quality


def test_no_pixels_are_given_up_where_they_are_not_what_costs_time() -> None:
    reconstructor = live(coarsest=8, budget_ms=100.0)
    iterated(reconstructor, photograph(0, 0))
    waiting = Spent(90.0, 1.0)
    for n in range(12):
        for _ in range(7):
            reconstructor._pace.note(waiting, waiting, 1)
        picture = reconstructor.feed(photograph(3.0 * n, n))
    assert reconstructor._coming is None
    assert (picture.binning, picture.method) == (1, "wiener")


def test_refining_ends_when_a_newer_frame_is_there() -> None:
    reconstructor = live()
    iterated(reconstructor, photograph(0, 0))
    reconstructor._settled = False
    refined = reconstructor.refine(lambda: True)
    assert refined is not None
    assert refined.iterations == 1


@pytest.fixture
def _clocked(monkeypatch: pytest.MonkeyPatch) -> None:
    """An iteration takes 10 ms, 8 of them work, a picture of it 5 and 4, a filter's 2 and 1."""
    now_ms = [1e6, 1e5]
    clock = SimpleNamespace(perf_counter=lambda: now_ms[0] / 1e3, thread_time=lambda: now_ms[1] / 1e3)
    monkeypatch.setattr("recon.streams.live.time", clock)

    def takes(wall_ms: float, work_ms: float, owner: type, name: str) -> None:
        of_itself = getattr(owner, name)

        def call(*args: Any) -> Any:
            now_ms[0] += wall_ms
            now_ms[1] += work_ms
            result = of_itself(*args)
            return False if name == "advance" else result  # never settled

        monkeypatch.setattr(owner, name, call)

    takes(10, 8, VideoSolver, "advance")
    takes(5, 4, VideoSolver, "volume")
    takes(2, 1, Level, "filtered")


@pytest.mark.usefixtures("_clocked")
def test_iterations_are_those_that_fit_into_the_budget() -> None:
    reconstructor = live(budget_ms=100.0, average=1)
    first = reconstructor.feed(photograph(0, 0))
    assert (first.method, first.iterations, first.total_iterations) == ("wiener", 0, 0)
    assert first.work_ms == pytest.approx(2)
    assert first.volume is None
    refined = reconstructor.refine()
    assert refined is not None
    assert (refined.iterations, refined.total_iterations) == (11, 11), "what one takes was not known"
    assert (first.shown, refined.shown) == ("", "")
    assert refined.work_ms == pytest.approx(115)
    assert refined.volume is None
    total, frames = 11, iter(range(1, 99))

    def moved(budget_ms: float) -> LivePicture:
        reconstructor.budget_ms = budget_ms
        n = next(frames)
        picture = reconstructor.feed(photograph(0.7 * n, n))
        assert picture.scene is SceneState.MOVING
        return picture

    for budget_ms, iterations in ((100.0, 2), (104.0, 9), (95.0, 9), (94.0, 8), (25.0, 2), (24.0, 1)):
        picture = moved(budget_ms)
        total += iterations
        assert (picture.method, picture.iterations) == ("admm-sensor", iterations)
        assert picture.total_iterations == total, "each goes on from the one before"
        assert picture.work_ms == pytest.approx(10 * iterations + 5)
        cost = reconstructor._pace.cost(1)
        assert cost is not None
        took = (cost.fixed.wall_ms, cost.fixed.work_ms, cost.step.wall_ms, cost.step.work_ms)
        assert took == pytest.approx((5, 4, 10, 8))
    for budget_ms, iterations in ((94.0, 9), (92.6, 9), (92.4, 8), (91.5, 8), (82.6, 8), (10.0, 1)):
        reconstructor.budget_ms = budget_ms
        refined = reconstructor.refine()
        assert refined is not None
        assert refined.iterations == iterations, "the next one and half of a picture must fit as well"
    rough = moved(14.0)
    assert (rough.method, rough.iterations, rough.total_iterations) == ("wiener", 0, 0)
    assert rough.work_ms == pytest.approx(2)
    reconstructor.budget_ms = 100.0
    anew = reconstructor.refine()
    assert anew is not None
    assert anew.total_iterations == anew.iterations


@pytest.mark.parametrize(
    ("at_once", "binning"), [(700, 3), (800, 3), (1535, 3), (1536, 2), (6144, 1), (90, 4)]
)
def test_the_first_picture_is_the_finest_that_takes_no_time_to_speak_of(
    at_once: int, binning: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recon.streams.live.AT_ONCE", at_once)
    reconstructor = live(coarsest=8)
    assert reconstructor._pace.levels == (1, 2, 3, 4), "below 16 pixels no binning goes"
    assert reconstructor._first_detail().binning == binning


def test_the_filter_s_time_is_noted_where_frames_come_too_fast_only(monkeypatch: pytest.MonkeyPatch) -> None:
    affordable = [5.0]
    monkeypatch.setattr(Pace, "affordable", lambda *_: affordable[-1])
    reconstructor = live(average=1)
    iterated(reconstructor, photograph(0, 0))
    noted: list[float] = []
    monkeypatch.setattr(Pace, "note_filter", lambda _, took: noted.append(took.wall_ms))
    assert reconstructor.feed(photograph(0, 2)[:, ::-1]).method == "wiener"
    assert noted == [], "another scene"
    began_s = time.perf_counter()
    reconstructor.feed(photograph(0, 3)[:, ::-1])
    affordable.append(0.5)
    fast = reconstructor.feed(photograph(0.7, 4)[:, ::-1])
    assert (fast.scene, fast.method) == (SceneState.MOVING, "wiener")
    assert len(noted) == 1
    assert 0 < noted[0] < 1e3 * (time.perf_counter() - began_s)
