"""The data's side of the splitting ADMM: ``v = M y``, a circular convolution of which a window is measured.

The split's state ``t = (v + scaled dual)`` lives on the whole grid, but its prox changes it on valid pixels
of the sensor only: ``prox(t) = t - q`` with ``q = w / (w + mu) (t - b)`` there and 0 elsewhere. So the state
is kept as a spectrum, where ``M`` is a product and the reflection ``R(t) = t - 2 q``, and only the sensor's
rows go to real space and back to make ``q``: half-filled transforms, three quarters of the work of whole
ones, and no sweep over the grid.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.base import fft
from recon.base.threads import over_rows
from recon.camera.base import Array
from recon.camera.convolution import PadCropConvolution
from recon.solvers.cosine_preconditioner import laplacian_eigenvalues


class DataSplit:
    """State of the data's split, and the linear system between the splits.

    Parameters
    ----------
    camera : PadCropConvolution
    data, weight : ndarray, ``camera.range_shape``
        Measurement, and 1 where it is valid, 0 where erased.
    penalty : float
    start : ndarray, ``camera.domain_shape``
        Object to begin with.
    relax : float

    Attributes
    ----------
    T : ndarray, complex, (n_channels, grid_height, grid_width // 2 + 1)
        Spectrum of the state.
    Q : ndarray, complex, as T
        Spectrum of what the state's prox takes off.
    t : ndarray, ``camera.range_shape``
        The state on the sensor.
    sums : ndarray, (n_channels, 5)
        Squared norms of the last update: residual, ``M y - prox(t)``, change of ``prox(t)``, ``prox(t)``,
        ``q``.
    """

    def __init__(
        self,
        camera: PadCropConvolution,
        data: Array,
        weight: Array,
        penalty: float,
        start: Array,
        relax: float,
    ) -> None:
        from recon.solvers import _data_kernels

        self._kernels: Any = _data_kernels
        self._camera, self._data, self._weight = camera, data, weight
        self._penalty = data.dtype.type(penalty)
        self._relax = data.dtype.type(relax)
        height, width = camera.grid_shape
        rows, columns = (laplacian_eigenvalues(n).astype(data.dtype) for n in (height, width))
        self.T = fft.rfft(start)
        fft.multiply(self.T, camera.spectrum)
        self._laplace = rows, columns[: self.T.shape[2]].copy()
        self._grid_sums = np.zeros((height, _data_kernels.N_GRID_SUMS))
        self._sensor_sums = np.zeros((camera.sensor_shape[0], _data_kernels.N_SENSOR_SUMS))
        self._band = np.empty((camera.sensor_shape[0], width), data.dtype)
        self._Y, self._P = np.empty_like(self.T[0]), np.empty_like(self.T[0])
        self.Q = np.empty_like(self.T)
        self.t = np.zeros_like(data)
        self.sums = np.zeros((len(data), 5))
        for channel in range(len(data)):
            self._start(channel)

    def solve(self, channel: int, y: Array, mu_u: Any, mu_w: Any) -> None:
        """Turn a channel's right-hand side of the priors into its object, in place, and update the state.

        Solves ``(mu_v M^T M + mu_u Psi^T Psi + mu_w) y = mu_v M^T R(t) + rhs``.
        """
        H = self._camera.spectrum[channel % len(self._camera.spectrum)]
        rows, columns = self._laplace
        fft.rfft(y, out=self._Y)
        over_rows(
            self._kernels.solve, self._Y, self.T[channel], self.Q[channel], H, self._P,
            mu_w + mu_u * rows, mu_u * columns, self._penalty, self._relax,
            y.shape[1] % 2 == 0, self._grid_sums,
        )  # fmt: skip
        fft.irfft(self._Y, y.shape[1], out=y)
        self._see(channel)

    def _start(self, channel: int) -> None:
        """From a state that agrees with the object to its update, ``t <- t + relax (M y - prox(t))``."""
        T = self.T[channel]
        self._P[...] = T
        self._see(channel)
        T += self._relax * self.Q[channel]
        self._P[...] = T
        self._grid_sums[0] = 0.0, _energy(T, self._band.shape[1])
        self._see(channel)

    def _see(self, channel: int) -> None:
        """From the state's spectrum in ``_P`` to what its prox takes off, and the sums."""
        top, left = self._camera.corner
        band, k = self._band, self._kernels
        fft.irfft_strip(self._P[None], top, band[None])
        over_rows(
            k.see, band, left, self.t[channel], self._data[channel], self._weight[channel],
            self._penalty, self._relax, self._sensor_sums,
        )  # fmt: skip
        fft.rfft_strip(band[None], top, self.Q[channel][None])
        seen = self._sensor_sums.sum(axis=0)
        grid = self._grid_sums.sum(axis=0) / np.prod(self._camera.grid_shape)
        # Off the sensor prox(t) = t: what is there is the whole grid's, by Parseval, less what was seen.
        step = max(float(grid[k.STEP] - seen[k.STEP_SEEN]), 0.0)
        state = max(float(grid[k.STATE] - seen[k.STATE_SEEN]), 0.0)
        self.sums[channel] = (
            seen[k.DATA],
            seen[k.PRIMAL] + (1 - self._relax) ** 2 * step,
            seen[k.CHANGE] + self._relax**2 * step,
            seen[k.NORM] + state,
            seen[k.MULTIPLIER],
        )


def _energy(spectrum: Array, width: int) -> float:
    """Squared norm of a whole spectrum of which the half of an image of that width is given."""
    each = np.abs(spectrum).astype(np.float64) ** 2
    alone = each[:, 0].sum() + (each[:, -1].sum() if width % 2 == 0 else 0.0)
    return float(2 * each.sum() - alone)
