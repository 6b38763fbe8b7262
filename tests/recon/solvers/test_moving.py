"""A state that moves: Keys' weights of four pixels, whole periods that wrap, real spectra that stay real."""

from __future__ import annotations

import numpy as np
import pytest

from recon.solvers.moving import _taps, move, move_spectra


def keys(distance: float) -> float:
    """Keys 1981, Eq. 15, with a = -1/2."""
    s = abs(distance)
    if s < 1:
        return 1.5 * s**3 - 2.5 * s**2 + 1
    return -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2 if s < 2 else 0.0


@pytest.mark.parametrize("by", [0.0, 0.3, 1.0, -0.4, 2.75, -3.0])
def test_the_weights_are_keys_of_the_four_pixels_around(by: float) -> None:
    whole, weights = _taps(by, np.dtype(np.float64))
    assert whole - 1 < by <= whole
    np.testing.assert_allclose(weights, [keys(n + by - whole) for n in (-1, 0, 1, 2)], atol=1e-12)
    assert weights.sum() == pytest.approx(1)


@pytest.mark.parametrize(("rows", "columns"), [(1.0, -2.0), (0.3, 0.0), (-2.4, 8.7), (12.0, -15.5)])
def test_every_pixel_is_the_weighted_mean_of_those_that_came_there(rows: float, columns: float) -> None:
    images = np.random.default_rng(0).standard_normal((3, 6, 7))
    moved = images.copy()
    move(moved, rows, columns)
    y = np.zeros((6, 6))
    x = np.zeros((7, 7))
    for weights, n, by in ((y, 6, rows), (x, 7, columns)):
        for to in range(n):
            for at in range(-40, 50):
                weights[to, at % n] += keys(to - at - by)
    np.testing.assert_allclose(moved, y @ images @ x.T, atol=1e-12)
    nothing = np.zeros((0, 6, 7))
    move(nothing, rows, columns)


@pytest.mark.parametrize("shape", [(8, 8), (7, 9), (6, 9), (7, 8)])
def test_spectra_move_as_their_images_by_whole_pixels_and_stay_those_of_real_ones(
    shape: tuple[int, int],
) -> None:
    images = np.random.default_rng(0).standard_normal((2, *shape))
    spectra = np.fft.rfft2(images)
    move_spectra(spectra, 2.0, -3.0, shape[1])
    np.testing.assert_allclose(np.fft.irfft2(spectra, shape), np.roll(images, (2, -3), (1, 2)), atol=1e-12)
    spectra = np.fft.rfft2(images)
    move_spectra(spectra, 0.5, 0.25, shape[1])
    y = np.exp(-2j * np.pi * 0.5 * np.fft.fftfreq(shape[0]))
    x = np.exp(-2j * np.pi * 0.25 * np.fft.fftfreq(shape[1]))
    for phases in (y, x):
        if len(phases) % 2 == 0:
            phases[len(phases) // 2] = phases[len(phases) // 2].real
    expected = np.fft.ifft2(np.fft.fft2(images) * y[:, None] * x).real
    np.testing.assert_allclose(spectra, np.fft.rfft2(expected), atol=1e-12)
