"""Finite differences between neighbouring pixels, the ``Psi`` of total variation."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.base import Array, LinearOperator


class Differences(LinearOperator):
    """``weights[i] * (x[next along axis i] - x)``, stacked over the trailing axes.

    Parameters
    ----------
    shape : tuple of int
        Shape of the object, channels first.
    weights : array, (n_axes,) or (n_z, n_axes)
        One for each of the trailing axes, e.g. ``(1, 1)`` for a picture; a volume's depth axis wants its own.
        Of a volume also for each depth.
    wrap : tuple of bool, optional
        Whether the last pixel of an axis neighbours the first; default True for all. Wrapped differences are
        diagonal in Fourier space. Without wrapping the last difference is zero.
    dtype : dtype
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        weights: npt.ArrayLike,
        wrap: tuple[bool, ...] | None = None,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        self.weights = np.asarray(weights, np.float64)
        n_axes = self.weights.shape[-1]
        super().__init__(shape, (n_axes, *shape), dtype)
        by_depth = self.weights.ndim == 2 and len(shape) >= 3 and len(self.weights) == shape[-3]
        if not 1 <= n_axes <= len(shape) or not (self.weights.ndim == 1 or by_depth):
            raise ValueError(f"Weights {self.weights.shape} do not fit an object of shape {shape}.")
        self.wrap = (True,) * n_axes if wrap is None else wrap
        if len(self.wrap) != n_axes:
            raise ValueError(f"wrap has {len(self.wrap)} entries for {n_axes} weights.")

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return the differences, one object-sized array for each axis."""
        out = np.empty(self.range_shape, self.dtype) if out is None else out
        for d, axis, weight, wrap in self._axes(out):
            first, last, inner, shifted = _parts(axis)
            np.subtract(x[shifted], x[inner], out=d[inner])
            d[last] = x[first] - x[last] if wrap else 0
            d *= weight
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Return minus the divergence of the differences ``y``."""
        out = np.empty(self.domain_shape, self.dtype) if out is None else out
        out[...] = 0
        for d, axis, weight, wrap in self._axes(y):
            first, last, inner, shifted = _parts(axis)
            flow = d * weight
            if not wrap:
                flow[last] = 0
            out -= flow
            out[shifted] += flow[inner]
            out[first] += flow[last]
        return out

    @property
    def norm_bound(self) -> float:
        """``2 sqrt(sum weights^2)``: a difference at most doubles."""
        return 2 * float(np.sqrt((self.weights**2).reshape(-1, len(self.wrap)).max(axis=0).sum()))

    def _axes(self, stack: Array) -> list[tuple[Array, int, Array, bool]]:
        n = len(self.wrap)
        # By depth: a number for each plane, whatever axes follow.
        weights = self.weights.T.astype(self.dtype).reshape(n, -1, 1, 1)
        each = weights if self.weights.ndim == 2 else weights[:, 0, 0, 0]
        return [(stack[i], i - n, each[i], self.wrap[i]) for i in range(n)]


def _parts(axis: int) -> tuple[Any, Any, Any, Any]:
    """Index the first, last, all but last and all but first elements along a trailing axis."""
    rest = (slice(None),) * (-axis - 1)
    return tuple((..., part, *rest) for part in (slice(0, 1), slice(-1, None), slice(0, -1), slice(1, None)))  # type: ignore[return-value]
