"""The exact data term on the sensor plane: ``(I + C q C) e = r`` by warm-started conjugate gradients."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.base.namespace import Namespace, namespace_of
from recon.camera.background import BackgroundRemoval
from recon.camera.base import Array


class SensorSystem:
    """Solves for the data residual ``e`` that a proximal or ADMM step on the whole volume leaves.

    Let ``A = C M`` with ``M`` the sum of circular convolutions over depth and ``C`` the crop to the sensor's
    valid pixels. Minimising ``1/2 ||A x - b||^2 + 1/2 <x, T x> - <r, x>`` gives ``x = T^-1 (r + A^H e)``
    where ``e = b - A x`` solves ``(I + C q C^T) e = b - A T^-1 r`` with ``q = M T^-1 M^H`` diagonal in
    frequency: a two-dimensional problem however many planes there are. Erasures are part of ``C`` and cost
    nothing.

    The preconditioner ``C F^-1 1 / (1 + q / 2) F C^T`` is the inverse for a sensor that covers half the grid.

    Parameters
    ----------
    grid_shape : (int, int)
    window : tuple of slice
        Where the sensor lies on the grid.
    valid : ndarray of bool, (height, width), optional
        Pixels that were measured; default all.
    background : BackgroundRemoval, optional
        A smooth background to be estimated as well, for the same valid pixels: a projection that is a further
        factor of ``C``.
    dtype : dtype
    max_steps : int
    xp : module
        Whose arrays: ``numpy`` or ``cupy``.

    Attributes
    ----------
    tolerance : float
        Residual to reach, relative to the right-hand side (see :meth:`follow`).
    """

    def __init__(
        self,
        grid_shape: tuple[int, int],
        window: tuple[slice, slice],
        valid: npt.NDArray[np.bool_] | None = None,
        background: BackgroundRemoval | None = None,
        *,
        dtype: npt.DTypeLike = np.float32,
        max_steps: int = 30,
        xp: Namespace = np,
    ) -> None:
        self.xp = xp
        self.window = window
        self.tolerance = 1e-4
        self.max_steps = max_steps
        self.dtype = np.dtype(dtype)
        self._basis = None if background is None else [xp.asarray(part) for part in background.basis(0)]
        self._mask = None if valid is None or valid.all() else xp.asarray(valid.astype(self.dtype))
        self._plane = xp.zeros(grid_shape, self.dtype)
        self._spectrum = xp.empty(fft.spectrum_shape(grid_shape), fft.complex_dtype(self.dtype))
        self._q = xp.zeros(fft.spectrum_shape(grid_shape), self.dtype)
        self._preconditioner = xp.ones_like(self._q)
        self.steps = 0

    def set_curvature(self, q: Array) -> None:
        """Give ``q``, real, on the half spectrum."""
        self._q[...] = q
        self.xp.divide(1.0, 1.0 + 0.5 * q, out=self._preconditioner)

    def follow(self, progress: float) -> None:
        """Set the tolerance by how far the solver around it has still to go (a relative residual).

        Inexact at first, then always ahead of the solver, so that it can converge as far as it is asked to.
        """
        floor = 10 * float(np.finfo(self.dtype).eps)
        self.tolerance = float(np.clip(0.02 * progress, floor, 1e-4))

    def crop(self, plane: Array) -> Array:
        """``C``: what the sensor says of a plane. A copy."""
        return self.masked(plane[self.window].copy())

    def masked(self, image: Array) -> Array:
        """Take out, in place, what says nothing: pixels that are not valid, a smooth background."""
        if self._mask is not None:
            image *= self._mask
        if self._basis is not None:
            rows, columns, inverse = self._basis
            coefficients = rows @ image.astype(np.float64) @ columns.T
            best = (inverse @ coefficients.ravel()).reshape(coefficients.shape)
            image -= (rows.T @ best @ columns).astype(self.dtype)
            if self._mask is not None:
                image *= self._mask
        return image

    def spectrum_of(self, e: Array) -> Array:
        """``F C^T e``, in an array that the next call overwrites."""
        self._plane[...] = 0
        self._plane[self.window] = e
        return fft.rfft(self._plane, out=self._spectrum)

    def from_spectrum(self, X: Array) -> Array:
        """``C F^-1 X``; overwrites ``X``."""
        return self.crop(fft.irfft(X, self._plane.shape[1], out=self._plane))

    def _filtered(self, e: Array, transfer: Array) -> Array:
        X = self.spectrum_of(e)
        X *= transfer
        return self.from_spectrum(X)

    def _bend(self, e: Array) -> Array:
        """``C q C^T e``."""
        return self._filtered(e, self._q)

    def solve(self, right: Array, e: Array) -> None:
        """Improve ``e`` in place until the residual is down to the tolerance."""
        xp = self.xp
        target = self.tolerance * float(xp.linalg.norm(right))
        if not np.isfinite(target):
            e[...] = np.nan
            return
        residual = right - e - self._bend(e)
        direction = xp.zeros_like(e)
        rho = 1.0
        self.steps = 0
        while float(xp.linalg.norm(residual)) > target and self.steps < self.max_steps:
            z = self._filtered(residual, self._preconditioner)
            rho, rho_before = float(xp.vdot(residual, z)), rho
            if not rho > 0:  # what is left is less than the arithmetic can tell
                break
            direction *= rho / rho_before if self.steps else 0.0
            direction += z
            image = direction + self._bend(direction)
            length = e.dtype.type(rho / float(xp.vdot(direction, image)))
            e += length * direction
            residual -= length * image
            self.steps += 1


def residual_norm(e: Array) -> float:
    """``||e||``; infinity where it is not a number, which a stopping rule takes for lost."""
    norm = float(namespace_of(e).linalg.norm(e))
    return norm if np.isfinite(norm) else np.inf
