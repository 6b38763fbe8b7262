"""Patterns that are moved, enlarged, turned and mirrored: each point where it belongs, all light kept."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from recon.arrays import Float64Array
from recon.camera.transformed import Transformation, geometric_centre, resampled, transformed
from recon.errors import InputError

SHAPE = (60, 81)
MIDDLE = geometric_centre(np.empty(SHAPE))


def spots(places: npt.ArrayLike, width: float) -> Float64Array:
    """Gaussian spots of one unit of light each at (n, 2) places from the centre."""
    y, x = (np.arange(n) - c for n, c in zip(SHAPE, MIDDLE, strict=True))
    image = np.zeros(SHAPE)
    for row, column in np.atleast_2d(places):
        squares = (y[:, None] - row) ** 2 + (x - column) ** 2
        image += np.exp(-squares / (2 * width**2)) / (2 * np.pi * width**2)
    return image


@settings(max_examples=30, deadline=None)
@given(st.floats(-4, 4), st.floats(-4, 4), st.floats(0.6, 1.4), st.floats(-180, 180), st.booleans())
def test_every_point_goes_where_the_matrix_says_and_takes_its_light_along(
    rows: float, columns: float, scale: float, degrees: float, mirrored: bool
) -> None:
    how = Transformation(rows, columns, scale, degrees, mirrored)
    places = np.array([[0.0, 0.0], [6.0, -9.0], [-10.5, 2.0]])
    found = transformed(spots(places, 2.5)[None], how)[0]
    blur = 0.5 * np.sqrt(max(scale**-2 - 1, 0)) if scale < 1 else 0.0
    expected = spots(places @ how.matrix.T + [rows, columns], scale * np.hypot(2.5, blur))
    assert found.sum() == pytest.approx(3, rel=3e-3)
    assert np.abs(found - expected).max() < 0.02 * expected.max()


def test_mirrored_is_flipped_and_turned_goes_from_right_to_bottom() -> None:
    image = np.random.default_rng(0).random((2, 3, 20, 31))
    np.testing.assert_allclose(
        transformed(image, Transformation(mirrored=True)), image[..., ::-1], rtol=0, atol=1e-5
    )
    right = spots([0, 12], 2)
    bottom = transformed(right, Transformation(rotation_deg=90))
    assert np.unravel_index(bottom.argmax(), SHAPE) == np.unravel_index(spots([12, 0], 2).argmax(), SHAPE)


def test_zeros_come_in_and_no_negative_value_that_was_not_there() -> None:
    block = np.zeros((30, 30), np.float32)
    block[10:20, 10:20] = 1  # splines ring beside its edges
    for level, lowest in ((0.0, 0.0), (-1.0, -1.0)):
        moved = resampled(block + level, [1.0, 1.0], [0.5, 0.5])
        assert moved[2:-2, 2:-2].min() == lowest
    bright = resampled(block + 5, [1.0, 1.0], [4.0, 0.0])
    assert (bright[-3:] == 0).all()


def test_what_the_new_pixels_cannot_hold_is_taken_out() -> None:
    stripes = np.zeros((40, 40))
    stripes[:, ::2] = 1.0
    smaller = transformed(stripes, Transformation(scale=0.45))
    inside = smaller[16:24, 16:24]
    assert inside.std() < 0.1 * inside.mean()  # else a pattern that nobody cast


def test_a_transformation_that_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="scale is a positive number"):
        Transformation(scale=0.0)
    with pytest.raises(InputError, match="finite"):
        Transformation(rows=float("nan"))


def test_words() -> None:
    assert str(Transformation(0, -2.5, 1.02, -0.8)) == (
        "turned by -0.8 degrees, 2 % larger, moved by +0 rows and -2.5 columns"
    )
    assert str(Transformation(mirrored=True)) == "mirrored"


def test_a_shift_by_a_part_of_a_pixel_goes_by_cubic_splines() -> None:
    image = np.random.default_rng(0).random((12, 14)).astype(np.float32)
    expected = np.maximum(ndimage.shift(image, (-0.3, -0.4), order=3), 0)
    np.testing.assert_allclose(resampled(image, np.ones(2), np.array([0.3, 0.4])), expected, atol=1e-6)
