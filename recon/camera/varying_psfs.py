"""PSFs that vary over the field, and the camera models that are made of them (Kuo 2020, Eqs. 5.3-5.7).

The local convolution model has measured PSFs, each valid in its neighbourhood; the low-rank model principal
PSFs with interpolated weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float64Array
from recon.base.namespace import Namespace
from recon.camera.convolution import field_of
from recon.camera.spatially_varying import Part, SpatiallyVarying, Strip, Window
from recon.camera.varying_on_device import VaryingOnDevice
from recon.errors import InputError


def interpolation_weights(
    points: npt.ArrayLike, values: npt.ArrayLike, rows: npt.ArrayLike, columns: npt.ArrayLike
) -> Float64Array:
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
        result: Float64Array = np.einsum(
            "ya,abn,xb->nyx", hats(grid_y, y), table, hats(grid_x, x), optimize=True
        )
        return result
    return _scattered(p, v, y, x)


_OFF_LINE = 0.02
"""How far a point may be off its line, relative to the extent: stages repeat imperfectly."""


def grid_axes(points: Float64Array) -> tuple[Float64Array, Float64Array, npt.NDArray[np.intp]] | None:
    """Return rows, columns and order of points that form a grid, or None where they do not."""
    lines = [_lines(points[:, axis]) for axis in (0, 1)]
    (y, row), (x, column) = lines
    if len(y) * len(x) != len(points):
        return None
    index = row * len(x) + column
    if len(np.unique(index)) != len(points):
        return None
    return y, x, np.argsort(index)


def _lines(positions: Float64Array) -> tuple[Float64Array, npt.NDArray[np.intp]]:
    """Cluster positions into lines; return each line's mean and each position's line."""
    order = np.argsort(positions)
    gaps = np.diff(positions[order]) > _OFF_LINE * max(float(np.ptp(positions)), 1e-12)
    label = np.empty(len(positions), np.intp)
    label[order] = np.concatenate([[0], np.cumsum(gaps)])
    means = np.array([positions[label == k].mean() for k in range(label.max() + 1)])
    return means, label


def hats(nodes: Float64Array, positions: Float64Array) -> Float64Array:
    """Piecewise linear basis on ``nodes``, constant beyond the ends: (n_positions, n_nodes)."""
    return np.stack([np.interp(positions, nodes, unit) for unit in np.eye(len(nodes))], axis=1)


_BLOCK_VALUES = 2**17
"""Values that are interpolated at once: scipy needs several times the memory of what it returns."""


def _scattered(points: Float64Array, values: Float64Array, y: Float64Array, x: Float64Array) -> Float64Array:
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    nearest = NearestNDInterpolator(points, values)
    try:
        linear: Any = LinearNDInterpolator(points, values)
    except QhullError:  # fewer than three points, or all on a line: nothing to span
        linear = nearest
    result = np.empty((values.shape[1], len(y), len(x)))
    rows = max(1, _BLOCK_VALUES // (len(x) * values.shape[1]))
    for first in range(0, len(y), rows):
        where: Any = np.stack(np.meshgrid(y[first : first + rows], x, indexing="ij"), axis=-1)
        block = linear(where)
        outside = np.isnan(block[..., 0])
        if outside.any():
            block[outside] = nearest(where[outside])
        result[:, first : first + rows] = np.moveaxis(block, -1, 0)
    return result


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

    @cached_property
    def products(self) -> Float64Array:
        """Products of the PSFs with one another, (n_points, n_points): their Gram matrix."""
        columns = self.psfs.reshape(len(self.psfs), -1)
        gram: Float64Array = columns.astype(np.float64) @ columns.T.astype(np.float64)
        return gram


def spanned(field: FieldOfPsfs, y: Array, x: Array, margin: float) -> BoolArray:
    """Tell which object pixels (offsets from the axis) lie between a depth's outermost PSFs.

    ``margin`` is how far beyond them counts as well, in parts of the distance between them. One PSF spans
    nothing: of a line of them, or of one, all that is beside it counts.
    """
    inside = np.ones(np.broadcast_shapes(y.shape, x.shape), bool)
    for places, at in zip(field.points.T, (y, x), strict=True):
        low, high = float(places.min()), float(places.max())
        if high - low > 1:
            reach = margin * (high - low)
            inside &= (at >= low - reach) & (at <= high + reach)
    return inside


def local_convolution(
    fields: list[FieldOfPsfs],
    sensor_shape: tuple[int, int],
    *,
    support: BoolArray | None = None,
    grid_shape: tuple[int, int] | None = None,
    dtype: npt.DTypeLike = np.float32,
    xp: Namespace = np,
) -> SpatiallyVarying | VaryingOnDevice:
    """Build the local convolution model of one or many depths.

    Where the calibration points form a grid, work is cut along its cells: inside a cell four PSFs are
    weighted bilinearly, and share the cell's transform grid; cells above one another share their transforms
    along rows. Scattered points get a window each.

    Parameters
    ----------
    fields : list of FieldOfPsfs
        One a depth, all with the same PSF shape.
    sensor_shape : (int, int)
    support : ndarray of bool, (n_z, field height, field width), optional
        Where the object may be other than zero: cells, depths and PSFs that it does not touch are left out,
        and windows shrink to it.
    grid_shape : (int, int), optional
        Lateral shape of the object's array, at least the field's: rows and columns beyond it do nothing.
    dtype : dtype
    xp : module
        Whose arrays: ``numpy``, or a GPU's ``cupy``.

    Returns
    -------
    SpatiallyVarying or VaryingOnDevice
        Domain (n_channels, n_z, field height, field width), field = sensor + PSF - 1, centred as
        :class:`~recon.camera.convolution.Convolution`.
    """

    def strips(z: int, field: FieldOfPsfs, needed: BoolArray, rows: Array, columns: Array) -> Iterator[Strip]:
        psfs, corner = cut_to_support(field.psfs)
        yield from _strips(z, psfs, field.points, rows, columns, needed, _offset(corner, field))

    return _model(fields, sensor_shape, strips, support, grid_shape, dtype, xp)


def _model(
    fields: list[FieldOfPsfs],
    sensor_shape: tuple[int, int],
    strips_of: Callable[[int, FieldOfPsfs, BoolArray, Array, Array], Iterator[Strip]],
    support: BoolArray | None,
    grid_shape: tuple[int, int] | None,
    dtype: npt.DTypeLike,
    xp: Namespace,
) -> SpatiallyVarying | VaryingOnDevice:
    """Put together what each depth is cut into, of those that the support touches."""
    if not fields:
        raise InputError("The list of depths is empty: give the PSFs of at least one.")
    shape = fields[0].psfs.shape[2:]
    field_shape, centre = field_of(sensor_shape, shape)
    rows, columns = (np.arange(n) - c for n, c in zip(field_shape, centre, strict=True))
    strips: list[Strip] = []
    for z, field in enumerate(fields):
        if field.psfs.shape[2:] != shape:
            raise InputError(f"Depth {z} has PSFs of {field.psfs.shape[2:]}, depth 0 of {shape}.")
        needed = np.ones(field_shape, bool) if support is None else support[z]
        if needed.any():
            strips += strips_of(z, field, needed, rows, columns)
    made: Any = SpatiallyVarying if xp is np else partial(VaryingOnDevice, xp=xp)
    camera: SpatiallyVarying | VaryingOnDevice = made(
        strips,
        field_shape if grid_shape is None else grid_shape,
        sensor_shape,
        n_z=len(fields),
        n_channels=max(f.psfs.shape[1] for f in fields),
        dtype=dtype,
    )
    return camera


def _offset(corner: tuple[int, int], field: FieldOfPsfs) -> tuple[int, int]:
    """Return where object pixel (0, 0) casts the first pixel of a PSF that was cut at ``corner``."""
    height, width = field.psfs.shape[2:]
    return corner[0] - (height - 1), corner[1] - (width - 1)


def cut_to_support(psfs: Array) -> tuple[Array, tuple[int, int]]:
    """Cut PSFs (..., height, width) to the rectangle that holds all above a millionth of their maximum."""
    bright = np.abs(psfs).max(axis=tuple(range(psfs.ndim - 2)))
    used = bright > 1e-6 * float(bright.max())
    rows, columns = bounding_window(used) if used.any() else (slice(0, 1), slice(0, 1))
    return psfs[..., rows, columns], (rows.start, columns.start)


def bounding_window(mask: BoolArray) -> Window:
    """Return the smallest window that holds all of a mask, which must not be empty."""
    rows, columns = (np.asarray(mask.any(axis=axis)) for axis in (1, 0))
    return _span(rows), _span(columns)


def within(mask: BoolArray, window: Window) -> Window | None:
    """Return the smallest window that holds a mask's part in ``window``; None where it has none."""
    inside = mask[window]
    if not inside.any():
        return None
    rows, columns = (
        slice(w.start + c.start, w.start + c.stop)
        for w, c in zip(window, bounding_window(inside), strict=True)
    )
    return rows, columns


