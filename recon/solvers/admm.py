"""The fast ADMM for a cropped convolution with total variation, l1 and bounds (Kuo 2020, Eq. 4.5, A.3).

The splitting is that of Eq. A.4 in two dimensions: ``v = M y`` (the circular convolution), ``u = Psi y`` (the
differences), ``w = y``. Written with one state a split, ``t = (split variable + scaled dual)``: with
``R(t) = 2 prox(t) - t``,

``(mu_v M^T M + mu_u Psi^T Psi + mu_w) y = mu_v M^T R(t_v) + mu_u Psi^T R(t_u) + mu_w R(t_w)``
``t <- t + relax (K y - prox(t))`` for each split ``K``.

That is ADMM with over-relaxation, in 4 real FFTs and two sweeps over memory an iteration, with right-hand
sides written over ``y`` and ``M y``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from recon import fft
from recon.operators.base import Array, LinearOperator
from recon.operators.convolution import PadCropConvolution
from recon.priors.base import Prior
from recon.priors.total_variation import TotalVariation
from recon.solvers.base import Solver
from recon.solvers.prior_splits import STRIPS, ratio, soft_pair, split_prior
from recon.solvers.stopping import IterationRecord
from recon.solvers.structure import as_cropped_convolution
from recon.threads import in_blocks

SETTLING = (4, 8, 16, 32)
"""Iterations before which the penalty of the differences is set from the object so far."""


@dataclass(frozen=True, slots=True)
class Penalties:
    """Penalty parameters of the three splits.

    ``differences`` and ``separable`` are relative to the mean of ``|H|^2``, so that none depends on the PSF's
    brightness. The defaults were found on dense, sparse and measured scenes at signal-to-noise ratios from 50
    to 1000: after 100 iterations within about a factor of two of each scene's best constants.
    """

    data: float = 0.1
    differences: float | None = None
    """Default: from the object as it emerges, such that total variation's threshold is a tenth of its
    brightness (its 99.9th percentile); settled after the first 32 iterations, so that convergence is certain.
    """
    separable: float = 0.3


class Admm(Solver):
    """ADMM for a (masked) :class:`~recon.operators.PadCropConvolution`.

    Parameters
    ----------
    operator : LinearOperator
        A ``PadCropConvolution``, with or without ``Erasures`` after it.
    data : ndarray, ``operator.range_shape``
    prior : Prior
        At most one (wrapped) :class:`~recon.priors.TotalVariation` plus separable priors.
    initial : ndarray, optional
        Starting point on the operator's domain.
    penalties : Penalties, optional
    relax : float
        Over-relaxation, between 1 and 2.
    """

    state_names: ClassVar[tuple[str, ...]] = ("_y", "_my", "_t_v", "_tx", "_ty", "_t_w", "_mu")

    def __init__(
        self,
        operator: LinearOperator,
        data: Array,
        prior: Prior,
        *,
        initial: Array | None = None,
        penalties: Penalties | None = None,
        relax: float = 1.7,
    ) -> None:
        super().__init__()
        from recon.solvers import _split_kernels

        self._kernels: Any = _split_kernels
        structure = as_cropped_convolution(operator)
        self._convolution = structure.convolution
        self._weight = np.ascontiguousarray(structure.weight)
        self._data = np.ascontiguousarray(np.where(structure.weight > 0, data, 0), operator.dtype)
        self._tv, self._separable = split_prior(prior)
        self._isotropic = bool(self._tv and self._tv.isotropic)
        self._scalar = operator.dtype.type
        self.relax = relax

        power = float(np.mean(self._convolution.power))
        penalties = penalties or Penalties()
        self._settles = penalties.differences is None
        differences = 1.0 if penalties.differences is None else penalties.differences
        # One row a split (v, u, w), one column a channel.
        self._mu = np.outer(
            [penalties.data, differences * power, penalties.separable * power], np.ones(len(data))
        )
        shape = operator.domain_shape
        self._y = np.zeros(shape, operator.dtype)
        if initial is not None:
            self._y[...] = initial
        self._my = self._convolution.circular(self._y)
        self._t_v = self._my.copy()
        self._t_w = self._y.copy()
        self._tx = np.roll(self._y, -1, 2) - self._y
        self._ty = np.roll(self._y, -1, 1) - self._y
        self._Y = np.empty(fft.spectrum_shape(shape), fft.complex_dtype(operator.dtype))
        self._MY = np.empty_like(self._Y)
        height, width = shape[1:]
        self._laplace_rows = _laplace(height, operator.dtype)
        self._laplace_columns = _laplace(width, operator.dtype)[: width // 2 + 1].copy()
        strips = min(STRIPS, height)
        self._edges = np.array([height * s // strips for s in range(strips + 1)])
        self._below = np.empty((shape[0], strips, width), operator.dtype)
        self._above = np.empty_like(self._below)
        self._sums = np.zeros((shape[0] * height, self._kernels.N_SUMS))

    @property
    def solution(self) -> Array:
        """The split variable that obeys the separable prior."""
        return np.stack(
            [self._separable.prox(t, 1 / mu) for t, mu in zip(self._t_w, self._mu[2], strict=True)]
        )

    def compile(self) -> None:
        """Do one step of a tiny problem of the same precision."""
        _compile(self._y.dtype)

    def step(self) -> IterationRecord:
        """Update the splits in one sweep over memory, then solve for ``y`` in Fourier space."""
        if self._settles and self._tv and self.iteration in SETTLING:
            self._settle_differences(self._tv.weight)
        self._sweep()
        fft.rfft(self._y, out=self._Y)
        fft.rfft(self._my, out=self._MY)
        self._solve()
        last = self._y.shape[2]
        fft.irfft(self._Y, last, out=self._y)
        fft.irfft(self._MY, last, out=self._my)
        return self._record()

    def _sweep(self) -> None:
        f = self._scalar
        mu_v, mu_u, mu_w = self._mu.astype(self._y.dtype)
        threshold_u = (self._tv.weight / mu_u if self._tv else 0 * mu_u).astype(mu_u.dtype)
        threshold_w = (self._separable.weight / mu_w).astype(mu_w.dtype)
        isotropic = self._isotropic
        relax = f(self.relax)
        self._kernels.save_strip_neighbours(
            self._y, self._tx, self._ty, self._edges, threshold_u, relax, isotropic, self._below, self._above
        )
        top, left = self._convolution.corner

        def strips(start: int, stop: int) -> None:
            self._kernels.sweep(
                start, stop, self._edges, self._below, self._above,
                self._y, self._my, self._t_v, self._tx, self._ty, self._t_w,
                self._data, self._weight, top, left,
                mu_v, mu_u, mu_w, threshold_u, threshold_w,
                f(self._separable.lower), f(self._separable.upper), relax, isotropic, self._sums,
            )  # fmt: skip

        in_blocks(strips, len(self._y) * (len(self._edges) - 1))

    def _solve(self) -> None:
        mu_v, mu_u, mu_w = self._mu.astype(self._y.dtype)

        def rows(start: int, stop: int) -> None:
            self._kernels.solve_spectrum(
                start, stop, self._Y, self._MY, self._convolution.spectrum,
                self._laplace_rows, self._laplace_columns, mu_v, mu_u, mu_w,
            )  # fmt: skip

        in_blocks(rows, self._Y.shape[0] * self._Y.shape[1])

    def _record(self) -> IterationRecord:
        k = self._kernels
        s = self._sums.sum(axis=0)
        data = float(np.sqrt(s[k.DATA]))
        objective = 0.5 * s[k.DATA] + self._separable.weight * s[k.L1]
        if self._tv:
            objective += self._tv.weight * s[k.TV]
        primal = max(ratio(s[k.PRIMAL_V], s[k.NORM_V]), ratio(s[k.PRIMAL_W], s[k.NORM_W]))
        dual = max(ratio(s[k.CHANGE_V], s[k.MULTIPLIER_V]), ratio(s[k.CHANGE_W], s[k.MULTIPLIER_W]))
        if self._tv:
            primal = max(primal, ratio(s[k.PRIMAL_U], s[k.NORM_U]))
            dual = max(dual, ratio(s[k.CHANGE_U], s[k.MULTIPLIER_U]))
        return IterationRecord(
            0, 0.0, float(objective), data, primal, dual, change=ratio(s[k.CHANGE_W], s[k.NORM_W])
        )

    def _settle_differences(self, weight: float) -> None:
        """Set the differences' penalty from each channel's brightness; their dual variable stays."""
        for c, image in enumerate(self.solution[:, ::2, ::2]):
            brightness = float(np.percentile(np.abs(image), 99.9))
            if not (brightness > 0 and weight > 0):
                continue
            old, new = float(self._mu[1, c]), 10 * weight / brightness
            tx, ty = self._tx[c], self._ty[c]
            kept = soft_pair(tx, ty, self._scalar(weight / old), self._isotropic)
            for t, u in zip((tx, ty), kept, strict=True):
                t -= u
                t *= self._scalar(old / new)
                t += u
            self._mu[1, c] = new


@cache
def _compile(dtype: np.dtype[Any]) -> None:
    tiny = PadCropConvolution(np.ones((1, 2, 2)), (2, 2), dtype=dtype)
    Admm(tiny, np.ones((1, 2, 2), dtype), TotalVariation(1.0)).step()


def _laplace(n: int, dtype: np.dtype[Any]) -> Array:
    """Eigenvalues of the wrapped second difference: ``4 sin^2(pi k / n)``."""
    return (4 * np.sin(np.pi * np.arange(n) / n) ** 2).astype(dtype)
