"""Beads as points between pixels: the map, its bound, the fit of places, and PSFs on their support."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from recon.blind import BlindSettings, calibrate_from_beads
from recon.blind.points import PointMixer, solve_smooth, support_of
from recon.camera.points import (
    FieldFunctions,
    PointImages,
    Points,
    cleaned,
    overlooked,
    points_on_grid,
    refine,
)
from recon.errors import InputError

SENSOR, PSF = (40, 44), (19, 17)
RNG = np.random.default_rng(0)
PLACES = RNG.uniform(-12, 12, (24, 2))
SPOTS = [(RNG.uniform(-5, 5), RNG.uniform(-4, 4)) for _ in range(5)]


def spots(shape: tuple[int, int], row: float, column: float, width: float = 1.1) -> np.ndarray:
    """One pattern of Gaussian spots about a place between pixels."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    y, x = y - shape[0] // 2 - row, x - shape[1] // 2 - column
    return sum(np.exp(-((y - r) ** 2 + (x - c) ** 2) / (2 * width**2)) for r, c in SPOTS)  # type: ignore[return-value]


def slide(rng: np.random.Generator, count: int = 6, noise: float = 0.01) -> tuple[np.ndarray, Points]:
    places = rng.uniform(-10, 10, (count, 2))
    light = rng.uniform(0.5, 1, count)
    image = sum(a * spots(SENSOR, *place) for a, place in zip(light, places, strict=True))
    return (image + rng.normal(0, noise, SENSOR)).astype(np.float32), Points(places, light)


def one_psf() -> tuple[np.ndarray, FieldFunctions]:
    return spots(PSF, 0, 0).astype(np.float32)[None], FieldFunctions(0, PLACES)


def test_the_field_functions_are_orthonormal_and_stay_within_what_was_measured() -> None:
    functions = FieldFunctions(2, PLACES)
    values = functions.at(PLACES)
    assert functions.count == 6
    np.testing.assert_allclose(values.T @ values / len(PLACES), np.eye(6), atol=1e-10)
    np.testing.assert_allclose(values[:, 0], 1)
    corner = PLACES.max(axis=0)
    np.testing.assert_allclose(functions.at(corner[None] + 100), functions.at(corner[None]))


def test_the_mixer_is_what_points_look_like_and_its_bound_holds() -> None:
    functions = FieldFunctions(1, PLACES)
    psfs = np.stack([spots(PSF, *by, width=1.3) for by in ((0, 0), (1, 0), (0, -1))]).astype(np.float32)
    beads = [Points(PLACES[:9], RNG.uniform(0.5, 1, 9)), Points(PLACES[9:14], RNG.uniform(0.5, 1, 5))]
    mixer = PointMixer(beads, functions, PSF, SENSOR)
    seen = mixer.forward(psfs)
    camera = PointImages(psfs, functions, SENSOR)
    for image, points in zip(seen, beads, strict=True):
        direct = camera.image(points)
        assert np.linalg.norm(image - direct) < 0.01 * np.linalg.norm(direct)  # the tails of a shift, no more
    images = RNG.normal(size=seen.shape).astype(np.float32)
    assert np.vdot(seen, images) == pytest.approx(np.vdot(psfs, mixer.adjoint(images)), rel=1e-4)
    x = psfs
    for _ in range(60):
        x = mixer.adjoint(mixer.forward(x / np.float32(np.linalg.norm(x))))
    assert 0.3 * mixer.lipschitz < np.linalg.norm(x) <= mixer.lipschitz * (1 + 1e-5)


def test_places_between_pixels_are_found() -> None:
    image, truth = slide(np.random.default_rng(1))
    psfs, functions = one_psf()
    camera = PointImages(psfs, functions, SENSOR)
    start = Points(truth.places + RNG.uniform(-0.6, 0.6, truth.places.shape), np.full(6, 0.7))
    found, left = refine(camera, image, start, sweeps=8)
    assert np.abs(found.places - truth.places).max() < 0.05
    assert found.light == pytest.approx(truth.light, abs=0.05)
    assert left.std() == pytest.approx(0.01, rel=0.15)
    np.testing.assert_allclose(left, image - camera.image(found), atol=1e-4)


def test_a_point_that_the_sensor_does_not_see_stays_as_it_is() -> None:
    psfs, functions = one_psf()
    camera = PointImages(psfs, functions, SENSOR)
    beyond = Points(np.array([[200.0, 3.0]]), np.array([0.7]))
    image = slide(np.random.default_rng(1))[0]
    found, left = refine(camera, image, beyond)
    assert (found.places.tolist(), found.light.tolist()) == ([[200.0, 3.0]], [0.7])
    np.testing.assert_array_equal(left, image)


def test_beads_that_were_overlooked_are_added_and_ghosts_dropped() -> None:
    image, truth = slide(np.random.default_rng(2))
    psfs, functions = one_psf()
    camera = PointImages(psfs, functions, SENSOR)
    ghost = Points(np.append(truth.places[1:], [[3.3, -9.0]], axis=0), np.append(truth.light[1:], 0.02))
    found, left = refine(camera, image, ghost)
    found = cleaned(camera, found, 0.01)
    more = overlooked(camera, left, found, 0.01)
    more = cleaned(camera, refine(camera, image, more, sweeps=6)[0], 0.01)
    assert len(more) == len(truth)
    nearest = np.hypot(*(more.places[:, None] - truth.places[None]).transpose(2, 0, 1)).min(axis=0)
    assert nearest.max() < 0.2