def _strips(
    z: int,
    psfs: Array,
    points: Array,
    rows: Array,
    columns: Array,
    needed: BoolArray,
    offset: tuple[int, int],
) -> Iterator[Strip]:
    """Cut a depth into strips, and leave out what the support does not need."""
    axes = grid_axes(points)
    if axes is None:
        yield from _scattered_strips(z, psfs, points, rows, columns, needed, offset)
        return
    grid_y, grid_x, order = axes
    hats_y, hats_x = hats(grid_y, rows), hats(grid_x, columns)
    for j in range(len(grid_x)):
        column = within(needed, (slice(0, len(rows)), _span(hats_x[:, j])))
        if column is None:
            continue
        parts = []
        for i in range(len(grid_y)):
            cut = within(needed, (_span(hats_y[:, i]), column[1]))
            if cut is not None:
                psf = psfs[order[i * len(grid_x) + j]][:, None]
                parts.append(Part(cut[0], np.zeros(1, int), hats_y[cut[0], i][None], psf))
        mask = hats_x[column[1], j][None, None]
        inside = needed[column]
        yield Strip(z, column, mask if inside.all() else mask * inside, tuple(parts), offset)


def _span(weights: Array) -> slice:
    """Return where weights along an axis are not zero."""
    used = np.flatnonzero(weights)
    return slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0, 0)


