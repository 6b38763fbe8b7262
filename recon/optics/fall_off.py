"""Angular response of a sensor's pixels, ``f(theta)`` of Kuo 2020, Eq. 5.1."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array, Float64Array
from recon.optics.grid import PixelGrid

if TYPE_CHECKING:
    from scipy import sparse

COARSE_STEP = 0.004
"""In tangents of the angle; linear interpolation between is exact to 1e-4 for any pixel's response."""

FallOff = Callable[[Float64Array, Float64Array], Float64Array]
"""Maps the tangents of the angle of incidence along y and x to a response relative to normal incidence."""


def no_fall_off(tan_y: Float64Array, tan_x: Float64Array) -> Float64Array:
    """Respond alike at all angles."""
    return np.ones(np.broadcast_shapes(tan_y.shape, tan_x.shape))


def gaussian_fall_off(sigma_y_deg: float, sigma_x_deg: float | None = None) -> FallOff:
    """Gaussian response; two widths for sensors whose circuitry shades rows and columns differently.

    The angles along y and x are those whose tangents are the components of the direction's tangent scaled to
    its full angle, so that with equal widths the response depends on the angle from the normal alone.
    """
    widths = np.deg2rad([sigma_y_deg, sigma_y_deg if sigma_x_deg is None else sigma_x_deg])

    def response(tan_y: Float64Array, tan_x: Float64Array) -> Float64Array:
        radius = np.hypot(tan_y, tan_x)
        # theta / tan(theta), 1 on the axis
        shrink = np.arctan(radius) / np.maximum(radius, 1e-12)
        shrink = np.where(radius < 1e-9, 1.0, shrink)
        return np.asarray(
            np.exp(-0.5 * ((shrink * tan_y / widths[0]) ** 2 + (shrink * tan_x / widths[1]) ** 2))
        )

    return response


def table_fall_off(angles_deg: npt.ArrayLike, responses: npt.ArrayLike) -> FallOff:
    """Response from a measured table, linear between its entries and constant beyond them.

    Raises ValueError when the angles do not ascend from 0 or a response is negative.
    """
    angles = np.deg2rad(np.asarray(angles_deg, np.float64))
    values = np.asarray(responses, np.float64)
    if angles.ndim != 1 or angles.shape != values.shape or len(angles) < 2:
        raise ValueError("A fall-off table needs two or more angles and as many responses.")
    if angles[0] != 0 or np.any(np.diff(angles) <= 0) or np.any(values < 0):
        raise ValueError("A fall-off table's angles ascend from 0 degrees, its responses are not negative.")

    def response(tan_y: Float64Array, tan_x: Float64Array) -> Float64Array:
        return np.interp(np.arctan(np.hypot(tan_y, tan_x)), angles, values)

    return response


def response_on(
    grid: PixelGrid, source_um: tuple[float, float, float], distance_um: float, fall_off: FallOff
) -> Float32Array:
    """Response of every pixel to light from a source: ``f(atan(|u - x| / (d + z)))`` (Kuo 2020, Eq. 5.1).

    Returns
    -------
    ndarray, float32, ``grid.shape``
    """
    x, y, z = source_um
    # The response is smooth: evaluate it on a coarse grid and interpolate.
    step_um = COARSE_STEP * (z + distance_um)
    coarse_y, rows = _coarse(grid.y_um, step_um)
    coarse_x, columns = _coarse(grid.x_um, step_um)
    coarse = fall_off((coarse_y[:, None] - y) / (z + distance_um), (coarse_x - x) / (z + distance_um))
    return np.asarray(rows @ (columns @ coarse.T).T, np.float32)


def _coarse(positions: Float64Array, step: float) -> tuple[Float64Array, sparse.csr_array]:
    """Return coarse positions that span the given ones, and the matrix of linear interpolation back."""
    count = int(np.ceil((positions[-1] - positions[0]) / step)) + 2
    coarse = np.linspace(positions[0] - step / 2, positions[-1] + step / 2, count)
    place = (positions - coarse[0]) / (coarse[1] - coarse[0])
    left = np.clip(place.astype(int), 0, count - 2)
    index = np.arange(len(positions))
    weights = np.concatenate([1 - (place - left), place - left])
    from scipy import sparse  # late: importing recon stays light

    matrix = sparse.csr_array(
        (weights, (np.concatenate([index, index]), np.concatenate([left, left + 1]))),
        shape=(len(positions), count),
    )
    return coarse, matrix
