"""The preconditioner against dense matrices: exact on small sensors, Chan's diagonal beyond the low modes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import dctn, idctn

from recon.camera.convolution import Convolution
from recon.solvers.cosine_preconditioner import (
    EXACT_MODES,
    CosinePreconditioner,
    PicturePreconditioner,
    laplacian_eigenvalues,
)

SEPARABLE, DIFFERENCES = 0.7, 0.3


def seen(
    sensor: tuple[int, int], psf: tuple[int, int] = (4, 5), grid: tuple[int, int] | None = None
) -> tuple[Convolution, np.ndarray, np.ndarray]:
    """Return a camera, its power, and ``C F^-1 q F C^T`` as a matrix over the sensor's pixels."""
    rng = np.random.default_rng(3)
    camera = Convolution(rng.random((1, *psf)) ** 3, sensor, grid_shape=grid, dtype=np.float64)
    power = camera.power()[0]
    rows, columns = (laplacian_eigenvalues(n) for n in camera.grid_shape)
    q = power / (SEPARABLE + DIFFERENCES * (rows[:, None] + columns[None, : power.shape[1]]))
    spread = np.fft.irfft2(q, camera.grid_shape)
    pixels = np.indices(sensor).reshape(2, -1)
    apart = (pixels[:, :, None] - pixels[:, None]) % np.array(camera.grid_shape)[:, None, None]
    return camera, power, spread[apart[0], apart[1]]


KINDS = ("penalties", "curvature")


def made(kind: str, camera: Convolution, weight: float = 1.0) -> CosinePreconditioner:
    """Return it for a picture's penalties, or for any curvature that comes with a factor; told of both."""
    power, grid = camera.power()[0], camera.grid_shape
    if kind == "penalties":
        picture = PicturePreconditioner(power, grid, camera.sensor_shape)
        picture.weigh((2, 3), weight)
        picture.set_penalties(DIFFERENCES, SEPARABLE)
        return picture
    rows, columns = (laplacian_eigenvalues(n) for n in grid)
    general = CosinePreconditioner(grid, camera.sensor_shape, np.float64)
    general.set_curvature(np.ones_like(power))
    general.set_scale(5.0)
    general.set_curvature(4 * power / (SEPARABLE + DIFFERENCES * (rows[:, None] + columns[: power.shape[1]])))
    general.set_scale(0.3)
    general.set_scale(0.25)
    general.weigh((2, 3), weight)
    general.set_scale(0.25)
    return general


def applied(preconditioner: CosinePreconditioner, sensor: tuple[int, int]) -> np.ndarray:
    """Return it as a matrix."""
    n = sensor[0] * sensor[1]
    columns = [
        preconditioner.apply(unit, np.empty(sensor)).ravel() for unit in np.eye(n).reshape(-1, *sensor)
    ]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("sensor", [(6, 9), (1, 8), (11, 7)])
@pytest.mark.parametrize("weight", [1.0, 0.4])
@pytest.mark.parametrize("grid", [None, (15, 15)])
@pytest.mark.parametrize("kind", KINDS)
def test_where_all_modes_are_exact_it_is_the_inverse(
    sensor: tuple[int, int], weight: float, grid: tuple[int, int] | None, kind: str
) -> None:
    camera, _, matrix = seen(sensor, grid=grid)
    preconditioner = made(kind, camera, weight)
    weights = np.ones(sensor)
    weights[:2, :3] = weight
    n = matrix.shape[0]
    basis = dctn(np.eye(n).reshape(n, *sensor), axes=(1, 2), norm="ortho").reshape(n, n)
    lessen = basis @ np.diag(weights.ravel()) @ basis.T
    expected = np.linalg.inv(np.eye(n) + lessen @ matrix @ lessen)
    np.testing.assert_allclose(applied(preconditioner, sensor), expected, atol=1e-9)


@pytest.mark.parametrize("psf", [(4, 5), (20, 25), (27, 31)])
@pytest.mark.parametrize("kind", KINDS)
def test_beyond_the_lowest_modes_it_is_chans_diagonal_and_among_them_the_inverse(
    psf: tuple[int, int], kind: str
) -> None:
    sensor = (EXACT_MODES + 2, EXACT_MODES + 7)
    camera, power, matrix = seen(sensor, psf)
    preconditioner = made(kind, camera)
    # The autocorrelation times the overlap of the sensor with itself shifted, seen by each mode's cosine: of
    # the whole curvature, or for a picture of the power alone, over the restraint of each mode.
    if kind == "curvature":
        rows, columns = (laplacian_eigenvalues(n) for n in camera.grid_shape)
        power = power / (SEPARABLE + DIFFERENCES * (rows[:, None] + columns[: power.shape[1]]))
    spread = np.fft.irfft2(power, camera.grid_shape)
    cosines, curvatures = [], []
    for n, grid in zip(sensor, camera.grid_shape, strict=True):
        lags = np.arange(1 - n, n)
        lags = lags[np.abs(lags) <= (grid - 1) // 2]
        k = np.arange(n)
        cosines.append((lags, (1 - np.abs(lags) / n) * np.cos(np.pi * np.outer(k, lags) / n)))
        curvatures.append(4 * np.sin(np.pi * k / (2 * n)) ** 2)
    (y, by_row), (x, by_column) = cosines
    symbol = by_row @ spread[np.ix_(y % camera.grid_shape[0], x % camera.grid_shape[1])] @ by_column.T
    restraint = SEPARABLE + DIFFERENCES * (curvatures[0][:, None] + curvatures[1])
    gain = 1 / (1 + symbol) if kind == "curvature" else restraint / (restraint + symbol)
    found = np.array([
        dctn(preconditioner.apply(idctn(mode, norm="ortho"), np.empty(sensor)), norm="ortho")[at]
        for at in np.ndindex(sensor) if max(at) >= EXACT_MODES
        for mode in [(np.indices(sensor) == np.array(at)[:, None, None]).all(axis=0).astype(float)]
    ])  # fmt: skip
    expected = [gain[at] for at in np.ndindex(sensor) if max(at) >= EXACT_MODES]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    n = matrix.shape[0]
    basis = dctn(np.eye(n).reshape(n, *sensor), axes=(1, 2), norm="ortho").reshape(n, n)
    low = (np.indices(sensor).max(axis=0) < EXACT_MODES).ravel()
    within = (basis.T @ matrix @ basis)[np.ix_(low, low)]
    inverse = np.linalg.inv(np.eye(len(within)) + within)
    own = (basis.T @ applied(preconditioner, sensor) @ basis)[np.ix_(low, low)]
    np.testing.assert_allclose(own, inverse, atol=1e-9)
