"""The low-rank model: principal PSFs with interpolated weights (Kuo 2020, Eqs. 5.6 and 5.7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.camera.base import Array
from recon.camera.interpolation import interpolation_weights
from recon.camera.local_convolution import FieldOfPsfs, bounding_window, cut_to_support, field_of, whole
from recon.camera.spatially_varying import SpatiallyVarying
from recon.camera.strips import Strip
from recon.errors import InputError


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
    scores: npt.NDArray[np.float64]
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
    gram = columns.astype(np.float64) @ columns.T.astype(np.float64)
    values, vectors = np.linalg.eigh(gram)
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
    n_channels: int | None = None,
    support: npt.NDArray[np.bool_] | None = None,
    grid_shape: tuple[int, int] | None = None,
    dtype: npt.DTypeLike = np.float32,
) -> SpatiallyVarying:
    """Build the low-rank model of one or many depths: ``rank`` convolutions of the whole frame a depth.

    Parameters and result as :func:`~recon.camera.local_convolution.local_convolution`, with ``rank`` or
    ``error`` as :func:`principal_psfs`. Depths that ``support`` does not touch are left out.
    """
    if not fields:
        raise InputError("The list of depths is empty: give the PSFs of at least one.")
    shape = fields[0].psfs.shape[2:]
    channels = max(f.psfs.shape[1] for f in fields) if n_channels is None else n_channels
    field_shape, centre = field_of(sensor_shape, (shape[0], shape[1]))
    rows, columns = (np.arange(n) - c for n, c in zip(field_shape, centre, strict=True))
    strips = []
    for z, field in enumerate(fields):
        needed = np.ones(field_shape, bool) if support is None else support[z]
        if not needed.any():
            continue
        window = bounding_window(needed)
        principal = principal_psfs(field, rank=rank, error=error)
        psfs, corner = cut_to_support(principal.components)
        weights = interpolation_weights(field.points, principal.scores, rows[window[0]], columns[window[1]])
        if not needed[window].all():
            weights = weights * needed[window]
        offset = (corner[0] - (shape[0] - 1), corner[1] - (shape[1] - 1))
        strips.append(Strip(z, window, weights, (whole(window, psfs),), offset))
    return SpatiallyVarying(
        strips,
        field_shape if grid_shape is None else grid_shape,
        sensor_shape,
        n_z=len(fields),
        n_channels=channels,
        dtype=dtype,
    )
