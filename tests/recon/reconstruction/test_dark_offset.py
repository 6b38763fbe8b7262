"""Photographs that lost more than their dark level: an even offset is found, nothing else taken for one."""

from __future__ import annotations

import numpy as np
import pytest

from recon import reconstruct
from recon.evaluation.scene import TestScene, make_scene
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.mending.restored_light import with_light_restored
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.selection import choose
from recon.types import Calibration


def strokes() -> TestScene:
    return make_scene("sparse-picture", size=40, photons=3000.0, seed=4)


def problem_of(scene: TestScene, taken_off: float, **options: bool) -> Problem:
    image = scene.measurement - np.float32(taken_off * scene.measurement.mean())
    return Problem.of(Measurement(image), scene.calibration, ReconstructionOptions(**options))


def test_too_much_taken_off_is_added_again_and_told() -> None:
    scene = strokes()
    restored = with_light_restored(problem_of(scene, 0.3))
    added = -float(np.asarray(restored.measurement.background)) / float(scene.measurement.mean())
    assert 0.1 < added < 0.4
    assert "darker than light through its PSF can be" in restored.warnings[-1]


def test_a_dark_level_that_is_too_large_costs_hardly_anything() -> None:
    scene = strokes()

    def likeness(taken_off: float) -> float:
        image = scene.measurement - np.float32(taken_off * scene.measurement.mean())
        found = reconstruct(image, scene.calibration, judged=False).image
        return float(np.corrcoef(found.ravel(), scene.truth.ravel())[0, 1])

    assert likeness(0.3) > likeness(0.0) - 0.01


@pytest.mark.parametrize("stray", [0.0, 0.6])
def test_nothing_is_added_where_nothing_is_missing(stray: float) -> None:
    problem = problem_of(make_scene("sparse-picture", size=40, background=stray, seed=4), 0.0)
    assert with_light_restored(problem) is problem


def test_nothing_is_added_where_somebody_said_what_the_background_is() -> None:
    problem = problem_of(strokes(), 0.3, estimate_background=False)
    assert with_light_restored(problem) is problem


def test_light_that_falls_off_is_no_offset() -> None:
    scene = make_scene("texture", size=56, field=0.65, fall_off_deg=16.0, photons=2e4, seed=2)
    chosen = choose(Problem.of(Measurement(scene.measurement), scene.calibration, ReconstructionOptions()))
    assert not any("were added" in words for words in chosen.warnings)


def test_channels_share_one_dark_level() -> None:
    scene = strokes()
    colour = np.stack([scene.measurement * g for g in (1.0, 0.5)], axis=-1)
    lost = np.float32(0.2 * scene.measurement.mean())
    psfs = Calibration(np.repeat(scene.calibration.psfs[:1], 2, axis=1), np.full((1, 3), np.nan))
    restored = with_light_restored(Problem.of(Measurement(colour - lost), psfs))
    assert np.ndim(restored.measurement.background) == 0
    assert -float(np.asarray(restored.measurement.background)) == pytest.approx(float(lost), rel=0.5)


def test_no_offset_is_looked_for_on_the_whole_sensor_where_erasures_leave_no_small_copy() -> None:
    scene = make_scene("sparse-picture", size=260, photons=3000.0, seed=4)
    image = scene.measurement - np.float32(0.3 * scene.measurement.mean())
    for share, looked in ((0.1, False), (1e-4, True)):
        erased = np.random.default_rng(0).random(image.shape[:2]) < share
        problem = Problem.of(Measurement(image, erasures=erased), scene.calibration, ReconstructionOptions())
        assert (with_light_restored(problem) is not problem) is looked