def _scattered_strips(
    z: int,
    psfs: Array,
    points: Array,
    rows: Array,
    columns: Array,
    needed: BoolArray,
    offset: tuple[int, int],
) -> Iterator[Strip]:
    weights = interpolation_weights(points, np.eye(len(points)), rows, columns)
    weights *= needed
    for i, weight in enumerate(weights):
        if weight.any():
            window = bounding_window(weight != 0)
            yield Strip(z, window, weight[window][None], (whole(window, psfs[i : i + 1]),), offset)


def whole(window: Window, psfs: Array) -> Part:
    """Return the part that all of a window makes, each PSF with a mask of its own."""
    n, height = len(psfs), window[0].stop - window[0].start
    return Part(window[0], np.arange(n), np.ones((n, height)), psfs.swapaxes(0, 1))


@dataclass(frozen=True)
class PrincipalPsfs:
    """Principal components of one depth's registered PSFs.

    Attributes
    ----------
    components : ndarray, (rank, n_channels, height, width)
        Left singular vectors: an orthonormal basis of the PSFs.
    scores : ndarray, float64, (n_points, rank)
        What combination of components each measured PSF is: right singular vectors times singular values.
    error : float
        Root mean square error of the measured PSFs, relative to their root mean square.
    """

    components: Array
    scores: Float64Array
    error: float


def principal_psfs(
    field: FieldOfPsfs, *, rank: int | None = None, error: float | None = None
) -> PrincipalPsfs:
    """Approximate registered PSFs by the leading terms of their singular value decomposition.

    Parameters
    ----------
    field : FieldOfPsfs
    rank : int, optional
        Number of components; or
    error : float, optional
        the relative error to reach, for which the smallest rank is taken. Default 0.02.
    """
    n = len(field.psfs)
    if rank is not None and not 1 <= rank <= n:
        raise InputError(f"{n} PSFs have ranks from 1 to {n}, not {rank}.")
    columns = field.psfs.reshape(n, -1)
    # The small Gram matrix has the same right singular vectors as the tall matrix of PSFs.
    values, vectors = np.linalg.eigh(field.products)
    values, vectors = np.maximum(values[::-1], 0), vectors[:, ::-1]
    missed = np.sqrt(np.maximum(1 - np.cumsum(values) / values.sum(), 0))
    if rank is None:
        target = 0.02 if error is None else error
        reached = np.flatnonzero(missed <= max(target, 1e-7))
        rank = int(reached[0]) + 1 if reached.size else n
    singular = np.sqrt(values[:rank])
    basis = (columns.T @ vectors[:, :rank]) / np.maximum(singular, 1e-30 + 1e-12 * singular[0])
    components = basis.T.reshape(rank, *field.psfs.shape[1:]).astype(field.psfs.dtype)
    return PrincipalPsfs(components, vectors[:, :rank] * singular, float(missed[rank - 1]))


def low_rank(
    fields: list[FieldOfPsfs],
    sensor_shape: tuple[int, int],
    *,
    rank: int | None = None,
    error: float | None = None,
    support: BoolArray | None = None,
    grid_shape: tuple[int, int] | None = None,
    dtype: npt.DTypeLike = np.float32,
    xp: Namespace = np,
) -> SpatiallyVarying | VaryingOnDevice:
    """Build the low-rank model of one or many depths: ``rank`` convolutions of the whole frame a depth.

    Parameters and result as :func:`~recon.camera.varying_psfs.local_convolution`, with ``rank`` or
    ``error`` as :func:`principal_psfs`. Depths that ``support`` does not touch are left out.
    """

    def strips(z: int, field: FieldOfPsfs, needed: BoolArray, rows: Array, columns: Array) -> Iterator[Strip]:
        window = bounding_window(needed)
        principal = principal_psfs(field, rank=rank, error=error)
        psfs, corner = cut_to_support(principal.components)
        weights = interpolation_weights(field.points, principal.scores, rows[window[0]], columns[window[1]])
        if not needed[window].all():
            weights = weights * needed[window]
        yield Strip(z, window, weights, (whole(window, psfs),), _offset(corner, field))

    return _model(fields, sensor_shape, strips, support, grid_shape, dtype, xp)
