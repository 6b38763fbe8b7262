"""Points between depths: which plane they are on, what they look like there, where that is in the scene."""

from __future__ import annotations

import numpy as np
import pytest

from recon.camera.grid import Grid
from recon.camera.points import Points
from recon.camera.points_in_depth import STEPS, ImagesInDepth, Rays

Z_UM = 1 / np.linspace(1 / 10e3, 1 / 20e3, 4)
"""Even steps of a pattern's size."""
SIZE, PITCH_UM, DISTANCE_UM = 40, 10.0, 2000.0
LENSES = np.random.default_rng(3).uniform(-6, 6, (6, 2))


def seen(row: float, column: float, z_um: float) -> np.ndarray:
    """Return what the sensor sees of a point: spots, apart as far as the depth has them."""
    at = np.arange(SIZE) - SIZE // 2
    image = np.zeros((SIZE, SIZE))
    for y, x in LENSES * (1 + 3 * DISTANCE_UM / z_um) + [row, column]:
        image += np.exp(-((at - y) ** 2) / 6.0)[:, None] * np.exp(-((at - x) ** 2) / 6.0)
    return image.astype(np.float32)


def camera(z_um: np.ndarray = Z_UM) -> ImagesInDepth:
    return ImagesInDepth(z_um, np.stack([seen(0, 0, z) for z in z_um]), DISTANCE_UM, (SIZE, SIZE))


@pytest.mark.parametrize("descending", [False, True])
def test_planes_are_counted_evenly_in_the_inverse_of_depth_and_beyond(descending: bool) -> None:
    z_um = Z_UM[::-1] if descending else Z_UM
    made = camera(z_um)
    for number in (0, 1, 2, 3):
        assert made.depth_um(number) == pytest.approx(z_um[number])
        assert made.plane_of(z_um[number]) == pytest.approx(number)
    for plane in (-0.5, 0.25, 1.5, 2.75, 3.5):
        expected = 1 / np.interp(
            plane, [-1, 4], 1 / z_um[0] + (1 / z_um[1] - 1 / z_um[0]) * np.array([-1, 4])
        )
        assert made.depth_um(plane) == pytest.approx(expected)
        assert made.plane_of(expected) == pytest.approx(plane)
    places = np.array([[-2.0, 7.0, -8.0], [1.2, 7.0, -8.0], [9.0, 0.0, 0.0]])
    np.testing.assert_array_equal(made.within(places), [[-0.5, 7, -8], [1.2, 7, -8], [3.5, 0, 0]])


def test_between_uneven_depths_planes_are_counted_evenly_in_the_inverse() -> None:
    z_um = np.array([1e4, 1.4e4, 2e4, 2.1e4])
    made = camera(z_um)
    for plane, first, share in ((0.5, 0, 0.5), (1.25, 1, 0.25), (2.5, 2, 0.5), (3, 2, 1), (3.5, 2, 1.5)):
        near = (1 - share) / z_um[first] + share / z_um[first + 1]
        assert made.depth_um(plane) == pytest.approx(1 / near)
        assert made.plane_of(1 / near) == pytest.approx(plane)


@pytest.mark.parametrize("descending", [False, True])
@pytest.mark.parametrize(("plane", "off"), [(0.0, 2e-3), (2.0, 2e-3), (0.5, 0.08), (1.6, 0.08), (2.25, 0.08)])
def test_a_point_between_planes_looks_like_one_there(plane: float, off: float, descending: bool) -> None:
    z_um = Z_UM[::-1] if descending else Z_UM
    made = camera(z_um)
    patch, where = made.patch(np.array([plane, 2.3, -1.4]))
    image = np.zeros((SIZE, SIZE), np.float32)
    image[where] = patch[0]
    true = seen(2.3, -1.4, made.depth_um(plane))
    assert np.linalg.norm(image - true) < off * np.linalg.norm(true)
    whole = made.image(Points(np.array([[plane, 2.3, -1.4]]), np.array([3.0])))
    np.testing.assert_allclose(whole, 3 * image, atol=1e-4)


def test_between_made_ones_patterns_are_mixed_evenly() -> None:
    made = camera()
    before, between, after = (made.patch(np.array([plane, 2.0, -1.0]))[0][0] for plane in (1.25, 1.3125, 1.5))
    np.testing.assert_allclose(between, 0.75 * before + 0.25 * after, atol=1e-5)


def test_slopes_are_those_of_the_image_along_plane_row_and_column() -> None:
    made = camera()
    place = np.array([1.4, 1.3, -0.8])
    patch, where = made.patch(place, slopes=True)
    assert len(patch) == 4
    assert len(made.patch(place)[0]) == 1
    for axis, h in enumerate((0.02, 0.01, 0.01)):
        ahead, behind = (made.patch(place + sign * h * np.eye(3)[axis]) for sign in (1, -1))
        assert ahead[1] == behind[1] == where
        change = (ahead[0][0] - behind[0][0]) / (2 * h)
        np.testing.assert_allclose(patch[1 + axis], change, atol=0.01 * np.abs(change).max())


def test_few_of_the_made_ones_are_kept_and_all_are_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recon.camera.points_in_depth.KEPT_BYTES", 0)
    one, other = camera(), camera()
    planes = np.repeat([0.3, 2.6, 0.3, 1.1], 2)
    for plane in planes:
        np.testing.assert_array_equal(one._made(round(plane * STEPS)), other._make(round(plane * STEPS)))
        assert len(one._kept) <= 2


def test_no_more_are_kept_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    room = int(3.5 * camera().psfs[0].nbytes)
    monkeypatch.setattr("recon.camera.points_in_depth.KEPT_BYTES", room)
    one = camera()
    for step in range(6):
        one._made(step)
    assert len(one._kept) == 3
    assert sum(psf.nbytes for psf in one._kept.values()) <= room


@pytest.mark.parametrize("axis", [None, np.array([[0.0, 0], [50, -20], [100, -40], [150, -60]])])
def test_rays_lead_to_the_scene_and_back(axis: np.ndarray | None) -> None:
    grid = Grid(
        (4, SIZE, SIZE), (SIZE // 2, SIZE // 2), Z_UM, PITCH_UM * Z_UM / DISTANCE_UM, PITCH_UM, axis_um=axis
    )
    rays = Rays(grid, camera())
    for number in (0, 1, 3):
        middle = np.zeros(2) if axis is None else axis[number]
        found = rays.um_of(np.array([number, 0.0, 0.0]))
        np.testing.assert_allclose(found, [*middle, Z_UM[number]], atol=1e-9)
        beside = rays.um_of(np.array([number, 2.0, -3.0]))
        pitch = PITCH_UM * Z_UM[number] / DISTANCE_UM
        np.testing.assert_allclose(beside, [middle[0] + 3 * pitch, middle[1] - 2 * pitch, Z_UM[number]])
    for place in ([0.4, 3.0, -2.0], [2.5, -1.0, 5.0], [3.3, 1.0, 1.0]):
        np.testing.assert_allclose(rays.place_of(rays.um_of(np.array(place))), place, atol=1e-9)
    place = np.array([1.4, 3.0, -2.0])
    slopes = rays.slopes_of(place)
    for k, h in enumerate((1e-3, 1e-2, 1e-2)):
        move = h * np.eye(3)[k]
        change = (rays.um_of(place + move) - rays.um_of(place - move)) / (2 * h)
        np.testing.assert_allclose(slopes[:, k], change, rtol=1e-3, atol=1e-6)
