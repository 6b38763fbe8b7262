"""The local convolution model: measured PSFs, each valid in its neighbourhood (Kuo 2020, Eqs. 5.3-5.5)."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from recon.errors import InputError
from recon.operators.base import Array
from recon.operators.interpolation import grid_axes, hats, interpolation_weights
from recon.operators.spatially_varying import Group, SpatiallyVarying, Window


class FieldOfPsfs:
    """Registered PSFs of one depth with the places they were measured at.

    Parameters
    ----------
    psfs : ndarray, (n_points, n_channels or 1, height, width)
        Registered: each shifted back so that its diffuser pattern lies where the on-axis PSF's does (Eq.
        5.2).
    points : array, (n_points, 2)
        ``(row, column)`` of each source in object pixels from the axis (see :mod:`recon.types`: upside down).
    """

    def __init__(self, psfs: Array, points: npt.ArrayLike) -> None:
        self.psfs = psfs
        self.points = np.asarray(points, np.float64)
        if psfs.ndim != 4 or len(psfs) == 0 or self.points.shape != (len(psfs), 2):
            raise InputError(
                f"A field of PSFs is (n_points, n_channels, height, width) with a (row, column) each; "
                f"got PSFs {psfs.shape} and points {self.points.shape}."
            )


def local_convolution(
    fields: list[FieldOfPsfs],
    sensor_shape: tuple[int, int],
    *,
    n_channels: int | None = None,
    support: npt.NDArray[np.bool_] | None = None,
    dtype: npt.DTypeLike = np.float32,
) -> SpatiallyVarying:
    """Build the local convolution model of one or many depths.

    Where the calibration points form a grid, work is cut along its cells: inside a cell four PSFs are
    weighted bilinearly, and share the cell's transform grid. Scattered points get a window each.

    Parameters
    ----------
    fields : list of FieldOfPsfs
        One a depth, all with the same PSF shape.
    sensor_shape : (int, int)
    n_channels : int, optional
    support : ndarray of bool, (n_z, field height, field width), optional
        Where the object may be other than zero: cells, depths and PSFs that it does not touch are left out,
        and windows shrink to it.
    dtype : dtype

    Returns
    -------
    SpatiallyVarying
        Domain (n_channels, n_z, field height, field width), field = sensor + PSF - 1, centred as
        :class:`~recon.operators.convolution.PadCropConvolution`.
    """
    if not fields:
        raise InputError("The list of depths is empty: give the PSFs of at least one.")
    shape = fields[0].psfs.shape[2:]
    channels = max(f.psfs.shape[1] for f in fields) if n_channels is None else n_channels
    field_shape, centre = field_of(sensor_shape, (shape[0], shape[1]))
    rows, columns = (np.arange(n) - c for n, c in zip(field_shape, centre, strict=True))
    groups: list[Group] = []
    for z, field in enumerate(fields):
        if field.psfs.shape[2:] != shape:
            raise InputError(f"Depth {z} has PSFs of {field.psfs.shape[2:]}, depth 0 of {shape}.")
        psfs, corner = cut_to_support(field.psfs)
        cells = _cells(field.points, rows, columns)
        for window, members, weights in cells:
            cut = _shrink(window, None if support is None else support[z])
            if cut is None:
                continue
            inner = tuple(
                slice(c.start - w.start, c.stop - w.start) for c, w in zip(cut, window, strict=True)
            )
            mask = weights[:, inner[0], inner[1]]
            if support is not None:
                mask = mask * support[z][cut]
            used = mask.any(axis=(1, 2))
            if used.any():
                groups.append(
                    Group(z, cut, mask[used], psfs[members[used]].swapaxes(0, 1), _origin(cut, corner, shape))
                )
    return SpatiallyVarying(
        groups, field_shape, sensor_shape, n_z=len(fields), n_channels=channels, dtype=dtype
    )


def field_of(
    sensor_shape: tuple[int, int], psf_shape: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return shape and axis of the field that can reach the sensor (as ``PadCropConvolution``)."""
    height, width = (s + p - 1 for s, p in zip(sensor_shape, psf_shape, strict=True))
    row, column = (s // 2 + p - 1 - p // 2 for s, p in zip(sensor_shape, psf_shape, strict=True))
    return (height, width), (row, column)


def cut_to_support(psfs: Array, threshold: float = 1e-6) -> tuple[Array, tuple[int, int]]:
    """Cut PSFs (..., height, width) to the rectangle that holds all but ``threshold`` of their maximum."""
    bright = np.abs(psfs).max(axis=tuple(range(psfs.ndim - 2)))
    level = threshold * float(bright.max())
    windows = []
    for axis in (1, 0):
        used = np.flatnonzero(bright.max(axis=axis) > level)
        windows.append(slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0, 1))
    return psfs[..., windows[0], windows[1]], (windows[0].start, windows[1].start)


def _origin(window: Window, corner: tuple[int, int], psf_shape: tuple[int, ...]) -> tuple[int, int]:
    """Sensor position of a full convolution's first pixel: field pixel 0 with PSF pixel 0 is ``1 - psf``."""
    row, column = (w.start + c - (n - 1) for w, c, n in zip(window, corner, psf_shape, strict=True))
    return row, column


def _shrink(window: Window, support: npt.NDArray[np.bool_] | None) -> Window | None:
    if support is None:
        return window
    inside = support[window]
    if not inside.any():
        return None
    cut = []
    for axis, w in enumerate(window):
        used = np.flatnonzero(inside.any(axis=1 - axis))
        cut.append(slice(w.start + int(used[0]), w.start + int(used[-1]) + 1))
    return cut[0], cut[1]


Cell = tuple[Window, npt.NDArray[np.intp], npt.NDArray[np.float64]]


def _cells(points: Array, rows: Array, columns: Array) -> Iterator[Cell]:
    """Yield windows of the field with the PSFs that matter in them and their weights there."""
    axes = grid_axes(points)
    if axes is None:
        yield from _scattered_cells(points, rows, columns)
        return
    grid_y, grid_x, order = axes
    weights_y, weights_x = hats(grid_y, rows), hats(grid_x, columns)
    for window_y, members_y in _intervals(grid_y, rows):
        for window_x, members_x in _intervals(grid_x, columns):
            index = np.array([order[a * len(grid_x) + b] for a in members_y for b in members_x])
            product = np.einsum(
                "ya,xb->abyx", weights_y[window_y][:, members_y], weights_x[window_x][:, members_x]
            )
            yield (window_y, window_x), index, product.reshape(len(index), *product.shape[2:])


def _intervals(nodes: Array, positions: Array) -> Iterator[tuple[slice, list[int]]]:
    """Cut positions at the inner nodes; beyond the outer nodes only the outermost one counts."""
    edges = np.searchsorted(positions, nodes)
    bounds = [0, *(int(e) for e in edges), len(positions)]
    for k, (start, stop) in enumerate(pairwise(bounds)):
        if stop > start:
            yield slice(start, stop), [n for n in (k - 1, k) if 0 <= n < len(nodes)]


def _scattered_cells(points: Array, rows: Array, columns: Array) -> Iterator[Cell]:
    weights = interpolation_weights(points, np.eye(len(points)), rows, columns)
    for i, weight in enumerate(weights):
        used_y, used_x = np.flatnonzero(weight.any(axis=1)), np.flatnonzero(weight.any(axis=0))
        if used_y.size:
            window = slice(int(used_y[0]), int(used_y[-1]) + 1), slice(int(used_x[0]), int(used_x[-1]) + 1)
            yield window, np.array([i]), weight[window][None]
