"""Factors of an operator by their definitions: erasures, mosaics, the fit of a background, patterns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from recon.camera.base import Composition
from recon.camera.convolution import Convolution
from recon.camera.factors import (
    PATTERNS,
    BackgroundRemoval,
    Erasures,
    PatternedCamera,
    as_cropped_convolution,
    interpolate_bayer,
    split_bayer,
)
from recon.errors import InputError, StructureError

RNG = np.random.default_rng(6)
COLOURS = {
    "RGGB": [[0, 1], [1, 2]],
    "GRBG": [[1, 0], [2, 1]],
    "GBRG": [[1, 2], [0, 1]],
    "BGGR": [[2, 1], [1, 0]],
}


def camera(n_channels: int = 1, depths: int | None = None) -> Convolution:
    psfs = RNG.random((n_channels, 4, 5) if depths is None else (depths, n_channels, 4, 5))
    return Convolution(psfs, (6, 7), n_channels=n_channels, dtype=np.float64)


def test_erased_pixels_are_zero_in_every_channel_or_in_theirs() -> None:
    valid, x = RNG.random((4, 5)) > 0.4, RNG.random((2, 4, 5)) + 1
    for mask in (valid, np.stack([valid, ~valid])):
        erasures = Erasures(mask, (2, 4, 5), np.float64)
        assert (erasures.domain_shape, erasures.range_shape, erasures.dtype) == (
            (2, 4, 5),
            (2, 4, 5),
            np.float64,
        )
        seen = erasures.forward(x)
        np.testing.assert_array_equal(seen, np.where(mask, x, 0))
        np.testing.assert_array_equal(erasures.adjoint(x), seen)
        out = np.empty_like(x)
        assert erasures.forward(x, out=out) is out
        np.testing.assert_array_equal(out, seen)
    assert Erasures(valid, (2, 4, 5)).forward(x).dtype == np.float32
    with pytest.raises(InputError, match=r"valid must be an array \(height, width\) or \(2, 4, 5\)"):
        Erasures(valid[:, :4], (2, 4, 5))


def test_a_cropped_convolution_is_told_through_all_its_erasures() -> None:
    picture = camera(2)
    assert as_cropped_convolution(picture).convolution is picture
    np.testing.assert_array_equal(as_cropped_convolution(picture).weight, np.ones((2, 6, 7)))
    one, other = RNG.random((2, 6, 7)) > 0.3, RNG.random((6, 7)) > 0.3
    erased = Erasures(other, (2, 6, 7), np.float64) @ (Erasures(one, (2, 6, 7), np.float64) @ picture)
    told = as_cropped_convolution(erased)
    assert told.convolution is picture
    np.testing.assert_array_equal(told.weight, one & other)
    assert told.weight.dtype == np.float64
    removal = BackgroundRemoval((2, 6, 7), (2, 2), dtype=np.float64)
    for no_picture in (Convolution(RNG.random((2, 1, 4, 5)), (6, 7)), removal, removal @ picture):
        with pytest.raises(StructureError, match="needs a Convolution of a picture"):
            as_cropped_convolution(no_picture)
    assert isinstance(removal @ picture, Composition)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_each_pixel_of_a_mosaic_has_the_colour_that_its_place_says(pattern: str) -> None:
    raw = RNG.integers(1, 99, (5, 6)).astype(np.uint16)
    image, erasures = split_bayer(raw, pattern)  # type: ignore[arg-type]
    assert image.dtype == np.uint16
    for y in range(5):
        for x in range(6):
            colour = COLOURS[pattern][y % 2][x % 2]
            assert list(erasures[y, x]) == [c != colour for c in range(3)]
            assert list(image[y, x]) == [raw[y, x] if c == colour else 0 for c in range(3)]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_missing_colour_is_the_mean_of_its_nearest_neighbours(pattern: str) -> None:
    raw = RNG.random((6, 8))
    found = interpolate_bayer(raw, pattern)  # type: ignore[arg-type]
    assert found.dtype == np.float32
    _, erasures = split_bayer(raw, pattern)  # type: ignore[arg-type]
    for c in range(3):
        for y in range(6):
            for x in range(8):
                near = [
                    (raw[b, a], (2 - abs(b - y)) * (2 - abs(a - x)))
                    for b in range(max(y - 1, 0), min(y + 2, 6))
                    for a in range(max(x - 1, 0), min(x + 2, 8))
                    if not erasures[b, a, c]
                ]
                mean = sum(value * weight for value, weight in near) / sum(weight for _, weight in near)
                expected = mean if erasures[y, x, c] else raw[y, x]
                assert found[y, x, c] == pytest.approx(expected, rel=1e-6)


def test_what_is_no_mosaic_is_refused() -> None:
    for shape in ((2, 2, 3), (1, 5), (5, 1)):
        with pytest.raises(InputError, match="at least 2 x 2"):
            split_bayer(np.ones(shape), "RGGB")
    split_bayer(np.ones((2, 2)), "RGGB")
    with pytest.raises(InputError, match="'RGBG' is not known"):
        split_bayer(np.ones((4, 4)), "RGBG")  # type: ignore[arg-type]


def basis_of(removal: BackgroundRemoval, shape: tuple[int, int]) -> np.ndarray:
    rows, columns, _ = removal.basis(0)
    return np.asarray(np.einsum("ay,bx->yxab", rows, columns).reshape(shape[0] * shape[1], -1))


@pytest.mark.parametrize("restraint", [0.0, 0.4, 3.0])
def test_each_channels_background_is_its_own_valid_pixels_fit(restraint: float) -> None:
    """Least squares over the cosines; of a restrained one ``1 / (1 + r)``."""
    valid, y = RNG.random((2, 9, 8)) > 0.3, RNG.normal(size=(2, 9, 8)) + 3
    removal = BackgroundRemoval((2, 9, 8), (3, 2), valid, np.float64, restraint)
    found, left = removal.background(y), removal.forward(y)
    basis = basis_of(removal, (9, 8))
    assert basis.shape == (72, 6)
    for c in range(2):
        mask = valid[c].ravel()
        best = basis @ np.linalg.lstsq(basis[mask], y[c].ravel()[mask], rcond=None)[0]
        np.testing.assert_allclose(found[c].ravel(), best / (1 + restraint), atol=1e-9)
        share = 1 - (restraint / (1 + restraint)) ** 0.5
        np.testing.assert_allclose(left[c].ravel(), mask * (y[c].ravel() - share * best), atol=1e-9)
    assert removal.taken == pytest.approx(share)
    out = np.empty_like(y)
    assert removal.forward(y, out=out) is out
    np.testing.assert_allclose(out, left)
    np.testing.assert_allclose(removal.adjoint(y), left)


def test_a_restraint_can_be_set_anew() -> None:
    y = RNG.normal(size=(1, 9, 8)) + 3
    removal = BackgroundRemoval((1, 9, 8), (3, 2), dtype=np.float64)
    assert (removal.restraint, removal.taken) == (0, 1)
    whole = removal.background(y)
    removal.restrain(1.0)
    assert (removal.restraint, removal.taken) == (1.0, pytest.approx(1 - 0.5**0.5))
    np.testing.assert_allclose(removal.background(y), whole / 2)


def test_a_background_has_five_by_five_frequencies_or_as_many_as_there_are_pixels() -> None:
    assert [len(part) for part in BackgroundRemoval((1, 9, 8)).basis(0)] == [5, 5, 25]
    small = BackgroundRemoval((1, 3, 8), (5, 4), dtype=np.float64)
    assert [len(part) for part in small.basis(0)] == [3, 4, 12]
    y = RNG.normal(size=(1, 3, 8))
    narrow = BackgroundRemoval((1, 8, 3), (4, 5), dtype=np.float64)
    np.testing.assert_allclose(
        narrow.background(np.swapaxes(y, 1, 2)), np.swapaxes(small.background(y), 1, 2)
    )
    n = np.arange(8) + 0.5
    np.testing.assert_allclose(small.basis(0)[1][0], np.full(8, 8**-0.5))
    np.testing.assert_allclose(small.basis(0)[1][1], np.cos(np.pi * n / 8) / 2)
    np.testing.assert_allclose(small.basis(0)[1][3], np.cos(np.pi * 3 * n / 8) / 2)


@pytest.mark.parametrize("erased", [False, True])
def test_of_each_channel_the_nearest_smooth_image_without_negative_light_is_taken(erased: bool) -> None:
    """By its conditions (Karush, Kuhn, Tucker): it is pushed up alone, and only where it is dark."""
    valid = RNG.random((2, 30, 24)) > (0.3 if erased else -1)
    removal = BackgroundRemoval((2, 30, 24), (3, 2), valid, np.float64)
    y = RNG.normal(size=(2, 30, 24)) + np.linspace(-4, 3, 24) * np.array([1.0, -2.0])[:, None, None] - 0.5
    found = removal.non_negative(y)
    assert found.min() > -1e-12
    assert (found.max(axis=(1, 2)) > 0.5).all()
    basis = basis_of(removal, (30, 24))
    for c in range(2):
        mask = valid[c].ravel()
        slope = basis[mask].T @ (found[c].ravel() - y[c].ravel())[mask]
        dark = found[c].ravel() < 0.05 * found[c].max()
        _, rest = nnls(basis[dark].T, slope)
        assert rest < 0.02 * np.linalg.norm(slope) + 1e-9
    positive = 7 + np.cos(np.pi * (np.arange(24) + 0.5) / 24) + np.zeros((2, 30, 1))
    np.testing.assert_allclose(removal.non_negative(positive), positive, atol=1e-9)
    assert not removal.non_negative(np.zeros((2, 30, 24))).any()


def test_between_the_points_that_are_asked_a_background_is_lifted_to_nothing() -> None:
    removal = BackgroundRemoval((1, 2, 301), (1, 5), dtype=np.float64)
    for _ in range(5):
        found = removal.non_negative(RNG.normal(size=5) @ removal.basis(0)[1] * 9 + np.zeros((1, 2, 1)) - 0.2)
        assert 0 <= found.min() < 1e-9


def test_light_beyond_the_sensor_is_as_at_the_patterns_edge() -> None:
    plain = camera(2, depths=2)
    window = (slice(1, 7), slice(2, 9))
    patterns = RNG.random((3, 6, 7)) + 0.1
    lit = PatternedCamera(plain, patterns, window)
    height, width = plain.domain_shape[2:]
    rows = np.clip(np.arange(height) - 1, 0, 5)
    columns = np.clip(np.arange(width) - 2, 0, 6)
    wide = [pattern[np.ix_(rows, columns)] for pattern in patterns]
    x = RNG.random(plain.domain_shape)
    frames = lit.forward(x)
    assert lit.range_shape == frames.shape == (6, 6, 7)
    for c in range(2):
        for k in range(3):
            np.testing.assert_allclose(frames[3 * c + k], plain.forward(wide[k] * x)[c])
    y = RNG.random(lit.range_shape)
    by_hand = sum(
        wide[k] * plain.adjoint(np.ascontiguousarray(y.reshape(2, 3, 6, 7)[:, k])) for k in range(3)
    )
    np.testing.assert_allclose(lit.adjoint(y), by_hand)
    out, back = np.full(lit.range_shape, 9.0), np.full(lit.domain_shape, 9.0)
    assert lit.forward(x, out=out) is out
    assert lit.adjoint(y, out=back) is back
    np.testing.assert_allclose(out, frames)
    np.testing.assert_allclose(back, by_hand)
    brightest = np.max(sum(pattern**2 for pattern in wide))
    assert lit.norm_bound == pytest.approx(plain.norm_bound * brightest**0.5)
