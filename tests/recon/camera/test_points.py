"""Points of an image, one rule at a time: who is one with whom, who is too dim, who was overlooked."""

from __future__ import annotations

import numpy as np
import pytest

from recon.camera.points import (
    MOST,
    FieldFunctions,
    PointImages,
    Points,
    _fitted,
    _refined,
    cleaned,
    overlooked,
    points_on_grid,
)

SENSOR = (30, 34)
RNG = np.random.default_rng(2)
BEADS = RNG.uniform(-8, 8, (12, 2))


def camera(psf: np.ndarray | None = None, degree: int = 0) -> PointImages:
    """Return a camera whose PSF is by default a pixel and one of half its light beside it."""
    functions = FieldFunctions(degree, BEADS)
    if psf is None:
        psf = np.zeros((functions.count, 5, 5), np.float32)
        psf[0, 2, 2], psf[0, 2, 3] = 0.8, 0.4
    return PointImages(psf.astype(np.float32), functions, SENSOR)


def points(*given: tuple[float, float, float]) -> Points:
    table = np.array(given, np.float64).reshape(-1, 3)
    return Points(table[:, :2], table[:, 2])


def listed(found: Points) -> list[tuple[float, ...]]:
    return [
        (*map(float, place), float(light)) for place, light in zip(found.places, found.light, strict=True)
    ]


def test_a_point_lies_where_it_is_and_is_cut_to_the_sensor() -> None:
    for place in ((0, 0), (3, -4), (-15, 0), (0, 16), (14, -17)):
        seen = camera().image(points((*place, 2.0)))
        expected = np.zeros(SENSOR)
        for column, light in ((17 + place[1], 1.6), (18 + place[1], 0.8)):
            if 0 <= 15 + place[0] < 30 and 0 <= column < 34:
                expected[15 + place[0], column] = light
        np.testing.assert_allclose(seen, expected, atol=1e-6)
    patch, (rows, columns) = camera().patch(np.array([-15.0, 16.0]))
    assert patch.shape == (1, rows.stop - rows.start, columns.stop - columns.start)
    assert (rows.start, columns.stop) == (0, 34)


def test_slopes_are_those_of_the_image() -> None:
    smooth = np.exp(-((np.mgrid[:13, :13] - 6) ** 2).sum(axis=0) / 8)[None]
    seen = camera(np.concatenate([smooth, 0.1 * smooth, -0.2 * smooth]), degree=1)
    constant = FieldFunctions(0, BEADS)
    seen._functions.at = lambda places: np.repeat(constant.at(places), 3, axis=1)  # type: ignore[method-assign]
    place, h = np.array([1.3, -2.2]), 1e-2
    patch, where = seen.patch(place, slopes=True)
    for axis in (0, 1):
        move = h * np.eye(2)[axis]
        ahead, behind = (seen.patch(place + sign * move) for sign in (1, -1))
        assert ahead[1] == behind[1] == where
        np.testing.assert_allclose(patch[1 + axis], (ahead[0][0] - behind[0][0]) / (2 * h), atol=2e-3)


def test_the_light_that_fits_is_never_negative() -> None:
    patch, data = np.array([3.0, 4.0], np.float32), np.array([1.0, 3.0], np.float32)
    assert _fitted(patch, data) == pytest.approx((15 / 25, 15**2 / 25))
    assert _fitted(patch, -data) == (0.0, 0.0)
    assert _fitted(0 * patch, data) == (0.0, 0.0)
    assert _fitted(0.1 * patch, data) == pytest.approx((10 * 15 / 25, 15**2 / 25))  # however dim the PSF


def test_points_that_are_one_are_merged_into_the_brighter_and_dim_ones_go() -> None:
    found = cleaned(
        camera(), points((0, 0, 1.0), (0.5, 0.4, 2.0), (0, 0.71, 0.25), (9, 9, 1.0), (5, 5, 0.14)), 0.0
    )
    assert listed(found) == [(0.5, 0.4, 3.25), (9.0, 9.0, 1.0)]
    apart = cleaned(camera(), points((0, 0, 1.0), (0, 0.71, 1.0), (0.7, 0.0, 1.0)), 0.0)
    assert len(apart) == 3
    assert len(cleaned(camera(), points((0, 0, 1.0), (0, 0.69, 1.0)), 0.0)) == 1
    at_least = cleaned(camera(), points((0, 0, 1.0), (5, 0, 1.0), (9, 0, 0.25)), 0.0, weakest=0.25)
    assert len(at_least) == 3
    assert len(cleaned(camera(), points((0, 0, 1.0), (5, 0, 1.0), (9, 0, 0.249)), 0.0, weakest=0.25)) == 2
    psf_norm = float(np.hypot(0.8, 0.4))
    sure = 5 * 0.1 / psf_norm
    some = points((0, 0, 1.01 * sure), (5, 0, 0.99 * sure), (9, 0, 2 * sure))
    assert [light for *_, light in listed(cleaned(camera(), some, 0.1))] == pytest.approx(
        [2 * sure, 1.01 * sure]
    )
    bright = points(*((0, 5 * k, light) for k, light in enumerate((4, 4, 4, 4, 0.7, 0.5))))
    assert cleaned(camera(), bright, 0.0).light.tolist() == [4, 4, 4, 4, 0.7], "0.15 of the median light"
    assert len(cleaned(camera(), points(), 0.1)) == 0
    assert cleaned(camera(), points((0, 0, 0.1)), 1e3).places.shape == (0, 2)


