"""Points of a volume fitted to the photograph, against a scene in closed form: Gaussian spots of lenslets."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from recon.analysis.point_places import PointPlaces, point_places, voxels_of
from recon.camera import point_fit, points_in_depth
from recon.camera.grid import Grid
from recon.camera.points_in_depth import ImagesInDepth
from recon.errors import InputError
from recon.reconstruction import point_errors
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.point_errors import fitted_places
from recon.types import Calibration, Geometry

SIZE, PITCH_UM, DISTANCE_UM = 64, 10.0, 2000.0
PLANES_UM = 1 / np.linspace(1 / 10e3, 1 / 20e3, 4)
LENSES = np.random.default_rng(3).uniform(-12, 12, (14, 2))
GRID = Grid((4, SIZE, SIZE), (SIZE // 2, SIZE // 2), PLANES_UM, PITCH_UM * PLANES_UM / DISTANCE_UM, PITCH_UM)
CALIBRATION: Calibration
TRUE = np.array([[2.0, 1.0, 10.9], [-6.3, 4.2, 14.7], [9.1, -7.4, 17.4]])
"""Row and column from the axis, millimetres of depth."""
LIGHT = np.array([900.0, 700.0, 1500.0])


def seen(row: float, column: float, z_um: float) -> np.ndarray:
    """Return what the sensor sees of a point: lenslets' spots, apart as far as the depth has them."""
    at = np.arange(SIZE) - SIZE // 2
    rows, columns = (LENSES * (1 + 3 * DISTANCE_UM / z_um) + [row, column]).T
    spots = [np.exp(-((at - one) ** 2) / 3.0)[:, None] * np.exp(-((at - other) ** 2) / 3.0)
             for one, other in zip(rows, columns, strict=True)]  # fmt: skip
    return np.sum(spots, axis=0, dtype=np.float64).astype(np.float32)


CALIBRATION = Calibration(
    np.stack([seen(0, 0, z) for z in PLANES_UM])[:, None],
    np.column_stack([0 * PLANES_UM, 0 * PLANES_UM, PLANES_UM]),
    geometry=Geometry(PITCH_UM, DISTANCE_UM / 1e3),
)


def photograph(noise: float = 1.0) -> np.ndarray:
    """Return the scene with noise."""
    light = sum(a * seen(r, c, 1e3 * z) for a, (r, c, z) in zip(LIGHT, TRUE, strict=True))
    return np.asarray(light + np.random.default_rng(0).normal(0, noise, light.shape), np.float32)


def true_um() -> np.ndarray:
    """Return where the points are."""
    return np.array([(*(-np.array([c, r]) * PITCH_UM / DISTANCE_UM * 1e3 * z), 1e3 * z) for r, c, z in TRUE])


