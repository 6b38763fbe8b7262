"""Refocusing a PSF, against PSFs that light makes at the wanted depth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.analysis.correlation import across_field, similarity
from recon.arrays import Float64Array
from recon.camera.depth_likeness import likeness_range
from recon.camera.depth_mixture import central_psfs, paraxial_scale
from recon.camera.grid import FAR_UM
from recon.camera.refocus import refocus, refocus_psf
from recon.camera.refocus_field import at_depth
from recon.camera.registration import register, rescaled
from recon.errors import InputError
from recon.reconstruction.reconstruct import reconstruct
from recon.types import Calibration, Geometry

WORLD = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
GREEN = (0.0, 1.0, 0.0)


def true_psf(z_um: float, x_um: float = 0.0) -> np.ndarray:
    return WORLD.psf((x_um, 0.0, z_um), GREEN)


def calibrated(z_um: list[float], x_um: float = 0.0) -> Calibration:
    psfs = np.stack([true_psf(z, x_um) for z in z_um])[:, None]
    return Calibration(
        psfs, np.array([(x_um, 0.0, z) for z in z_um]), geometry=WORLD.geometry, provenance={"a": 1}
    )


def test_scale_and_brightness_follow_light() -> None:
    near, far = true_psf(60e3), true_psf(90e3)
    made = refocus_psf(near, 60e3, 90e3, WORLD.distance_um)
    found = register(near, far, scale=None)
    assert found.scale == pytest.approx(paraxial_scale(90e3, 60e3, WORLD.distance_um), rel=2e-3)
    assert made.sum() == pytest.approx(far.sum(), rel=0.01)
    assert similarity(made, far) > 0.97
    assert similarity(near, far) < 0.7


def test_between_two_depths_is_better_than_from_the_nearest() -> None:
    calibration = calibrated([40e3, 60e3, 100e3, 200e3])
    made = refocus(calibration, 75e3)
    truth = true_psf(75e3)
    assert made.from_z_um == (60e3, 100e3)
    from_one = refocus_psf(calibration.psfs[1, 0], 60e3, 75e3, WORLD.distance_um)
    assert similarity(made.psf[0], truth) > similarity(from_one, truth)
    assert similarity(made.psf[0], truth) > 0.98


def test_the_expected_similarity_is_that_of_the_truth() -> None:
    calibration = calibrated([30e3, 40e3, 60e3, 100e3, 200e3])
    for z_um in (35e3, 50e3, 75e3):
        made = refocus(calibration, z_um)
        truth = similarity(made.psf[0], true_psf(z_um))
        assert made.expected_similarity is not None
        assert 1 - made.expected_similarity == pytest.approx(1 - truth, abs=0.02)
        assert made.expected_similarity > 0.95
    for z_um in (18e3, 24e3, 400e3):  # beyond the calibrated depths
        made = refocus(calibration, z_um)
        assert made.similarity_within is not None
        within = max(made.similarity_within, 0.02)
        assert within < 0.05
        assert made.expected_similarity == pytest.approx(similarity(made.psf[0], true_psf(z_um)), abs=within)
    far = refocus(calibration, 10e3)
    assert far.expected_similarity is None
    assert "similarity not known" in str(far)


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_what_pairs_leave_open_is_a_range_that_holds_the_truth(power: float) -> None:
    """Pairs of planes by a law that is known; on its plateau they tell little of nearer planes."""

    def law(distance: float | Float64Array) -> Float64Array:
        return 0.99 * (0.9 + 0.1 / (1 + (np.asarray(distance) / 3.0) ** power))

    def between(apart: Float64Array) -> tuple[float, float, float]:
        half, gap, shares = np.array([apart[0] / 2] * 2), float(apart[0]), np.array([0.5, 0.5])
        true = float((law(half) * shares).sum() / np.sqrt(0.5 + 0.5 * law(gap)))
        low, high = likeness_range(apart, law(apart), half, shares, gap)
        assert low - 0.003 <= true <= high + 0.003
        return low, true, high

    low, _, high = between(np.array([0.5, 1.0, 2.0, 8.0]))
    assert high - low < 0.02
    low, _, high = between(np.array([60.0, 120.0]))
    assert high - low > 0.02


def test_a_pattern_between_planes_follows_the_law_no_better_than_they_do() -> None:
    """As lenslets of 1.5 mm at 104 mm, of planes at 71 and 300: 0.918 by light that was propagated."""
    half, share = np.array([0.5, 0.5]), np.array([0.5, 0.5])
    low, high = likeness_range(np.array([1.0, 1.0, 2.0]), np.array([0.902, 0.903, 0.9]), half, share, 1.0)
    assert low <= 0.918 <= high
    assert (low + high) / 2 - 0.918 < 0.03


def test_a_line_of_motion_beside_the_axis_blurs_nothing() -> None:
    """The far and the near pattern, scaled, lie apart; they are registered before they are mixed."""
    calibration = calibrated([60e3, 100e3], x_um=3000.0)
    made = refocus(calibration, 75e3)
    assert similarity(made.psf[0], true_psf(75e3, 3000.0)) > 0.97


def test_outside_the_calibrated_range_the_nearest_depth_is_scaled() -> None:
    made = refocus(calibrated([60e3, 100e3]), 150e3)
    assert made.from_z_um == (100e3,)
    assert made.expected_similarity is None
    assert "100 mm" in str(made)


def test_a_calibrated_depth_is_left_as_it_is() -> None:
    calibration = calibrated([60e3, 100e3])
    same, made = at_depth(calibration, 100e3)
    assert same is calibration
    assert made is None
    np.testing.assert_array_equal(refocus(calibration, 1 / (1 / 100e3)).psf, calibration.psfs[1])
    other, made = at_depth(calibration, 75e3)
    assert made is not None
    assert len(other.psfs) == 1
    assert other.source_positions_um[0, 2] == 75e3
    assert other.provenance["refocused"]["z_um"] == 75e3


def test_the_displacement_error_grows_with_distance_and_deflection() -> None:
    calibration = calibrated([60e3])
    near, far = (refocus(calibration, z).displacement_error_um for z in (65e3, 120e3))
    assert near < far
    assert refocus(calibration, 120e3, deflection_deg=0.5).displacement_error_um == pytest.approx(2 * far)
    s = paraxial_scale(60e3, 120e3, WORLD.distance_um)
    assert far == pytest.approx(np.deg2rad(0.25) * WORLD.distance_um * abs(1 - 1 / s))


def test_a_grid_whose_depths_the_stage_missed_a_little_is_one_depth() -> None:
    places = [(0.0, 0.0, 60e3), (4000.0, 0.0, 60.01e3), (0.0, 0.0, 100e3), (4000.0, 0.0, 99.99e3)]
    psfs = np.stack([WORLD.psf(p, GREEN) for p in places])[:, None]
    grid = Calibration(psfs, np.array(places), geometry=WORLD.geometry)
    depths, central = central_psfs(grid)
    assert list(depths) == [60e3, 100e3]
    np.testing.assert_array_equal(central, psfs[[0, 2]])
    assert refocus(grid, 75e3).from_z_um == (60e3, 100e3)
    points = across_field(grid)
    assert len(points) == 2
    assert points[1].angle_deg == pytest.approx(np.rad2deg(np.arctan(4 / 60)), abs=0.05)
    assert points[1].similarity > 0.95


def test_of_a_field_the_psf_nearest_to_the_axis_is_taken_and_said() -> None:
    places = [(-8e3, 60e3), (1e3, 60e3), (8e3, 60e3)]
    psfs = np.stack([true_psf(z, x) for x, z in places])[:, None]
    field = Calibration(psfs, np.array([(x, 0.0, z) for x, z in places]), geometry=WORLD.geometry)
    made = refocus(field, 80e3)
    assert made.source_um == (1e3, 0.0)
    assert made.extrapolated
    assert "(x = 1, y = 0 mm)" in str(made)
    moved, _ = at_depth(field, 80e3)
    assert len(moved.psfs) == 3
    np.testing.assert_allclose(moved.source_positions_um[:, 0], [-8e3, 1e3, 8e3], atol=60)
    assert not refocus(calibrated([40e3, 60e3, 100e3]), 75e3).extrapolated


def test_rescaling_keeps_the_centre() -> None:
    image = np.zeros((41, 61), np.float32)
    image[15:26, 25:36] = 1.0
    small = rescaled(image, 2.0)
    assert small.sum() == pytest.approx(image.sum() / 4, rel=0.02)
    y = np.mgrid[:41, :61][0]
    assert (small * y).sum() / small.sum() == pytest.approx(20.0, abs=1e-3)


def test_what_is_not_known_is_refused_in_words() -> None:
    calibration = calibrated([60e3])
    with pytest.raises(InputError, match="above 0"):
        refocus(calibration, -1.0)
    nowhere = Calibration(calibration.psfs, np.full((1, 3), np.nan), geometry=WORLD.geometry)
    with pytest.raises(InputError, match="not known"):
        refocus(nowhere, 50e3)
    bare = Calibration(calibration.psfs, calibration.source_positions_um, geometry=Geometry(6.5))
    with pytest.raises(InputError, match="diffuser_distance_mm"):
        refocus(bare, 50e3)


def test_infinity_is_where_light_comes_in_parallel() -> None:
    """Judged by light from a kilometre; a picture's pixels have angles, as the camera divides directions."""
    calibration = calibrated([60e3, 100e3, 300e3])
    made, how = at_depth(calibration, math.inf)
    assert how is not None
    assert similarity(made.psfs[0, 0], true_psf(FAR_UM)) > 0.98
    psf = made.psfs[0, 0] / made.psfs.max()
    photo = psf + np.roll(psf, (7, -20), (0, 1))
    picture = reconstruct(photo, made, z_um=math.inf, iterations=2, judged=False)
    assert sum("Infinity lies outside the calibrated 60 to 300 mm" in text for text in picture.warnings) == 1
    pitch_um = WORLD.geometry.pixel_pitch_um
    assert picture.grid.pixel_mrad == pytest.approx(1e3 * pitch_um / WORLD.distance_um)
    row, column = picture.grid.centre
    x_deg, y_deg = picture.grid.direction_deg(row, column - 10)
    assert x_deg == pytest.approx(np.degrees(np.arctan(10 * pitch_um / WORLD.distance_um)), abs=1e-3)
    assert y_deg == pytest.approx(0, abs=1e-3)