def test_what_stands_out_of_what_is_left_is_added_unless_it_is_dim_or_near() -> None:
    seen, energy = camera(), 0.8**2 + 0.4**2
    known = points((-10, -10, 1.0), (10, 10, 1.0))
    left = seen.image(points((3, 4, 0.9), (-6, 8, 0.5)))
    more = overlooked(seen, left, known, 0.0)
    assert listed(more)[:2] == listed(known)
    assert sorted(listed(more)[2:]) == [pytest.approx((-6, 8, 0.5)), pytest.approx((3, 4, 0.9))]
    dim = overlooked(seen, seen.image(points((3, 4, 0.29))), known, 0.0)
    assert dim is known, "0.3 of the median light is asked for"
    assert len(overlooked(seen, seen.image(points((3, 4, 0.31))), known, 0.0)) == 3
    for light, count in ((1.01, 3), (0.99, 2)):
        noise = 0.1
        sure = 5 * noise / energy**0.5
        assert sure > 0.3
        assert len(overlooked(seen, seen.image(points((3, 4, light * sure))), known, noise)) == count
    near = points((3, 4 + 1.39, 1.0), (10, 10, 1.0))
    assert overlooked(seen, left * 0 + seen.image(points((3, 4, 0.9))), near, 0.0) is near
    beside = points((3, 4 + 1.41, 1.0), (10, 10, 1.0))
    assert len(overlooked(seen, seen.image(points((3, 4, 0.9))), beside, 0.0)) == 3
    two = overlooked(seen, seen.image(points((3, 4, 0.9), (3, 6, 0.8))), known, 0.0)
    assert len(two) == 3, "of peaks within two pixels the higher"
    assert len(overlooked(seen, seen.image(points((3, 4, 0.9), (3, 7, 0.8))), known, 0.0)) == 4
    for edge in ((-14, -16), (14, 14), (-14, 15)):
        (*_, found) = listed(overlooked(seen, seen.image(points((*edge, 0.9))), known, 0.0))
        assert found == pytest.approx((*edge, 0.9), abs=1e-5)
    none = points()
    assert overlooked(seen, left, none, 0.0) is none
    dark = camera(np.zeros((1, 5, 5)))
    assert overlooked(dark, left, known, 0.0) is known


def test_blobs_on_a_grid_are_points_at_their_centroids_the_brightest_first() -> None:
    beads = np.zeros((40, 50))
    beads[10, 20], beads[11, 20], beads[10, 22] = 4.0, 2.0, 1.0
    beads[30, 7] = 9.0
    beads[5, 40] = 0.9  # a tenth of the brightest, no more
    beads[1, 30] = beads[38, 30] = beads[20, 1] = beads[20, 48] = 5.0  # at the border
    found = points_on_grid(beads, (20, 25))
    assert listed(found) == [
        (10.0, -18.0, 9.0),
        (pytest.approx(-10 + 2 / 7), pytest.approx(-5 + 2 / 7), 7.0),
    ]
    beads[5, 40], beads[2, 30], beads[37, 30], beads[25, 2], beads[25, 47] = 0.91, 5.0, 5.1, 5.2, 5.3
    assert len(points_on_grid(beads, (20, 25))) == 7
    assert len(points_on_grid(beads, (20, 25), least=0.5)) == 5
    apart = np.zeros((40, 50))
    apart[[10, 13, 16], 20], apart[25, [20, 23, 26]] = (3, 2, 3), (3, 2, 3)  # three pixels from each other
    assert len(points_on_grid(apart, (20, 25))) == 6
    many = np.zeros((70, 70))
    many[4:66:5, 4:66:5] = 1 + RNG.random((13, 13))
    kept = points_on_grid(many, (0, 0))
    assert len(kept) == MOST
    assert kept.light.tolist() == sorted(many[many > 0], reverse=True)[:MOST]
    assert points_on_grid(np.zeros((9, 9)), (4, 4)).places.shape == (0, 2)


