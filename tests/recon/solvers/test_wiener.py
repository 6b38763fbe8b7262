"""The Wiener filter against its equation, written with whole complex spectra, pixel by pixel."""

import time

import numpy as np
import pytest

from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures
from recon.solvers.base import StopReason
from recon.solvers.wiener_filter import FLATNESS, WienerFilter, cross_validated, wiener


def camera_and_data(sensor=(11, 14), noise=0.02, psf=(6, 7)):
    rng = np.random.default_rng(3)
    psfs = rng.random((2, *psf)) * (rng.random((2, *psf)) > 0.6)
    psfs[:, psf[0] // 3, psf[1] // 2] += 2
    camera = Convolution(psfs, sensor, n_channels=2, dtype=np.float64)
    scene = np.zeros(camera.domain_shape)
    scene[0, 5:9, 4:8], scene[1, 7:12, 9:12] = 1.0, 0.5
    return camera, camera.forward(scene) + noise * rng.standard_normal(camera.range_shape)


def faded(camera, image):
    """The grid's pixels: the nearest of the sensor's, by the shorter way around, darker with distance."""
    sides = []
    for grid, start, length in zip(camera.grid_shape, camera.corner, image.shape, strict=True):
        matrix = np.zeros((grid, length))
        for at in range(grid):
            away = [min((at - start - i) % grid, (start + i - at) % grid) for i in range(length)]
            nearest = int(np.argmin(away[::-1]))  # of two at the same distance the last
            share = min(away[::-1][nearest] / max((grid - length) / 2, 1), 1)
            matrix[at, length - 1 - nearest] = 0.5 + 0.5 * np.cos(np.pi * share)
        sides.append(matrix)
    return sides[0] @ image @ sides[1].T


def by_its_equation(camera, data, r):
    height, width = camera.grid_shape
    y, x = (2 - 2 * np.cos(2 * np.pi * np.fft.fftfreq(n)) for n in (height, width))
    half = camera.spectrum[:, 0]
    power = np.abs(half) ** 2
    penalty = (FLATNESS + y[:, None] + x) * power.mean()
    result = []
    for channel, image in enumerate(data):
        H = np.fft.fft2(np.fft.irfft2(half[channel], (height, width)))
        B = np.fft.fft2(faded(camera, image))
        result.append(np.fft.ifft2(np.conj(H) * B / (np.abs(H) ** 2 + r * penalty)).real)
    return np.array(result)


@pytest.mark.parametrize(
    ("sensor", "psf"), [((11, 14), (6, 7)), ((12, 9), (6, 7)), ((13, 12), (1, 2)), ((12, 11), (1, 2))]
)
def test_is_its_equation(sensor, psf):
    camera, data = camera_and_data(sensor, psf=psf)
    began_s = time.perf_counter()
    outcome = wiener(camera, data, 0.03)
    assert 0 <= outcome.seconds <= time.perf_counter() - began_s
    np.testing.assert_allclose(
        outcome.solution.reshape(2, *camera.grid_shape), by_its_equation(camera, data, 0.03), atol=1e-9
    )
    assert (outcome.stop_reason, outcome.tau, outcome.history) == (StopReason.ONE_STEP, 0.03, ())
    np.testing.assert_array_equal(WienerFilter(camera, 0.03)(data), outcome.solution)


def test_erased_pixels_are_filled_from_around_them():
    camera, _ = camera_and_data()
    valid = np.ones(camera.range_shape, bool)
    valid[:, 4:8, 6:10] = False
    even = np.full(camera.range_shape, 3.0)
    masked = Erasures(valid, camera.range_shape, np.float64) @ camera
    whole = wiener(camera, even, 0.1).solution
    np.testing.assert_allclose(wiener(masked, even * valid, 0.1).solution, whole, rtol=1e-9)


def test_the_regularisation_is_what_left_out_data_ask_for():
    """It follows the noise, and is near that of the least error; all frequencies and some of them agree."""
    found = []
    for noise in (0.003, 0.03, 0.3):
        camera, data = camera_and_data((30, 33), noise)
        best = cross_validated(camera, data, None)
        assert wiener(camera, data).tau == best
        found.append(best)
        assert 0.3 <= cross_validated(camera, data, 200) / best <= 3.2
    assert found[0] < found[1] < found[2]
    camera, data = camera_and_data((30, 33), 0.03)
    clean = wiener(camera, camera_and_data((30, 33), 0.0)[1], 1e-4).solution
    errors = {r: np.linalg.norm(wiener(camera, data, r).solution - clean) for r in np.logspace(-6, 2, 17)}
    assert np.linalg.norm(wiener(camera, data).solution - clean) < 1.3 * min(errors.values())


@pytest.mark.parametrize(("enough", "every"), [(None, 1), (10_000, 1), (300, 1), (250, 2)])
def test_of_quarters_of_decades_the_least_error_of_what_is_left_out_is_taken(enough, every):
    """``|(1 - A) b|^2 / tr(1 - A)^2`` of the filter's own data, row by row of frequencies."""
    camera, data = camera_and_data((25, 30), 0.1)
    camera, data = Convolution(camera._psfs[0, :1], (25, 30), dtype=np.float64), data[:1]
    assert camera.spectrum[0, 0].size == 570
    power = np.abs(camera.spectrum[:, 0]) ** 2
    height, width = camera.grid_shape
    y, x = (
        2 - 2 * np.cos(2 * np.pi * np.fft.fftfreq(height)),
        2 - 2 * np.cos(2 * np.pi * np.fft.rfftfreq(width)),
    )
    penalty = (FLATNESS + y[:, None] + x) * power.mean()
    seen = np.abs([np.fft.rfft2(faded(camera, image)) for image in data]) ** 2
    r = 10.0 ** (np.arange(-24, 9) / 4)
    left = 1 - power / (power + r[:, None, None, None] * penalty)
    left, seen = left[:, :, ::every], seen[:, ::every]
    errors = (left**2 * seen).sum(axis=(1, 2, 3)) / left.sum(axis=(1, 2, 3)) ** 2
    assert cross_validated(camera, data, enough) == pytest.approx(r[np.argmin(errors)], rel=1e-12)
