"""Videos through every camera: frame after frame of one problem, by the code that solves a photograph."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon import InputError, Measurement, solve
from recon.evaluation.scene import make_scene
from recon.streams.joint import solve_together
from recon.streams.video import VideoSolver, stream_problem

CASES: dict[str, dict[str, Any]] = {
    "one PSF": {},
    "local": {"model": "local"},
    "low rank": {"model": "lowrank", "prior": "l1"},
    "background": {"estimate_background": True},
    "local, background": {"model": "local", "estimate_background": True},
    "FISTA, Haar": {"solver": "fista", "prior": "tv-haar"},
    "on the ADMM of photographs": {"solver": "admm"},
    "float64": {"precision": "float64"},
}


@pytest.mark.parametrize("erased", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_a_still_video_becomes_what_a_photograph_becomes(name: str, erased: bool) -> None:
    scene = make_scene("sparse-picture", size=24, grid=3, photons=2000.0)
    gone = np.random.default_rng(0).random(scene.measurement.shape) < 0.1 if erased else None
    problem = stream_problem(Measurement(scene.measurement, erasures=gone), scene.calibration, **CASES[name])
    video = VideoSolver(problem, cold_iterations=30, warm_iterations=30)
    for _ in range(4):
        picture = video.next(scene.measurement)
    alone = solve(problem).image
    assert picture.shape == alone.shape
    assert picture.dtype == np.float32
    assert np.linalg.norm(picture - alone) < 0.12 * np.linalg.norm(alone)


def test_a_frame_goes_on_from_the_one_before_whatever_the_camera() -> None:
    scene = make_scene("sparse-picture", size=24, grid=3, photons=2000.0)
    problem = stream_problem(scene.measurement, scene.calibration, model="local")
    warm, cold = (VideoSolver(problem, cold_iterations=n, warm_iterations=2) for n in (40, 2))
    best = warm.next(scene.measurement)
    apart = [np.linalg.norm(v.next(scene.measurement) - best) for v in (warm, cold)]
    assert apart[0] < 0.5 * apart[1]


@pytest.mark.parametrize("channels", [1, 3])
def test_several_depths_and_colours(channels: int) -> None:
    scene = make_scene("beads", size=24, depths=3, channels=channels, density=0.5)
    problem = stream_problem(scene.measurement, scene.calibration, prior="l1", estimate_background=False)
    video = VideoSolver(problem, cold_iterations=60, warm_iterations=20)
    for _ in range(2):
        volume = video.next(scene.measurement)
    alone = solve(problem).volume
    assert volume.shape == alone.shape == (3, 24, 24, *((3,) if channels > 1 else ()))
    assert np.linalg.norm(volume - alone) < 0.1 * np.linalg.norm(alone)


def test_what_a_stream_has_no_way_for_is_refused_in_words() -> None:
    scene = make_scene("sparse-picture", size=24, grid=3)
    with pytest.raises(InputError, match="no iterations"):
        VideoSolver(stream_problem(scene.measurement, scene.calibration, solver="wiener"))
    local = stream_problem(scene.measurement, scene.calibration, model="local")
    with pytest.raises(InputError, match="one PSF, one depth"):
        solve_together(local, np.stack([scene.measurement] * 2).astype(np.float32), "tv")
    with pytest.raises(InputError, match="those before"):
        VideoSolver(local).next(np.zeros((8, 8), np.float32))
