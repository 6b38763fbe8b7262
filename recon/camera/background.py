"""A smooth background that is estimated along with the object (Kuo 2020, Eqs. 6.1 and 6.2).

The dissertation solves ``min_{y, g} 1/2 ||b - (A y + g)||^2 + prior(y)`` for ``g`` with low DCT frequencies
only. Given ``y``, the best ``g`` is the projection of ``b - A y`` onto those frequencies; put back, what is
left is ``min_y 1/2 ||P (b - A y)||^2 + prior(y)`` with ``P`` the projection onto the rest. So the joint
problem needs no further unknowns, no step of its own and no start for ``g``: ``P`` is one more factor of the
operator. The dissertation also asks for ``g >= 0``: :meth:`BackgroundRemoval.non_negative` is the projection
onto backgrounds that obey it (see :mod:`recon.reconstruction.solve`).

A prior that does not mind a smooth object (total variation) leaves object and background to be exchanged for
one another; l1, as in Eq. 6.2, does not.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.camera.base import Array, LinearOperator

_SAMPLES = 6
"""Points at which non-negativity is asked for, for each frequency along an axis."""


class BackgroundRemoval(LinearOperator):
    """Projection of data onto what low DCT frequencies cannot explain; its own adjoint.

    Parameters
    ----------
    shape : (n_channels, height, width)
        Shape of the data.
    n_frequencies : (int, int)
        How many of the lowest frequencies along y and x belong to the background; 5 x 5 in the dissertation.
    valid : ndarray of bool, broadcast to ``shape``, optional
        Pixels that were measured; the others are zero in the result.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        n_frequencies: tuple[int, int] = (5, 5),
        valid: npt.NDArray[np.bool_] | None = None,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        super().__init__(shape, shape, dtype)
        _, height, width = shape
        ny, nx = min(n_frequencies[0], height), min(n_frequencies[1], width)
        self._rows, self._columns = _cosines(ny, height), _cosines(nx, width)
        valid = np.ones(shape, bool) if valid is None else np.broadcast_to(np.asarray(valid, bool), shape)
        self._valid = None if valid.all() else valid
        # Gram matrix of the basis on the valid pixels, (n_channels, ny nx, ny nx); the identity if all are.
        self._inverse = np.stack([np.linalg.pinv(self._gram(mask)) for mask in valid])

    def _gram(self, mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
        yy = np.einsum("ay,by->aby", self._rows, self._rows).reshape(-1, mask.shape[0])
        xx = np.einsum("ax,bx->abx", self._columns, self._columns).reshape(-1, mask.shape[1])
        ny, nx = len(self._rows), len(self._columns)
        gram = (yy @ mask.astype(np.float64) @ xx.T).reshape(ny, ny, nx, nx)
        return np.asarray(gram.transpose(0, 2, 1, 3).reshape(ny * nx, ny * nx))

    def basis(self, channel: int) -> tuple[Array, Array, Array]:
        """Return what :meth:`background` computes with: cosines along y and x, inverse Gram matrix."""
        return self._rows, self._columns, self._inverse[channel]

    def background(self, y: Array) -> Array:
        """Return the smooth part of ``y`` on all pixels: the least-squares fit to the valid ones."""
        fitted = np.empty(self.range_shape, self.dtype)
        for channel, image in enumerate(y):
            masked = image if self._valid is None else image * self._valid[channel]
            coefficients = self._rows @ masked.astype(np.float64) @ self._columns.T
            best = (self._inverse[channel] @ coefficients.ravel()).reshape(coefficients.shape)
            fitted[channel] = self._rows.T @ best @ self._columns
        return fitted

    def non_negative(self, y: Array) -> Array:
        """Return the smooth image nearest to ``y`` on the valid pixels that is nowhere negative.

        A quadratic problem in a few coefficients, solved exactly through its dual by non-negative least
        squares, with ``g >= 0`` on a grid several times finer than the highest frequency; what is left
        between the grid's points is lifted off.
        """
        from scipy.optimize import nnls

        rows, columns = (
            basis[:, np.unique(np.linspace(0, basis.shape[1] - 1, _SAMPLES * len(basis)).astype(int))]
            for basis in (self._rows, self._columns)
        )
        samples = np.einsum("ay,bx->yxab", rows, columns).reshape(-1, len(rows) * len(columns))
        fitted = np.empty(self.range_shape, self.dtype)
        for channel, image in enumerate(y):
            masked = image if self._valid is None else image * self._valid[channel]
            wanted = (self._rows @ masked.astype(np.float64) @ self._columns.T).ravel()
            values, vectors = np.linalg.eigh(self._inverse[channel])
            root = (vectors * np.sqrt(np.maximum(values, 0))).T
            scale = max(float(np.abs(root @ wanted).max()), 1e-30)
            push, _ = nnls(root @ samples.T, -(root @ wanted) / scale)
            best = self._inverse[channel] @ (wanted + scale * (samples.T @ push))
            best = best.reshape(len(self._rows), len(self._columns))
            smooth = self._rows.T @ best @ self._columns
            fitted[channel] = smooth - min(float(smooth.min()), 0.0)
        return fitted

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Remove the smooth part."""
        fitted = self.background(x)
        out = np.subtract(x, fitted, out=np.empty_like(fitted) if out is None else out)
        if self._valid is not None:
            out *= self._valid
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Do the same: an orthogonal projection."""
        return self.forward(y, out)

    @property
    def norm_bound(self) -> float:
        """One, as for every orthogonal projection."""
        return 1.0


def _cosines(count: int, length: int) -> npt.NDArray[np.float64]:
    """Return the ``count`` lowest vectors of the orthonormal DCT-II of ``length``."""
    k, n = np.arange(count)[:, None], np.arange(length) + 0.5
    basis = np.sqrt(2 / length) * np.cos(np.pi * k * n / length)
    basis[:1] /= np.sqrt(2)
    return np.asarray(basis, np.float64)
