"""Spots as pose hypotheses: bright where right, dark where wrong; the pose from their brightness."""

from __future__ import annotations

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import Display, HologramModel, Target, random_mask
from recon.holography.camera_map import CameraMap, mask_speckle, register_camera
from recon.holography.pose import NAMES, Pose
from recon.holography.spots import PoseProbe, Spot, SpotMaker, depth_um, spread_spots

SHAPE, K = (60, 80), 4
DISPLAY = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=2))
MAKER = SpotMaker(DISPLAY)


def brightness(slm, pose, spots):
    """Brightness of spots where the mask is at ``pose`` (no free space), by the hologram model."""
    display = Display(
        SHAPE, DISPLAY.mask, displacement=pose.displacement(DISPLAY.mask.shape) if pose != Pose() else None
    )
    model = HologramModel(display, [Target(np.ones((16, 16)))], dtype=np.complex128)
    image = np.fft.ifftshift(model.intensity(slm[None]))
    height, width = image.shape
    rows = [round(s.row / DISPLAY.mask.shape[0] * height) for s in spots]
    columns = [round(s.column / DISPLAY.mask.shape[1] * width) for s in spots]
    return np.array([image[r, c] for r, c in zip(rows, columns, strict=True)])


def test_a_spot_reaches_its_ideal_where_its_pose_is_right_and_not_where_it_is_wrong():
    pose = Pose(shift_x=6.0, shift_y=-3.0, roll_mrad=4.0, scale=0.002)
    places = spread_spots(8, DISPLAY.mask.shape)
    pattern = MAKER.pattern([Spot(*place, pose) for place in places])
    right = brightness(pattern.slm, pose, pattern.spots)
    wrong = brightness(pattern.slm, Pose(), pattern.spots)
    assert right.mean() > 0.6 * pattern.ideal
    assert wrong.max() < 0.1 * right.mean()


def test_the_quick_way_for_shifts_makes_the_same_pattern():
    spots = [
        Spot(row, column, Pose(shift_x=4.0 * n, shift_y=-4.0 * n, z_um=200.0 * n))
        for n, (row, column) in enumerate(spread_spots(4, DISPLAY.mask.shape))
    ]
    quick, plain = MAKER.shift_pattern(spots, seed=3), MAKER.pattern(spots, seed=3)
    for pattern in (quick, plain):
        found = [abs(np.vdot(MAKER.field(spot), pattern.slm)) for spot in spots]
        ideal = [np.abs(MAKER.field(spot)).sum() for spot in spots]
        assert min(np.array(found) / ideal) > 0.3


def test_light_is_lost_over_the_stated_depth():
    one = MAKER.field(Spot(3, 5, Pose()))
    slm = np.exp(1j * np.angle(one))
    there = MAKER.field(Spot(3, 5, Pose(z_um=depth_um(DISPLAY))))
    left = (abs(np.vdot(there, slm)) / abs(np.vdot(one, slm))) ** 2
    assert 0.35 < left < 0.65


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_is_recovered_from_the_brightness_of_probes(name):
    """Amplitudes by the fields themselves: tests the linear step, not the light."""
    probe = PoseProbe(MAKER)
    index = NAMES.index(name)
    change = np.zeros(len(NAMES))
    change[index] = 0.4 * probe.steps[index]
    truth = Pose().plus(change)
    field = MAKER.field(Spot(3, 5, truth))
    slms = [np.exp(1j * np.angle(MAKER.field(Spot(3, 5, pose)))) for pose in probe.poses(Pose())]
    measured = np.array([[abs(np.vdot(field, slm)) ** 2 for slm in slms]])
    noise = 0.005 * np.sqrt(measured.max())
    step = probe.step(measured, noise, Pose(), np.full(len(NAMES), np.inf))
    errors = (step.change - change) / probe.steps
    assert np.abs(errors).max() < 0.12
    assert (step.error > 0).all()


def test_uncertainties_are_those_of_repeated_noisy_measurements():
    probe = PoseProbe(MAKER)
    slms = [np.exp(1j * np.angle(MAKER.field(Spot(3, 5, pose)))) for pose in probe.poses(Pose())]
    field = MAKER.field(Spot(3, 5, Pose()))
    amplitude = np.array([abs(np.vdot(field, slm)) for slm in slms])
    noise = 0.05 * amplitude.max()
    rng = np.random.default_rng(0)
    found = [
        probe.step((amplitude + rng.normal(0, noise, (1, len(slms)))) ** 2, noise, Pose(), np.full(8, np.inf))
        for _ in range(200)
    ]
    spread = np.std([step.change for step in found], axis=0)
    np.testing.assert_allclose(spread, found[0].error, rtol=0.35)


def test_cubic_and_scale_are_told_apart():
    probe = PoseProbe(MAKER)
    assert np.linalg.cond(probe.jacobian()) < 6


def test_the_displacement_field_is_what_the_pose_says():
    pose = Pose(shift_x=2.0, shift_y=-1.0, roll_mrad=10.0, scale=0.01)
    field = pose.displacement((100, 200))
    np.testing.assert_allclose(field[6, 11], [-1.0, 2.0], atol=1e-9)
    y, x = -50.0, -100.0
    c, s = np.cos(0.01), np.sin(0.01)
    expected = [1.01 * (s * x + c * y) - 1.0 - y, 1.01 * (c * x - s * y) + 2.0 - x]
    np.testing.assert_allclose(field[0, 0], expected, atol=1e-9)
    moved = pose.with_(shift_x=2.5).displacement((100, 200)) - field
    np.testing.assert_allclose(moved, np.broadcast_to([0.0, 0.5], moved.shape), atol=1e-9)


@pytest.mark.parametrize("turned_rad", [0.0, 0.15, -0.11])
def test_the_camera_is_found_by_the_masks_speckle_to_a_tenth_of_a_pixel(turned_rad):
    display = Display((120, 120), random_mask((480, 480), seed=4))
    speckle = mask_speckle(display)
    truth = CameraMap((560, 560), 500.0, np.zeros((10, 2))).turned(turned_rad)
    truth.coefficients[0] += [3.4, -7.2]
    truth.coefficients[1] += [1.5, -2.0]
    truth.coefficients[9] += [4.0, 0.0]
    rows, columns = np.meshgrid(np.arange(560), np.arange(560), indexing="ij")
    # Invert the map by iteration, then look the speckle up there.
    y, x = (rows - 279.5) / 500, (columns - 279.5) / 500
    for _ in range(10):
        r, c = truth.pixels(y, x)
        y, x = y + (rows - r) / 500, x + (columns - c) / 500
    from scipy.ndimage import gaussian_filter, map_coordinates

    frame = map_coordinates(gaussian_filter(speckle, 0.8), [(y + 0.5) * 960, (x + 0.5) * 960], order=1)
    frame += np.random.default_rng(0).normal(0, 0.2, frame.shape)
    found = register_camera(frame, display, 503.0)
    places = np.random.default_rng(1).uniform(-0.4, 0.4, (2, 50))
    error = np.hypot(*(np.array(found.pixels(*places)) - truth.pixels(*places)))
    assert error.max() < 0.15
    assert found.turn_rad == pytest.approx(truth.turn_rad, abs=1e-3)
    assert found.scale * 503 == pytest.approx(truth.scale * 500, rel=1e-3)
    with pytest.raises(InputError, match="speckle was recognised in"):
        register_camera(np.random.default_rng(2).random((560, 560)), display, 500.0)