def beside(more: float = 0.0) -> PointPlaces:
    """Return the places a volume may tell: on the nearest plane and pixel; one of these where nothing is."""
    voxels = np.zeros(GRID.shape, np.float32)
    for (row, column, z), light in zip(TRUE, LIGHT, strict=True):
        plane = int(np.abs(1 / PLANES_UM - 1e-3 / z).argmin())
        voxels[plane, round(row) + SIZE // 2, round(column) + SIZE // 2] = light
    voxels[1, 20, 20] = more
    return point_places(voxels, GRID)


def test_places_between_planes_and_pixels_are_found_by_the_photograph() -> None:
    start = beside(more=300.0)
    steps: list[float] = []
    found = fitted_places(start, GRID, photograph(), CALIBRATION, on_progress=steps.append)
    assert len(start) == 4
    assert len(found) == 3, "a point that is not there is left out"
    order = np.argsort(-LIGHT)
    off = found.places_um - true_um()[order]
    assert np.abs(off[:, 2]).max() < 0.05 * 2e3, "a twentieth of the nearest planes' distance"
    assert np.abs(off[:, :2]).max() < 15, "a quarter of a pixel of 60 um"
    np.testing.assert_allclose(found.light, LIGHT[order], rtol=0.1)
    assert (found.deviations_um > 0).all()
    assert found.misfit is not None
    assert found.misfit < 3
    worst = np.abs(start.places_um[:, 2][:, None] - true_um()[:, 2]).min(axis=1).max()
    assert worst > 600, "what the volume has them off by"
    plane = np.interp(1 / true_um()[order, 2], 1 / PLANES_UM[::-1], np.arange(4.0)[::-1])
    np.testing.assert_allclose(found.voxels[:, 0], plane, atol=0.05)
    assert steps[0] == 0
    assert max(steps) < 1


def test_places_and_patterns_change_as_their_slopes_say() -> None:
    camera = ImagesInDepth(PLANES_UM, CALIBRATION.psfs[:, 0], DISTANCE_UM, (SIZE, SIZE))
    for z in (9.5e3, 12.3e3, 20e3, 21e3):
        assert camera.depth_um(camera.plane_of(z)) == pytest.approx(z)
    place = np.array([1.35, 2.2, -3.4])
    patch, where = camera.patch(place, slopes=True)
    for axis in range(3):
        by = 1e-2 * np.eye(3)[axis]
        whole = [np.zeros((SIZE, SIZE)) for _ in range(3)]
        for image, at in zip(whole, (place - by, place + by), strict=False):
            near, there = camera.patch(at)
            image[there] = near[0]
        whole[2][where] = patch[1 + axis]
        slope = (whole[1] - whole[0]) / 2e-2
        assert np.linalg.norm(slope - whole[2]) < 0.02 * np.linalg.norm(slope)
    assert camera.within(np.array([[-3.0, 1, 1], [9.0, 1, 1]]))[:, 0].tolist() == [-0.5, 3.5]


def test_what_cannot_be_fitted_is_said() -> None:
    image, start = photograph(), beside()
    colour = np.repeat(image[..., None], 3, axis=2)
    nowhere = replace(start, places_um=np.full((3, 3), np.nan))
    many = replace(CALIBRATION, psfs=CALIBRATION.psfs[[0, 0, 1]],
                   source_positions_um=np.array([[0, 0, 1e4], [300, 0, 1e4], [0, 0, 2e4]]))  # fmt: skip
    for found, seen_, calibration, words in (
        (nowhere, image, CALIBRATION, "the volume knows its places"),
        (start, colour, CALIBRATION, "grey photographs"),
        (start, image, replace(CALIBRATION, geometry=Geometry(PITCH_UM, None)), "diffuser_distance_mm"),
        (start, image, many, "vary over the field"),
        (start, image, CALIBRATION.part([0]), "two known depths"),
        (point_places(np.zeros(GRID.shape), GRID), image, CALIBRATION, "no points to be fitted"),
    ):
        with pytest.raises(InputError, match=words):
            fitted_places(found, GRID, seen_, calibration)


def test_what_is_left_is_judged_by_the_points_light() -> None:
    """Bright photographs leave many times their noise; a point that is missing leaves much of the light."""
    bright = photograph() * np.float32(9)
    found = fitted_places(beside(), GRID, Measurement(bright, noise=9.0), CALIBRATION)
    assert found.misfit is not None
    assert found.misfit > 2
    assert found.unexplained == pytest.approx(0.018, abs=0.01)
    fewer = fitted_places(beside()._first(2), GRID, Measurement(bright, noise=9.0), CALIBRATION)
    assert fewer.unexplained is not None
    assert fewer.unexplained > 0.1
    assert len(beside().of_at_least(0.5)) == 2
    assert len(beside().of_at_least(1.0)) == 1


def test_planes_go_on_beyond_the_outermost_as_the_fit_counts_them() -> None:
    camera = ImagesInDepth(PLANES_UM, CALIBRATION.psfs[:, 0], DISTANCE_UM, (SIZE, SIZE))
    for z in (9.6e3, 10e3, 13e3, 20e3, 21e3):
        plane, row, _ = voxels_of(np.array([[0.0, 300.0, z]]), GRID)[0]
        assert plane == pytest.approx(camera.plane_of(z), abs=1e-9)
        assert row == pytest.approx(SIZE // 2 - 300 / z * DISTANCE_UM / PITCH_UM)
    assert camera.plane_of(9.6e3) < 0
    assert camera.plane_of(21e3) > 3


def test_memory_is_what_the_limit_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    start = beside()
    of = np.arange(60) % 3
    many = replace(
        start, places_um=start.places_um[of] + np.random.default_rng(1).normal(0, (300, 300, 800), (60, 3)),
        deviations_um=start.deviations_um[of], voxels=start.voxels[of], light=start.light[of],
        at_end=start.at_end[of],
    )  # fmt: skip
    counted = 60 * 4 * 4 * SIZE**2 * point_fit.HELD
    fitted_places(start, GRID, photograph(), CALIBRATION)  # imports once
    tracemalloc.start()
    fitted_places(many, GRID, Measurement(photograph(), noise=1.0), CALIBRATION)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.3 * counted
    monkeypatch.setattr(point_errors, "MOST_BYTES", counted)
    fitted_places(start, GRID, photograph(), CALIBRATION)
    monkeypatch.setattr(point_errors, "MOST_BYTES", counted // 30)
    with pytest.raises(InputError, match="more than are fitted together, 2: take the places in the volume"):
        fitted_places(start, GRID, photograph(), CALIBRATION)


def test_few_patterns_made_between_planes_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = []
    for kept in (2**28, 0):
        monkeypatch.setattr(points_in_depth, "KEPT_BYTES", kept)
        cameras.append(ImagesInDepth(PLANES_UM, CALIBRATION.psfs[:, 0], DISTANCE_UM, (SIZE, SIZE)))
    for plane in (0.3, 1.7, 0.3, 2.6):
        patches = [camera.patch(np.array([plane, 0.2, 0.0]))[0] for camera in cameras]
        np.testing.assert_array_equal(*patches)
    assert [len(camera._kept) for camera in cameras] == [6, 2]
