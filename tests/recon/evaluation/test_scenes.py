from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon import InputError, reconstruct
from recon.camera.registration import expected_shift
from recon.evaluation.chart_judge import score
from recon.evaluation.lenslets import build_camera
from recon.evaluation.scene import FAMILIES, make_scene, spec_of


@pytest.mark.parametrize("family", FAMILIES)
def test_a_scene_is_the_same_every_time_and_another_one_with_another_seed(family):
    first, again = make_scene(family, size=32), make_scene(family, size=32)
    np.testing.assert_array_equal(first.measurement, again.measurement)
    np.testing.assert_array_equal(first.calibration.psfs, again.calibration.psfs)
    np.testing.assert_array_equal(first.truth, again.truth)
    assert not np.array_equal(first.measurement, make_scene(family, size=32, seed=1).measurement)


@pytest.mark.parametrize("optics", ["random", "regular", "smooth"])
def test_a_point_shifts_and_scales_the_pattern_as_the_geometry_says(optics):
    camera = build_camera(64, optics=optics, seed=4)
    z = 8 * camera.distance_um
    axis = camera.light([[0, 0, z, 1.0]])
    # An offset of 5 rows and -3 columns on the sensor.
    to_scene = -camera.pitch_um * z / camera.distance_um
    source = (-3 * to_scene, 5 * to_scene, z)
    assert expected_shift(source, camera.distance_um, camera.pitch_um) == pytest.approx((5, -3))
    moved = camera.light([[*source, 1.0]])
    np.testing.assert_allclose(moved[7:57, 3:57], axis[2:52, 6:60], atol=0.03 * axis.max())
    assert np.abs(moved[7:57, 3:57] - axis[3:53, 6:60]).max() > 0.2 * axis.max()


def test_a_nearer_point_throws_a_larger_pattern_and_more_light():
    camera = build_camera(96)
    y = np.arange(96) - 48.0
    spread, light = [], []
    for z in (12, 4):
        image = camera.light([[0, 0, z * camera.distance_um, 1.0]]).sum(axis=1, dtype=np.float64)
        light.append(image.sum())
        spread.append(np.sqrt(image @ y**2 / image.sum() - (image @ y / image.sum()) ** 2))
    assert spread[1] / spread[0] == pytest.approx((1 + 1 / 4) / (1 + 1 / 12), rel=0.01)
    assert light[1] / light[0] == pytest.approx(9, rel=0.05)


def test_the_fall_off_dims_what_comes_from_the_side_and_leaves_the_axis():
    place = np.array([[0.0, 0.0], [0.35, 0.0]])
    seen = []
    for fall_off in (np.inf, 15.0):
        camera = build_camera(64, fall_off_deg=fall_off)
        z = 8 * camera.distance_um
        seen.append([camera.light([[*p * 64 * camera.pitch_um * 8, z, 1.0]]).sum() for p in place])
    assert seen[1][0] / seen[0][0] > 0.85
    assert seen[1][1] / seen[0][1] < 0.45


def test_truth_and_measurement_are_in_the_same_units():
    for family in ("sparse-picture", "beads"):
        scene = make_scene(family, field=0.25, photons=1e6, calibration_photons=1e6)
        psfs = scene.calibration.psfs[:, 0]
        light = psfs.sum(axis=(1, 2)) @ np.atleast_3d(scene.truth.T).T.reshape(len(psfs), -1).sum(axis=1)
        # Noise below zero is cut off in the calibration, and a little light misses the sensor.
        assert scene.measurement.sum() / light == pytest.approx(1, abs=0.08)


def test_noise_is_what_was_asked_for():
    spec = spec_of("dense-picture", size=32, photons=500.0, read_noise_e=5.0, background=0.5)
    scene = make_scene(spec)
    bright = make_scene(replace(spec, photons=5e8, read_noise_e=0.0))
    clean = bright.measurement * (500.0 / 5e8)
    excess = scene.measurement - clean
    assert abs(excess.mean()) < 1.5
    assert np.var(excess) == pytest.approx(np.mean(clean) + 25, rel=0.15)
    assert scene.background.mean() / (scene.measurement.mean() - scene.background.mean()) == pytest.approx(
        0.5, rel=0.05
    )


def test_erased_saturated_and_drifted():
    scene = make_scene("sparse-picture", erased=0.3, saturation=0.5)
    assert scene.erasures is not None
    assert scene.erasures.mean() == pytest.approx(0.3, abs=0.03)
    assert not scene.measurement[scene.erasures].any()
    assert scene.measurement.max() <= 0.5 * scene.spec.photons
    still = make_scene("sparse-picture")
    moved = make_scene("sparse-picture", drift_px=2.0)
    np.testing.assert_array_equal(still.calibration.psfs, moved.calibration.psfs)
    error = moved.measurement[2:, 2:] - still.measurement[:-2, :-2]
    assert np.abs(error).mean() < 0.35 * np.abs(moved.measurement - still.measurement).mean()


def test_colours():
    scene = make_scene("dense-picture", size=32, channels=3, colourful=True, dispersion=0.1)
    assert scene.measurement.shape == scene.truth.shape == (32, 32, 3)
    assert scene.calibration.psfs.shape == (1, 3, 32, 32)
    ratio = scene.truth[8:24, 8:24, 0] / scene.truth[8:24, 8:24, 2]
    assert ratio.max() > 1.5 * ratio.min()
    grey = make_scene("dense-picture", size=32, channels=3)
    np.testing.assert_array_equal(grey.truth[..., 0], grey.truth[..., 2])


def test_a_calibration_grid_has_all_depths_and_places():
    scene = make_scene("microscope", size=32, grid=3, depths=4)
    z = scene.calibration.source_positions_um[:, 2]
    assert len(z) == 36
    assert len(scene.z_um) == 4
    np.testing.assert_allclose(np.diff(1 / np.unique(z)), np.diff(1 / np.unique(z))[0])
    assert scene.truth.shape == (4, 32, 32)


def test_a_sparse_picture_is_reconstructed_and_a_shifted_one_is_worse():
    scene = make_scene("sparse-picture")
    found = reconstruct(scene.measurement, scene.calibration, iterations=100).image
    assert score(found, scene.truth).psnr_db > 28
    assert score(np.roll(found, 1, axis=0), scene.truth).psnr_db < score(found, scene.truth).psnr_db - 6
    assert score(3 * scene.truth, scene.truth).nrmse < 1e-6


def test_mistakes_are_named():
    with pytest.raises(InputError, match="no colour"):
        make_scene("beads", colour=3)
    with pytest.raises(InputError, match="sparse-picture"):
        make_scene("sparse")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="0 < near"):
        make_scene("beads", z_near=20.0)
    with pytest.raises(InputError, match=r"\(4, 4\)"):
        score(np.zeros((4, 4)), np.zeros((5, 5)))


def test_the_calibrations_exposure_depends_neither_on_its_grid_nor_on_the_fall_off():
    spec = spec_of("sparse-picture", size=32, calibration_photons=1e5)
    on_axis = [
        make_scene(replace(spec, grid=grid, fall_off_deg=angle)).calibration.psfs[grid**2 // 2].max()
        for grid, angle in ((1, np.inf), (3, np.inf), (3, 8.0), (5, 8.0))
    ]
    # Photon noise of the brightest pixel is 0.3 %.
    np.testing.assert_allclose(on_axis, 1e5, rtol=0.03)
