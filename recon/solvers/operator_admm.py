"""ADMM for any camera, the data term solved exactly on the sensor: the local and low-rank models' solver.

Solves ``min_{x >= 0} 1/2 ||b - A x||^2 + tau ||Psi x||_1`` (or with ``tau ||x||_1``, or any prior that has a
prox) for an operator of which nothing is known but ``forward`` and ``adjoint``. As in
:mod:`recon.solvers.volume_admm` only the priors
are split off, and the update of x is moved to the sensor plane:

    x = T^-1 (r + A^H e / mu),  (I + A T^-1 A^H / mu) e = b - A T^-1 r,  T = Psi^T Psi + kappa

A convolution makes that system diagonal but for the crop. Here each conjugate gradient step costs a forward
and an adjoint, so the preconditioner matters: that of the camera whose PSF is everywhere the central one. Few
steps an iteration suffice, warm-started. Without wrap-around, cosine transforms along every axis invert T
(which is the identity for l1, where this is Douglas-Rachford splitting).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from recon.base.threads import get_threads
from recon.camera.base import Array, LinearOperator
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval
from recon.priors.base import Prior, Separable
from recon.priors.total_variation import TotalVariation
from recon.solvers.base import IterationRecord, Solver
from recon.solvers.prior_splits import ProxSplit, kept_splits, require_exact, restore_splits
from recon.solvers.splitting import SensorData, SensorSystem, Tuning, is_due, residual_norm

_PENALTY = 0.5
"""First penalty relative to the mean curvature of the data term."""
_MOST_STEPS = 8
"""Conjugate gradient steps of one iteration at most: each costs as much as an iteration of FISTA."""


class OperatorSystem(SensorSystem):
    """``(I + C A T^-1 A^H C) e = r`` for an operator, preconditioned as a convolution."""

    def __init__(
        self,
        central: Convolution,
        valid: npt.NDArray[np.bool_] | None,
        background: BackgroundRemoval | None,
        bend: Callable[[Array], Array],
    ) -> None:
        super().__init__(
            central.grid_shape,
            central.sensor_window,
            valid,
            background,
            dtype=central.dtype,
            max_steps=_MOST_STEPS,
        )
        self._operator_bend = bend

    def _bend(self, e: Array) -> Array:
        return self.masked(self._operator_bend(e))


class OperatorAdmm(Solver):
    """ADMM for one channel of a picture or volume seen by any operator.

    Parameters
    ----------
    operator : LinearOperator
        Domain (1, n_z, height, width), range (1, sensor height, sensor width); without erasures and
        background.
    central : Convolution
        The camera that has the central PSF of each depth everywhere, for the same sensor: what the operator
        is preconditioned with.
    data : ndarray, (1, height, width), or SensorData
    prior : Prior
        Total variation without wrap-around (``axis_weights`` (z, y, x), ``wrap`` all False), separable
        priors, and any other with an exact prox.
    initial : ndarray, ``operator.domain_shape``, optional
    tuning : Tuning, optional
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "x", "_differences", "e", "penalty", "_used_penalty", "_misfit", "_tolerance",
    )  # fmt: skip

    def __init__(
        self,
        operator: LinearOperator,
        central: Convolution,
        data: Array | SensorData,
        prior: Prior,
        *,
        initial: Array | None = None,
        tuning: Tuning | None = None,
    ) -> None:
        super().__init__()
        self.operator = operator
        tuning = tuning or Tuning()
        self.relaxation = tuning.relaxation or 1.7
        self.balance = tuning.balance
        dtype = operator.dtype
        tv, self.separable, others = _split(prior)
        self.weight = tv.weight if tv else 0.0
        self.isotropic = bool(tv and tv.isotropic)
        self.kappa = dtype.type(tuning.kappa if tv else 1.0)
        self._psi = tv.differences(np.empty(operator.domain_shape, dtype)) if tv else None
        self.x = np.zeros(operator.domain_shape, dtype)
        if initial is not None:
            self.x[...] = initial
        self.splits = tuple(ProxSplit(term, self.x) for term in (self.separable, *others))
        # What the splits of x itself add to T.
        self._pixels = float(self.kappa) * len(self.splits)
        weights = None if tv is None else tv.axis_weights
        self._eigenvalues = None if weights is None else self._laplacian(weights)
        data = SensorData.of(data)
        self.system = OperatorSystem(central, data.valid, data.background, self._bend)
        self.data = self.system.masked(np.array(data.image[0], dtype))
        self._central_power = central.power()[0]
        self._lateral = self._lateral_eigenvalues(central, weights)
        self._differences = np.zeros((0,), dtype) if self._psi is None else self._psi.forward(self.x)
        self.e = self.data - self.system.masked(operator.forward(self.x)[0])
        first = _PENALTY * float(self._central_power.mean()) if tuning.first is None else tuning.first
        self.penalty = self._used_penalty = float(first)
        self._misfit = 0.5 * float(np.vdot(self.e, self.e))

    def _laplacian(self, weights: Array) -> Array:
        """Eigenvalues of T under cosine transforms."""
        n_z, height, width = self.operator.domain_shape[1:]
        axes = [
            w * w * 4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2
            for w, n in zip(weights, (n_z, height, width), strict=True)
        ]
        total = axes[0][:, None, None] + axes[1][:, None] + axes[2] + self._pixels
        return np.asarray(total, self.operator.dtype)

    def _lateral_eigenvalues(self, central: Convolution, weights: Array | None) -> Array:
        """T as the preconditioner has it: periodic, and without depth."""
        if weights is None:
            return np.full((1, 1), self._pixels, self.operator.dtype)
        height, width = central.grid_shape
        y, x = (4 * np.sin(np.pi * np.arange(n) / n) ** 2 for n in (height, width))
        total = weights[1] ** 2 * y[:, None] + weights[2] ** 2 * x[: width // 2 + 1] + self._pixels
        return np.asarray(total, self.operator.dtype)

    def _invert(self, x: Array) -> Array:
        """``T^-1 x``; may overwrite ``x``."""
        if self._eigenvalues is None:
            if self._pixels != 1:
                x /= x.dtype.type(self._pixels)
            return x
        from scipy.fft import dctn, idctn

        X = dctn(x[0], norm="ortho", overwrite_x=True, workers=get_threads())
        X /= self._eigenvalues
        back: Array = idctn(X, norm="ortho", overwrite_x=True, workers=get_threads())
        return back[None]

    def _bend(self, e: Array) -> Array:
        """Return ``A T^-1 A^H e / mu``."""
        seen: Array = self.operator.forward(self._invert(self.operator.adjoint(e[None])))[0]
        seen /= seen.dtype.type(self._used_penalty)
        return seen

    @property
    def solution(self) -> Array:
        """The split variable that obeys the bounds; without any, the first other prior's."""
        return self.splits[1 if self.separable.is_zero and len(self.splits) > 1 else 0].split

    def _prox_differences(self, s: Array, mu: float) -> Array:
        threshold = s.dtype.type(self.weight / mu)
        if not self.isotropic:
            return np.asarray(s - np.clip(s, -threshold, threshold))
        size = np.sqrt(np.sum(s * s, axis=0))
        return np.asarray(s * (np.maximum(size - threshold, 0) / np.maximum(size, np.finfo(s.dtype).tiny)))

    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` is that of the iterate before, negative parts aside."""
        mu = self.penalty
        kappa, relaxation = float(self.kappa), self.relaxation if self.iteration else 1.0
        r = np.zeros_like(self.x)
        sums, moved, size = np.zeros(4), 0.0, float(np.vdot(self.x, self.x))
        for split in self.splits:
            split.set_penalty(mu * kappa)
            split.meet(self.x, relaxation)
            r += self.kappa * (2 * split.split - split.state)
            primal, change, _, multiplier = split.sums
            sums += kappa * np.array([primal, change, size, multiplier])
            moved = max(moved, change)
        value = self.separable.weight * float(np.sum(np.abs(self.x), dtype=np.float64))
        value += sum(split.prior.value(split.split) for split in self.splits[1:])
        if self._psi is not None:
            d = self._psi.forward(self.x)
            value += self.weight * self._variation(d)
            u, parts = self._advance(self._differences, d, relaxation)
            r += self._psi.adjoint(2 * u - self._differences)
            sums += parts
        primal, dual, size_of_all, multiplier = sums
        self._used_penalty = mu
        self.system.set_curvature(self._central_power / (self._lateral * self._lateral.dtype.type(mu)))
        estimate = self._invert(r)
        self.system.solve(self.data - self.system.masked(self.operator.forward(estimate)[0]), self.e)
        back = self._invert(self.operator.adjoint(self.e[None]))
        back /= back.dtype.type(mu)
        estimate += back
        self.x = estimate
        record = IterationRecord(
            0,
            0.0,
            self._misfit + value,
            residual_norm(self.e),
            primal_residual=float(np.sqrt(primal / max(size_of_all, 1e-300))),
            dual_residual=float(np.sqrt(dual / max(multiplier, 1e-300))),
            change=float(np.sqrt(moved / max(size, 1e-300))),
        )
        self._misfit = 0.5 * float(np.vdot(self.e, self.e))
        if self.balance and is_due(self.iteration) and record.dual_residual > 0:
            ratio = np.sqrt(record.primal_residual / record.dual_residual)
            self.penalty *= float(np.clip(ratio, 0.2, 5.0))
        self.system.follow(max(record.primal_residual, record.dual_residual))
        return record

    def _advance(self, s: Array, kx: Array, relaxation: float) -> tuple[Array, Array]:
        """Advance the differences' state in place, from the penalty used last to the present one.

        Returns the split variable, and squared norms: primal and dual residual, ``K x``, multiplier.
        """
        before = self._prox_differences(s, self._used_penalty)
        scale = s.dtype.type(self._used_penalty / self.penalty)
        s -= before
        s *= scale
        s += (1 - s.dtype.type(relaxation)) * before
        s += s.dtype.type(relaxation) * kx
        split = self._prox_differences(s, self.penalty)
        parts = (kx - split, split - before, kx, s - split)
        return split, np.array([float(np.vdot(v, v)) for v in parts])

    def _variation(self, d: Array) -> float:
        sizes = np.sqrt(np.sum(d * d, axis=0)) if self.isotropic else np.abs(d)
        return float(np.sum(sizes, dtype=np.float64))

    @property
    def _tolerance(self) -> float:
        """Part of the state: how exactly the sensor's system is solved next."""
        return self.system.tolerance

    @_tolerance.setter
    def _tolerance(self, value: float) -> None:
        self.system.tolerance = value

    def _start(self) -> Array | None:
        return None

    def checkpoint(self, *, copy: bool = True) -> dict[str, Any]:
        """Return the state, with that of the priors' splits."""
        return {**super().checkpoint(copy=copy), **kept_splits(self.splits)}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint taken from a solver of the same problem."""
        super().restore(state)
        restore_splits(self.splits, state)


def _split(prior: Prior) -> tuple[TotalVariation | None, Separable, tuple[Prior, ...]]:
    """Take a prior apart: total variation without wrap-around, the separable part, and all others."""
    tv, separable, others = None, Separable(), []
    for term in prior.terms():
        if isinstance(term, Separable):
            separable = separable.with_separable(term)
        elif tv is None and isinstance(term, TotalVariation) and _is_not_periodic(term):
            tv = term
        else:
            others.append(term)
    require_exact(*others)
    return tv, separable, tuple(others)


def _is_not_periodic(tv: TotalVariation) -> bool:
    return tv.axis_weights.shape == (3,) and tv.wrap == (False, False, False)
