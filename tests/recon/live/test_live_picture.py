"""What a live picture is worth, in words, and what makes pictures at one resolution."""

from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import InputError, Measurement
from recon.evaluation.scene import make_scene
from recon.streams import live_picture
from recon.streams.detail import Detail
from recon.streams.live_picture import SETTLED, ComingLevel, Level, LiveOptions, LivePicture
from recon.streams.stillness import SceneState
from recon.streams.video import VideoSolver, stream_problem

PICTURE = LivePicture(
    np.zeros((2, 2), np.float32),
    1,
    "admm",
    1,
    7,
    SceneState.MOVING,
    1,
    settled=False,
    work_ms=1.0,
    budget_ms=2.0,
)


@pytest.mark.parametrize(
    ("model", "smooth", "erased", "filtered", "varies", "words"),
    [
        ("convolution", False, 0, False, False, ""),
        ("local", True, 0, False, True, "local model, background"),
        ("lowrank", False, 3, False, True, "low rank, 25.0% of the pixels left out"),
        ("convolution", False, 0, False, True, "one PSF for all of the field"),
        ("own", False, 0, False, True, "own"),
        ("local", True, 3, True, False, ""),  # the filter knows nothing of these
        ("local", True, 3, True, True, "one PSF for all of the field"),
    ],
)
def test_the_camera_that_made_a_picture_is_told_where_it_is_no_plain_one(
    model: str, smooth: bool, erased: int, filtered: bool, varies: bool, words: str
) -> None:
    def of(model: str, *, smooth: bool, erased: int) -> SimpleNamespace:
        return SimpleNamespace(model=model, smooth=smooth, valid=np.arange(12) >= erased)

    preview = SimpleNamespace(problem=of("convolution", smooth=False, erased=0))
    level: Any = SimpleNamespace(problem=of(model, smooth=smooth, erased=erased), preview=preview)
    assert Level.camera(level, filtered=filtered, varies=varies) == words


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({}, "all pixels, 1 iteration (7 in all), moving"),
        ({"iterations": 2, "binning": 2}, "binned 2 x 2, 2 iterations (7 in all), moving"),
        (
            {"scene": SceneState.STILL, "frames": 2, "settled": True},
            "all pixels, 1 iteration (7 in all), still, 2 frames averaged, settled",
        ),
        (
            {"method": "wiener", "shown": "depth 1 of 2 depths"},
            "all pixels, depth 1 of 2 depths, Wiener filter, moving",
        ),
        ({"doubt": "Noise"}, "Noise: all pixels, 1 iteration (7 in all), moving"),
        ({"doubt": "Dark", "method": ""}, "Dark"),
    ],
)
def test_what_a_picture_is_worth_is_said_in_words(facts: dict[str, Any], words: str) -> None:
    assert replace(PICTURE, **facts).quality == words


def test_binnings_that_exclude_each_other_are_refused_and_a_single_one_is_not() -> None:
    assert LiveOptions(finest=3, coarsest=3).coarsest == 3
    with pytest.raises(InputError, match="got finest 4, coarsest 3"):
        LiveOptions(finest=4, coarsest=3)
    with pytest.raises(InputError, match="average"):
        LiveOptions(average=0)


def level(depths: int = 1, binning: int = 1, channels: int = 1, **options: Any) -> Level:
    """Return a level of a small scene, at all its depths; the filter is for the last."""
    scene = make_scene("beads", size=24, depths=depths, channels=channels, density=0.5, photons=3000.0)
    asked = {"prior": "l1", "model": "convolution", "estimate_background": False, "noise": 2.0}
    problem = stream_problem(scene.measurement, scene.calibration, **{**asked, **options})
    return Level.of(problem, Detail(binning, tuple(range(depths))), problem, depths - 1)


@pytest.mark.parametrize("depths", [1, 2])
def test_a_solver_takes_over_what_the_filter_has_made_where_that_is_of_the_same_problem(depths: int) -> None:
    made = level(depths)
    solving = made.solving()
    assert made.solver is None
    assert solving.solver is not None
    assert (solving.solver.parts[0] is made.preview) == (depths == 1)
    assert solving.solver._cold, "the first frame that it is given is not what it was tried with"
    assert [solver is None for solver in solving.solver.solvers] == [False], "it has found its memory"
    frame = make_scene("beads", size=24, depths=depths, density=0.5, photons=3000.0).measurement
    solving.solver.take(frame)
    for _ in range(60):
        solving.solver.advance(0.0)
    assert solving.solved().shape == (depths, 24, 24)
    binned = replace(solving, detail=replace(solving.detail, binning=3))
    np.testing.assert_allclose(9 * binned.solved(), solving.solved(), rtol=1e-6)
    np.testing.assert_allclose(9 * binned.filtered(frame), solving.filtered(frame), rtol=1e-6)
    assert solving.filtered(frame).min() == 0.0
    solving.solver.close()


def test_a_solver_that_finds_no_memory_leaves_none_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []

    def lacks(*_: object) -> None:
        raise MemoryError("none left")

    monkeypatch.setattr(VideoSolver, "advance", lacks)
    monkeypatch.setattr(VideoSolver, "close", lambda solver: closed.append(solver))
    with pytest.raises(MemoryError, match="none left"):
        level().solving()
    assert len(closed) == 1


def test_a_picture_is_done_at_a_thousandth_or_where_the_solver_would_be() -> None:
    assert level().problem.stop_tolerance != SETTLED
    assert level().tolerance == min(SETTLED, level().problem.stop_tolerance)
    assert level(tolerance=1e-2).tolerance == SETTLED
    assert level(tolerance=1e-5).tolerance == 1e-5


@pytest.mark.parametrize("channels", [1, 3])
def test_light_is_looked_for_in_counts_with_the_noise_of_a_mean(
    channels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[tuple[np.ndarray, np.ndarray]] = []
    monkeypatch.setattr(live_picture, "has_light", lambda *given: bool(looked.append(given)))
    scene = make_scene("beads", size=24, channels=channels, density=0.5, photons=3000.0)
    frame = scene.measurement
    gone = np.random.default_rng(0).random(frame.shape) < 0.3
    problem = stream_problem(
        Measurement(frame, noise=2.0, erasures=gone),
        scene.calibration,
        prior="l1",
        model="convolution",
        estimate_background=False,
    )
    made = Level.of(problem, Detail(1, (0,)), problem, 0)
    made.sees_light(frame, 1)
    made.sees_light(frame, 16)
    (first, noise), (again, _), (_, less) = looked
    np.testing.assert_allclose(less, noise / 4)
    np.testing.assert_array_equal(first, again)
    counts = np.atleast_3d(np.array(frame, np.float64))
    for channel, lost in enumerate(np.moveaxis(np.atleast_3d(gone), 2, 0)):
        mean = counts[..., channel][~lost].mean()
        expected = np.where(lost, mean, counts[..., channel])
        np.testing.assert_allclose(first[..., channel], expected, rtol=1e-4, atol=1e-3 * mean)
    np.testing.assert_allclose(noise, 2.0)


def test_pictures_go_on_while_a_level_is_made_and_are_told_when_it_is() -> None:
    go_on = threading.Event()
    waited = []
    coming = ComingLevel(Detail(1, (0,)), lambda: waited.append(go_on.wait(20)))  # type: ignore[arg-type, return-value]
    assert not coming.wait(0)
    go_on.set()
    assert coming.wait(20)
    assert waited == [True]
    assert coming.result() is None
