"""The dissertation's ADMM for volumes, to the letter (Kuo 2020, Eq. 4.5 and Appendix A.3): the reference.

Three splits, ``v = M x`` (a volume: a circular three-dimensional convolution with the depth-flipped PSF
stack, of which the sensor sees the cropped first plane), ``u = Psi x`` and ``w = x``, with closed-form
updates by three-dimensional FFTs. Differences wrap around in depth. It keeps twelve volumes and takes several
times the iterations of :class:`~recon.solvers.tv_admm_volume.LeanTotalVariation`; both reach the same
minimiser where the first and last planes are empty. For comparisons and tests.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from recon.arrays import Array, Float64Array
from recon.base import fft
from recon.camera.convolution import Convolution
from recon.solvers.base import IterationRecord, Solver


class LiteralAdmm(Solver):
    """ADMM with three splits for one channel of a volume with TV (or l1) and non-negativity.

    Parameters
    ----------
    operator : Convolution
        One channel.
    data : ndarray, (1, height, width)
    weight : float
        tau of Eq. 4.2, absolute.
    axis_weights : (float, float, float), or None
        Weights of the z, y and x differences; None takes the identity as Psi: l1.
    penalties : (float, float, float)
        mu_1 (data), mu_2 (prior), mu_3 (non-negativity).
    balance : bool
        Residual balancing of each penalty: doubled or halved where primal and dual residual differ more than
        tenfold (Boyd et al. 2011, sec. 3.4.1), which is what the dissertation calls automatic tuning.
    balance_every : int
        Iterations between two looks at the balance.
    initial : ndarray, ``operator.domain_shape``, optional
        Starting point; default zeros.
    """

    state_names: ClassVar[tuple[str, ...]] = ("x", "Mx", "Px", "u", "v", "w", "xi", "eta", "rho", "mu")

    def __init__(
        self,
        operator: Convolution,
        data: Array,
        weight: float,
        *,
        axis_weights: tuple[float, float, float] | None = (1.0, 1.0, 1.0),
        penalties: tuple[float, float, float],
        balance: bool = False,
        balance_every: int = 1,
        initial: Array | None = None,
    ) -> None:
        super().__init__()
        self.operator = operator
        self.weight = float(weight)
        self.axis_weights = axis_weights
        self.balance = balance
        self.balance_every = balance_every
        self.mu: Float64Array = np.array(penalties, np.float64)
        dtype = operator.dtype
        self.shape = operator.domain_shape[1:]
        self.window = (0, *operator.sensor_window)
        self.data = np.asarray(data, dtype)[0]
        kernel = np.zeros(self.shape, dtype)
        for z in range(self.shape[0]):
            transfer = operator.transfer_plane(z)
            kernel[-z % self.shape[0]] = fft.irfft(transfer, self.shape[2])
        self.M = fft.rfft(kernel, axes=3)
        self._psi_power = self._power_of_psi()
        self.x = np.zeros(self.shape, dtype)
        if initial is not None:
            self.x[...] = np.reshape(initial, self.shape)
        self.Mx = self._convolve(self.x)
        self.Px = self._psi(self.x)
        self.u, self.eta = np.zeros_like(self.Px), np.zeros_like(self.Px)
        self.v, self.xi = np.zeros_like(self.x), np.zeros_like(self.x)
        self.w, self.rho = np.maximum(self.x, 0), np.zeros_like(self.x)

    def _power_of_psi(self) -> Array:
        if self.axis_weights is None:
            return np.ones(1, self.operator.dtype)
        nz, ny, nx = self.shape
        frequencies = np.arange(nz) / nz, np.arange(ny) / ny, np.arange(nx // 2 + 1) / nx
        dz, dy, dx = (
            (2 * w * np.sin(np.pi * f)) ** 2 for w, f in zip(self.axis_weights, frequencies, strict=True)
        )
        power: Array = (dz[:, None, None] + dy[:, None] + dx).astype(self.operator.dtype)
        return power

    def _psi(self, x: Array) -> Array:
        weights = self.axis_weights
        parts = [x] if weights is None else [w * (np.roll(x, -1, a) - x) for a, w in enumerate(weights)]
        return np.stack(parts)

    def _psi_adjoint(self, u: Array) -> Array:
        if self.axis_weights is None:
            only: Array = u[0].copy()
            return only
        terms: list[Array] = [w * (np.roll(u[a], 1, a) - u[a]) for a, w in enumerate(self.axis_weights)]
        total: Array = terms[0] + terms[1] + terms[2]
        return total

    def _convolve(self, x: Array, adjoint: bool = False) -> Array:
        X = fft.rfft(x, axes=3)
        X *= np.conj(self.M) if adjoint else self.M
        return fft.irfft(X, self.shape[2], axes=3)

    def step(self) -> IterationRecord:
        """Do the updates in the dissertation's order."""
        mu1, mu2, mu3 = (self.x.dtype.type(m) for m in self.mu)
        threshold = self.x.dtype.type(self.weight) / mu2
        u_old, v_old, w_old = self.u, self.v, self.w

        s = self.Px + self.eta / mu2
        self.u = s - np.clip(s, -threshold, threshold)
        self.v = self.xi + mu1 * self.Mx
        self.v[self.window] += self.data
        diagonal = np.full(self.shape, mu1)
        diagonal[self.window] += 1
        self.v /= diagonal
        self.w = np.maximum(self.rho / mu3 + self.x, 0)
        r = mu3 * self.w - self.rho + self._psi_adjoint(mu2 * self.u - self.eta)
        r += self._convolve(mu1 * self.v - self.xi, adjoint=True)
        R = fft.rfft(r, axes=3)
        R /= mu1 * (self.M.real**2 + self.M.imag**2) + mu2 * self._psi_power + mu3
        self.Mx = fft.irfft(R * self.M, self.shape[2], axes=3)
        x_old, self.x = self.x, fft.irfft(R, self.shape[2], axes=3)
        self.Px = self._psi(self.x)
        self.xi += mu1 * (self.Mx - self.v)
        self.eta += mu2 * (self.Px - self.u)
        self.rho += mu3 * (self.x - self.w)

        norm = np.linalg.norm
        primal = np.array([norm(self.Mx - self.v), norm(self.Px - self.u), norm(self.x - self.w)])
        dual = self.mu * [
            norm(self._convolve(self.v - v_old, adjoint=True)),
            norm(self._psi_adjoint(self.u - u_old)),
            norm(self.w - w_old),
        ]
        if self.balance and self.iteration % self.balance_every == 0:
            self.mu = np.where(primal > 10 * dual, self.mu * 2, self.mu)
            self.mu = np.where(dual > 10 * primal, self.mu / 2, self.mu)
        misfit = float(norm(self.Mx[self.window] - self.data))
        size = float(norm(self.x)) or 1.0
        return IterationRecord(
            0,
            0.0,
            0.5 * misfit**2 + self.weight * float(np.abs(self.Px).sum()),
            misfit,
            float(norm(primal)) / size,
            float(norm(dual)) / (float(norm(self.rho)) or 1.0),
            change=float(norm(self.x - x_old)) / size,
        )

    @property
    def solution(self) -> Array:
        """The non-negative iterate w."""
        return self.w[None]
