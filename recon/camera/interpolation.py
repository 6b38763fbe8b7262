"""Weights with which calibrated PSFs stand for the field between their sources (Kuo 2020, Eq. 5.3)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.errors import InputError

Floats = npt.NDArray[np.float64]


def interpolation_weights(
    points: npt.ArrayLike, values: npt.ArrayLike, rows: npt.ArrayLike, columns: npt.ArrayLike
) -> Floats:
    """Interpolate values given at calibration points onto a grid of pixels.

    Bilinear between the four nearest where the points form a grid of rows and columns (spacings may differ),
    linear within triangles (Delaunay) where they are scattered, constant beyond the outermost points.

    Parameters
    ----------
    points : array, (n_points, 2)
        ``(row, column)`` of each calibration point, in pixels.
    values : array, (n_points, n)
        What to interpolate. The identity gives the weights alpha_i of Eq. 5.3.
    rows, columns : array, (height,) and (width,)
        Pixel positions of the grid.

    Returns
    -------
    ndarray, float64, (n, height, width)
        For the identity: non-negative, and the sum over i is 1 everywhere.
    """
    p, v = np.asarray(points, np.float64), np.asarray(values, np.float64)
    y, x = np.asarray(rows, np.float64), np.asarray(columns, np.float64)
    if p.ndim != 2 or p.shape[1] != 2 or len(p) != len(v):
        raise InputError(f"{len(v)} values do not fit calibration points of shape {p.shape}; give (n, 2).")
    axes = grid_axes(p)
    if axes is not None:
        grid_y, grid_x, order = axes
        table = v[order].reshape(len(grid_y), len(grid_x), -1)
        result: Floats = np.einsum("ya,abn,xb->nyx", hats(grid_y, y), table, hats(grid_x, x), optimize=True)
        return result
    return _scattered(p, v, y, x)


def grid_axes(points: Floats, tolerance: float = 0.02) -> tuple[Floats, Floats, npt.NDArray[np.intp]] | None:
    """Return rows, columns and order of points that form a grid, or None where they do not.

    ``tolerance`` is how far a point may be off its line, relative to the extent: stages repeat imperfectly.
    """
    lines = [_lines(points[:, axis], tolerance) for axis in (0, 1)]
    (y, row), (x, column) = lines
    if len(y) * len(x) != len(points):
        return None
    index = row * len(x) + column
    if len(np.unique(index)) != len(points):
        return None
    return y, x, np.argsort(index)


def _lines(positions: Floats, tolerance: float) -> tuple[Floats, npt.NDArray[np.intp]]:
    """Cluster positions into lines; return each line's mean and each position's line."""
    order = np.argsort(positions)
    gaps = np.diff(positions[order]) > tolerance * max(float(np.ptp(positions)), 1e-12)
    label = np.empty(len(positions), np.intp)
    label[order] = np.concatenate([[0], np.cumsum(gaps)])
    means = np.array([positions[label == k].mean() for k in range(label.max() + 1)])
    return means, label


def hats(nodes: Floats, positions: Floats) -> Floats:
    """Piecewise linear basis on ``nodes``, constant beyond the ends: (n_positions, n_nodes)."""
    return np.stack([np.interp(positions, nodes, unit) for unit in np.eye(len(nodes))], axis=1)


def _scattered(points: Floats, values: Floats, y: Floats, x: Floats) -> Floats:
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    where: Any = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1)
    nearest = NearestNDInterpolator(points, values)
    try:
        result = LinearNDInterpolator(points, values)(where)
    except QhullError:  # fewer than three points, or all on a line: nothing to span
        result = nearest(where)
    outside = np.isnan(result[..., 0])
    if outside.any():
        result[outside] = nearest(where[outside])
    return np.moveaxis(result, -1, 0)
