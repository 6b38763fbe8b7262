from __future__ import annotations

import numpy as np
import pytest

import recon
from recon.camera.camera_model import LEAST_GAIN, Depths, levelled, sort_by_depth
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution
from recon.evaluation.chart_judge import score
from recon.evaluation.scene import make_scene


def depths_of(gains: list[float]) -> Depths:
    """Two depths, of which the second is twice as bright; PSFs of each differ in brightness alone."""
    shape = np.random.default_rng(4).random((1, 12, 12)).astype(np.float32)
    points = [(0.0, 0.0), (0.0, 6.0), (6.0, 0.0), (6.0, 6.0)]
    factors = np.array([1.0, *gains], np.float32)[:, None, None, None]
    fields = [FieldOfPsfs(plane * factors * shape, points) for plane in (1.0, 2.0)]
    return Depths(np.array([1.0, 2.0]), np.stack([shape, 2 * shape]), fields)


def test_levelled_psfs_and_gains_are_the_camera_as_it_was():
    depths = depths_of([0.5, 0.3, 0.15])
    even, gains = levelled(depths, (14, 14), varying=True)
    for field in even.fields:
        for psf in field.psfs:
            np.testing.assert_allclose(psf, even.central[0], rtol=1e-5)
    camera = local_convolution(depths.fields, (14, 14))
    level = local_convolution(even.fields, (14, 14))
    x = np.random.default_rng(5).random(camera.domain_shape, np.float32)
    assert gains.shape == camera.domain_shape[1:]
    np.testing.assert_allclose(level.forward(x * gains), camera.forward(x), rtol=1e-4)


def test_one_psf_a_depth_shares_one_gain():
    even, gains = levelled(depths_of([0.5, 0.3, 0.15]), (14, 14), varying=False)
    assert gains.shape == (2, 1, 1)
    np.testing.assert_allclose(gains[1], 2 * gains[0], rtol=1e-6)
    np.testing.assert_allclose(even.central[0], even.central[1], rtol=1e-6)


def test_a_dark_psf_is_not_made_up_for():
    _, gains = levelled(depths_of([0.5, 0.3, 0.0]), (14, 14), varying=True)
    assert gains.min() == pytest.approx(LEAST_GAIN * gains[0].max(), rel=1e-4)


def test_l1_finds_beads_at_the_edge_of_a_field_that_falls_off():
    scene = make_scene("beads", size=32, depths=4, grid=3, fall_off_deg=16.0, density=0.5, seed=3)
    depths = sort_by_depth(scene.calibration)
    assert min(float(psf.sum()) for psf in depths.fields[0].psfs) < 0.2 * float(depths.central[0].sum())
    settings = {"prior": "l1", "estimate_background": False, "judged": False}

    def reached(model: str) -> float:
        found = recon.reconstruct(
            scene.measurement, scene.calibration, model=model, iterations=60, **settings
        )
        return score(found.volume, scene.truth).psnr_db

    assert reached("lowrank") > reached("convolution") + 1


def test_a_start_is_taken_as_it_was_returned():
    scene = make_scene("beads", size=24, depths=3, grid=3, fall_off_deg=16.0, density=0.3, seed=4)
    settings = {"prior": "l1", "model": "local", "estimate_background": False, "judged": False}
    first = recon.reconstruct(scene.measurement, scene.calibration, iterations=60, **settings)
    near = recon.reconstruct(scene.measurement, scene.calibration, iterations=1, warm=first, **settings)
    far = recon.reconstruct(scene.measurement, scene.calibration, iterations=1, **settings)
    error = [float(np.linalg.norm(v.volume - first.volume)) for v in (near, far)]
    assert error[0] < 0.5 * error[1]
