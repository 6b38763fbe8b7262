"""One-shot deconvolution in Fourier space, for previews and starting points (Tikhonov / Wiener)."""

from __future__ import annotations

import time

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.base.filling import fill_smoothly
from recon.camera.base import LinearOperator
from recon.camera.factors import CroppedConvolution, as_cropped_convolution
from recon.solvers.base import Outcome, StopReason
from recon.solvers.cosine_preconditioner import laplacian_eigenvalues

FLATNESS = 1e-3
"""Share of plain Tikhonov in the penalty: keeps the lowest frequencies, which have no gradient, bounded."""

ENOUGH_FREQUENCIES = 20_000
"""Frequencies that tell a live picture's regularisation as well as all do."""


def wiener(operator: LinearOperator, data: Array, regularisation: float | None = None) -> Outcome:
    """Deconvolve in one step: ``conj(H) B / (|H|^2 + r mean|H|^2 (|Psi|^2 + flatness))``.

    The penalty on differences is the Wiener filter for pictures whose spectrum falls as ``1 / f^2``. Beyond
    the sensor the data is continued by its edge, faded to zero over the padding; erased pixels are filled
    from their neighbourhood.

    Parameters
    ----------
    operator : LinearOperator
        A ``Convolution`` of a picture, with or without ``Erasures``.
    data : ndarray, ``operator.range_shape``
    regularisation : float, optional
        ``r`` above, relative to the PSF's mean power. Default: by generalised cross-validation for all
        channels together.

    Returns
    -------
    Outcome
        With an empty history; ``tau`` is the regularisation.
    """
    began = time.perf_counter()
    data = np.asarray(data, operator.dtype)
    if regularisation is None:
        regularisation = cross_validated(operator, data, enough=None)
    solution = WienerFilter(operator, regularisation)(data)
    return Outcome(solution, (), StopReason.ONE_STEP, time.perf_counter() - began, float(regularisation))


class WienerFilter:
    """The same filter with its regularisation settled once: two FFTs a picture, for previews.

    ``operator`` and ``regularisation`` are as of :func:`wiener`.
    """

    def __init__(self, operator: LinearOperator, regularisation: float) -> None:
        self._structure, power, penalty = _structure(operator)
        self._filter = np.conj(self._structure.convolution.spectrum[:, 0])
        self._filter /= power + power.dtype.type(regularisation) * penalty

    def __call__(self, data: Array) -> Array:
        """Return the object (operator's domain) that data, ``operator.range_shape``, comes from."""
        B = fft.rfft(_continue_beyond_sensor(self._structure, data))
        fft.multiply(B, self._filter)
        return fft.irfft(B, self._structure.convolution.grid_shape[1])


def cross_validated(operator: LinearOperator, data: Array, enough: int | None = ENOUGH_FREQUENCIES) -> float:
    """Return the regularisation that predicts left-out data best (Golub, Heath & Wahba 1979).

    From every so many rows of frequencies, about ``enough`` in all (a live picture waits for it), or all.
    """
    structure, power, penalty = _structure(operator)
    B = fft.rfft(_continue_beyond_sensor(structure, data))
    stride = 1 if enough is None else max(B[0].size // enough, 1)
    power, penalty, B = power[:, ::stride], penalty[::stride], B[:, ::stride]
    signal = (B.real**2 + B.imag**2).astype(np.float64)
    candidates = np.logspace(-6, 2, 33)
    scores = []
    for r in candidates:
        kept = 1 - power / (power + r * penalty)
        scores.append(float(np.sum(kept**2 * signal)) / float(np.sum(np.broadcast_to(kept, B.shape))) ** 2)
    return float(candidates[int(np.argmin(scores))])


def _structure(operator: LinearOperator) -> tuple[CroppedConvolution, Array, Array]:
    """Return what an operator is, ``|H|^2``, and ``mean|H|^2 (|Psi|^2 + flatness)``."""
    structure = as_cropped_convolution(operator)
    power = structure.convolution.power()
    rows, columns = (laplacian_eigenvalues(n) for n in structure.convolution.grid_shape)
    penalty = (FLATNESS + rows[:, None] + columns[: power.shape[-1]]) * float(np.mean(power))
    return structure, power, penalty.astype(power.dtype)


def _continue_beyond_sensor(structure: CroppedConvolution, data: Array) -> Array:
    """Put the data on the grid: erased pixels filled, edges repeated and faded to zero at half the padding.

    A hard edge would be deconvolved into stripes all over the picture.
    """
    convolution = structure.convolution
    if not structure.weight.all():
        data = data.copy()
        for image, weight in zip(data, structure.weight, strict=True):
            fill_smoothly(image, weight)
    rows, row_fade = _nearest(convolution.grid_shape[0], convolution.corner[0], data.shape[1])
    columns, column_fade = _nearest(convolution.grid_shape[1], convolution.corner[1], data.shape[2])
    # Columns first, on the sensor's rows alone: whole rows are then copied at the speed of memory.
    grid: Array = (data[:, :, columns] * column_fade.astype(data.dtype))[:, rows]
    grid *= row_fade[:, None].astype(data.dtype)
    return grid


def _nearest(grid: int, start: int, length: int) -> tuple[Array, Array]:
    """For each grid position around the ring: nearest sensor position, and a cosine fade with distance."""
    offset = (np.arange(grid) - start) % grid
    beyond = np.maximum(offset - (length - 1), 0)
    before = np.where(beyond > 0, grid - offset, 0)
    index = np.where(beyond <= before, np.minimum(offset, length - 1), 0)
    distance = np.minimum(beyond, before)
    reach = max((grid - length) / 2, 1)
    return index, 0.5 + 0.5 * np.cos(np.pi * np.minimum(distance / reach, 1))