def test_psfs_are_fitted_on_their_support_only() -> None:
    rng = np.random.default_rng(3)
    slides = [slide(rng, 5, 0.03) for _ in range(6)]
    data = np.stack([image for image, _ in slides])
    beads = [points for _, points in slides]
    mixer = PointMixer(beads, FieldFunctions(0, PLACES), PSF, SENSOR)
    free, _ = solve_smooth(mixer, data, np.zeros((1, *PSF), np.float32), None, 150)
    support = support_of(free[0])
    truth = spots(PSF, 0, 0)
    assert truth[support].sum() > 0.95 * truth.sum()
    assert support.mean() < 0.75
    kept, _ = solve_smooth(mixer, data, free, support, 150)
    assert not kept[0][~support].any()
    assert np.linalg.norm(kept[0] - truth) < np.linalg.norm(free[0] - truth)
    assert np.linalg.norm(kept[0] - truth) < 0.1 * np.linalg.norm(truth)


QUICK = BlindSettings(grid=(2, 2), ranks=(1,), iterations=30, degree=1, reach=0.4)


def test_the_whole_way_finds_every_bead_between_pixels() -> None:
    rng = np.random.default_rng(4)
    slides = [slide(rng, 4) for _ in range(8)]
    told: list[float] = []
    found = calibrate_from_beads(
        np.stack([image for image, _ in slides]), PSF, QUICK, on_progress=lambda _, share: told.append(share)
    )
    assert told == sorted(told)
    assert len(told) > 10
    assert found.point_misfits[-1] < found.misfits[-1]
    away = [
        points.places[:, None] - truth.places[None]
        for points, (_, truth) in zip(found.beads, slides, strict=True)
    ]
    nearest = np.concatenate([a[np.hypot(*a.transpose(2, 0, 1)).argmin(axis=0), range(4)] for a in away])
    offset = np.median(nearest, axis=0)  # where zero lies is a convention
    errors = np.concatenate([np.hypot(*(a - offset).transpose(2, 0, 1)).min(axis=0) for a in away])
    assert np.quantile(errors, 0.9) < 0.1


def test_photographs_that_cannot_be_moved_slides_of_beads_are_refused() -> None:
    rng = np.random.default_rng(5)
    first, points = slide(rng)
    second, _ = slide(rng)
    with pytest.raises(InputError, match="Images 1 and 3 are the same"):
        calibrate_from_beads(np.stack([first, second, first]), PSF, QUICK)
    again = sum(a * spots(SENSOR, *p) for a, p in zip(points.light, points.places, strict=True))
    again = again + rng.normal(0, 0.01, SENSOR)
    with pytest.raises(InputError, match="Images 1 and 3 show the same beads"):
        calibrate_from_beads(np.stack([first, second, again]), PSF, QUICK)
    with pytest.raises(InputError, match="beads found explain"):
        calibrate_from_beads(rng.normal(1, 0.5, (3, *SENSOR)).astype(np.float32), PSF, QUICK)
    texture = np.stack([ndimage.gaussian_filter(rng.random((56, 60)), 1) for _ in range(3)])
    with pytest.raises(InputError, match="beads found explain"):
        calibrate_from_beads((texture - texture.min()).astype(np.float32), PSF, QUICK)


def test_places_and_lights_are_to_rounding_what_they_were() -> None:
    """Of points on a grid, of one that was overlooked, and of one step of refinement."""
    beads = np.zeros((40, 44))
    for row, column, light in ((9.3, 12.8, 1.0), (25.6, 30.1, 0.7), (30.2, 8.4, 0.05)):
        y, x = np.mgrid[:40, :44]
        beads += light * np.exp(-((y - row) ** 2 + (x - column) ** 2) / 2)
    found = points_on_grid(beads, (20, 22))
    np.testing.assert_allclose(found.places, [[-10.7241917, -9.1844216], [5.6337877, 8.0923761]], atol=1e-6)
    np.testing.assert_allclose(found.light, [6.1378295, 4.2890393], rtol=1e-6)
    psfs, functions = one_psf()
    camera = PointImages(psfs, functions, SENSOR)
    true = Points(np.array([[-4.0, 6.0], [7.0, -9.0]]), np.array([1.0, 0.8]))
    image = camera.image(true)
    first = Points(true.places[:1], true.light[:1])
    seen = overlooked(camera, image - camera.image(first), first, 0.01)
    (brightest,) = (
        np.flatnonzero(seen.light[1:] == seen.light[1:].max()) + 1
    )  # the pattern is like itself moved
    np.testing.assert_allclose(seen.places[[0, brightest]], true.places, atol=1e-6)
    np.testing.assert_allclose(seen.light[[0, brightest]], true.light, rtol=1e-4)
    near = Points(true.places + 0.3, true.light * 0.9)
    better, left = refine(camera, image, near, sweeps=1)
    np.testing.assert_allclose(better.places, [[-4.0198026, 5.9779425], [6.9801993, -9.0220617]], atol=1e-4)
    np.testing.assert_allclose(better.light, [0.9998344, 0.7998681], rtol=1e-4)
    assert float(np.abs(left).max()) == pytest.approx(0.0238375, rel=1e-3)
