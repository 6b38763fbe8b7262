"""Pixel erasures (Kuo 2020, Eq. 3.10)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.camera.base import Array, LinearOperator


class Erasures(LinearOperator):
    """Set the pixels that carry no information to zero: dead, saturated, deliberately not read.

    Parameters
    ----------
    valid : ndarray of bool, (height, width) or (n_channels, height, width)
        True where the pixel was measured; broadcast to ``shape``.
    shape : tuple of int
        Shape of the data, channels first.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self,
        valid: npt.NDArray[np.bool_],
        shape: tuple[int, ...],
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        super().__init__(shape, shape, dtype)
        self.valid = np.broadcast_to(np.asarray(valid, bool), shape)

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Zero the pixels that are not valid."""
        result: Array = np.multiply(x, self.valid, out=out, dtype=self.dtype)
        return result

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Do the same: the operator is its own adjoint."""
        return self.forward(y, out)

    @property
    def norm_bound(self) -> float:
        """One: pixels are kept or dropped."""
        return 1.0