def test_a_point_moves_half_a_pixel_at_once_at_most() -> None:
    wide = np.exp(-((np.mgrid[:21, :21] - 10) ** 2).sum(axis=0) / 12)[None]
    seen = camera(wide)
    image = seen.image(points((2.0, 0.0, 1.0)))
    place, light = _refined(seen, image - seen.image(points((0, 0, 0.9))), np.zeros(2), 0.9)
    assert place[0] == pytest.approx(0.5)
    assert abs(place[1]) < 0.01
    assert light > 0.85
    for light in (1.0, 0.1, 20.0):
        left = seen.image(points((0.2, 0.0, light))) - seen.image(points((0, 0, light)))
        near, _ = _refined(seen, left, np.zeros(2), light)
        assert near[0] == pytest.approx(0.2, abs=0.02)
    left = seen.image(points((0.2, 0.0, 1.0))) - seen.image(points((0, 0, 1.0)))
    tried: list[np.ndarray] = []
    patch = seen.patch
    seen.patch = lambda place, **how: tried.append(place) or patch(place, **how)  # type: ignore[method-assign, func-returns-value]
    _refined(seen, left, np.zeros(2), 1.0)
    assert len(tried) == 2, "a move that gained is made, and no other tried"


def test_a_move_that_gains_nothing_is_halved_twice_and_given_up() -> None:
    rng = np.random.default_rng(0)
    tried: list[np.ndarray] = []
    here = rng.standard_normal((3, 4, 5)).astype(np.float32)
    where = slice(0, 4), slice(0, 5)

    class Nowhere:
        def patch(self, place: np.ndarray, *, slopes: bool = False) -> tuple[np.ndarray, tuple[slice, slice]]:
            if slopes:
                return here, where
            tried.append(place - start)
            return np.zeros((1, 4, 5), np.float32), where

    start, data = np.array([3.0, -2.0]), rng.standard_normal((4, 5)).astype(np.float32)
    data += np.float32(3) * here[0]
    left = data - np.float32(0.5) * here[0]
    place, light = _refined(Nowhere(), left, start, 0.5)  # type: ignore[arg-type]
    np.testing.assert_array_equal(place, start)
    best = _fitted(here[0], data)[0]
    assert light == pytest.approx(best, rel=1e-5)
    np.testing.assert_allclose(left, data - np.float32(best) * here[0], atol=1e-5)
    assert len(tried) == 3
    np.testing.assert_allclose(tried[1:], [tried[0] / 2, tried[0] / 4])
    assert np.abs(tried[0]).max() <= 0.5 + 1e-12


def test_functions_of_the_field_are_orthonormal_over_the_beads_and_stay_what_they_are_at_their_border() -> (
    None
):
    beads = np.array([[2.0, -30.0], [10.0, -30.0], [2.0, -11.0], [10.0, -11.0], [5.0, -20.0]])
    functions = FieldFunctions(1, beads)
    values = functions.at(beads)
    np.testing.assert_allclose(values.T @ values / 5, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(values[:, 0], 1)
    middle = functions.at(beads[[0, 3]].mean(axis=0)[None])
    np.testing.assert_allclose(middle[0], values[[0, 3]].mean(axis=0), atol=1e-12)
    quarter = functions.at(np.array([[4.0, -30.0]]))
    np.testing.assert_allclose(quarter[0], 0.75 * values[0] + 0.25 * values[1], atol=1e-12)
    beyond = functions.at(np.array([[99.0, -20.0], [5.0, -99.0]]))
    np.testing.assert_allclose(beyond, functions.at(np.array([[10.0, -20.0], [5.0, -30.0]])), atol=1e-12)


@pytest.mark.parametrize("shape", [(5, 8), (8, 5)])
def test_a_psf_may_have_any_sides(shape: tuple[int, int]) -> None:
    psf = RNG.random((1, *shape)).astype(np.float32)
    expected = np.zeros(SENSOR)
    top, left = 15 - shape[0] // 2, 17 - shape[1] // 2
    expected[top : top + shape[0], left : left + shape[1]] = 3 * psf[0]
    np.testing.assert_allclose(camera(psf).image(points((0, 0, 3.0))), expected, atol=1e-6)


def test_a_point_at_the_sensors_edge_is_found_though_its_light_and_place_tell_the_same() -> None:
    wide = np.exp(-((np.mgrid[:21, :21] - 10) ** 2).sum(axis=0) / 12)[None]
    seen = camera(wide)
    image = seen.image(points((-16.2, 3.0, 5.0)))
    place, light = np.array([-16.0, 3.0]), 4.0
    left = image - seen.image(points((*place, light)))
    for _ in range(2):
        place, light = _refined(seen, left, place, light)
    np.testing.assert_allclose(place, [-16.2, 3.0], atol=0.01)
    assert light == pytest.approx(5, rel=0.02)
    assert np.linalg.norm(left) < 0.01 * np.linalg.norm(image)


def test_a_point_that_the_sensor_does_not_see_stays_as_it_is() -> None:
    place, light = _refined(camera(), np.ones(SENSOR, np.float32), np.array([99.0, 0.0]), 2.0)
    assert (*place, light) == (99, 0, 2)


def test_a_blobs_place_is_its_centroid_along_each_side() -> None:
    beads = np.zeros((40, 50))
    beads[20, 30], beads[20, 31], beads[21, 30] = 6.0, 3.0, 1.0
    (found,) = listed(points_on_grid(beads, (20, 25)))
    assert found == pytest.approx((0.1, 5.3, 10.0))
