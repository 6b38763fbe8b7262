"""ADMM for any camera, the data term solved exactly on the sensor: the local and low-rank models' solver.

Solves ``min_{x >= 0} 1/2 ||b - A x||^2 + tau ||Psi x||_1`` (or with ``tau ||x||_1``) for an operator of which
nothing is known but ``forward`` and ``adjoint``. As in :mod:`recon.solvers.tv_admm_volume` only the priors
are split off, and the update of x is moved to the sensor plane:

    x = T^-1 (r + A^H e / mu),  (I + A T^-1 A^H / mu) e = b - A T^-1 r,  T = Psi^T Psi + kappa

A convolution makes that system diagonal but for the crop. Here each conjugate gradient step costs a forward
and an adjoint, so the preconditioner matters: that of the camera whose PSF is everywhere the central one. Few
steps an iteration suffice, warm-started. Without wrap-around, cosine transforms along every axis invert T
(which is the identity for l1, where this is Douglas-Rachford splitting).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from recon.base.threads import get_threads
from recon.camera.background import BackgroundRemoval
from recon.camera.base import Array, LinearOperator
from recon.camera.convolution3d import Convolution3D
from recon.priors.differences import Differences
from recon.solvers.balance import is_due
from recon.solvers.base import Solver
from recon.solvers.sensor_system import SensorSystem, residual_norm
from recon.solvers.stopping import IterationRecord

_PENALTY = 0.5
"""First penalty relative to the mean curvature of the data term."""
_MOST_STEPS = 8
"""Conjugate gradient steps of one iteration at most: each costs as much as an iteration of FISTA."""


class OperatorSystem(SensorSystem):
    """``(I + C A T^-1 A^H C) e = r`` for an operator, preconditioned as a convolution."""

    def __init__(
        self,
        central: Convolution3D,
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


@dataclass(frozen=True)
class _Moved:
    """A split variable, and squared norms: primal and dual residual, ``K x``, multiplier."""

    split: Array
    sums: tuple[float, ...]


class OperatorAdmm(Solver):
    """ADMM for one channel of a picture or volume seen by any operator.

    Parameters
    ----------
    operator : LinearOperator
        Domain (1, n_z, height, width), range (1, sensor height, sensor width); without erasures and
        background.
    central : Convolution3D
        The camera that has the central PSF of each depth everywhere, for the same sensor: what the operator
        is preconditioned with.
    data : ndarray, (1, height, width)
    weight : float
        tau, absolute.
    axis_weights : (float, float, float), optional
        Weights of the z, y and x differences of total variation; None for l1.
    isotropic : bool
    valid, background, relaxation, balance
        As :class:`~recon.solvers.splitting.VolumeSplitting`.
    initial : ndarray, ``operator.domain_shape``, optional
    kappa : float
        Penalty of non-negativity relative to that of total variation.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "x", "_pixels", "_differences", "e", "penalty", "_used_penalty", "_misfit", "_tolerance",
    )  # fmt: skip

    def __init__(
        self,
        operator: LinearOperator,
        central: Convolution3D,
        data: Array,
        weight: float,
        *,
        axis_weights: tuple[float, float, float] | None = None,
        isotropic: bool = False,
        valid: npt.NDArray[np.bool_] | None = None,
        background: BackgroundRemoval | None = None,
        initial: Array | None = None,
        kappa: float = 1.0,
        relaxation: float = 1.7,
        balance: bool = True,
    ) -> None:
        super().__init__()
        self.operator = operator
        self.weight = float(weight)
        self.isotropic = isotropic
        self.relaxation = relaxation
        self.balance = balance
        dtype = operator.dtype
        self.kappa = dtype.type(kappa if axis_weights is not None else 1.0)
        self._psi = (
            None
            if axis_weights is None
            else Differences(operator.domain_shape, axis_weights, (False, False, False), dtype)
        )
        self._eigenvalues = None if axis_weights is None else self._laplacian(axis_weights)
        self.system = OperatorSystem(central, valid, background, self._bend)
        self.data = self.system.masked(np.array(data[0], dtype))
        self._central_power = central.power()
        self._lateral = self._lateral_eigenvalues(central, axis_weights)
        self.x = np.zeros(operator.domain_shape, dtype)
        if initial is not None:
            self.x[...] = initial
        self._pixels = self.x.copy()
        self._differences = np.zeros((0,), dtype) if self._psi is None else self._psi.forward(self.x)
        self.e = self.data - self.system.masked(operator.forward(self.x)[0])
        self.penalty = _PENALTY * float(self._central_power.mean())
        self._used_penalty = self.penalty
        self._misfit = 0.5 * float(np.vdot(self.e, self.e))

    def _laplacian(self, weights: tuple[float, float, float]) -> Array:
        """Eigenvalues of T under cosine transforms."""
        n_z, height, width = self.operator.domain_shape[1:]
        axes = [
            w * w * 4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2
            for w, n in zip(weights, (n_z, height, width), strict=True)
        ]
        total = axes[0][:, None, None] + axes[1][:, None] + axes[2] + float(self.kappa)
        return np.asarray(total, self.operator.dtype)

    def _lateral_eigenvalues(
        self, central: Convolution3D, weights: tuple[float, float, float] | None
    ) -> Array:
        """T as the preconditioner has it: periodic, and without depth."""
        if weights is None:
            return np.ones((1, 1), self.operator.dtype)
        height, width = central.grid_shape
        y, x = (4 * np.sin(np.pi * np.arange(n) / n) ** 2 for n in (height, width))
        total = weights[1] ** 2 * y[:, None] + weights[2] ** 2 * x[: width // 2 + 1] + float(self.kappa)
        return np.asarray(total, self.operator.dtype)

    def _invert(self, x: Array) -> Array:
        """``T^-1 x``; may overwrite ``x``."""
        if self._eigenvalues is None:
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
        """The split variable that is not negative."""
        return self._prox_pixels(self._pixels, self._used_penalty)

    def _prox_pixels(self, s: Array, mu: float) -> Array:
        threshold = s.dtype.type(0.0 if self._psi is not None else self.weight / mu)
        return np.asarray(np.maximum(s - threshold, 0))

    def _prox_differences(self, s: Array, mu: float) -> Array:
        threshold = s.dtype.type(self.weight / mu)
        if not self.isotropic:
            return np.asarray(s - np.clip(s, -threshold, threshold))
        size = np.sqrt(np.sum(s * s, axis=0))
        return np.asarray(s * (np.maximum(size - threshold, 0) / np.maximum(size, np.finfo(s.dtype).tiny)))

    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` is that of the iterate before, negative parts aside."""
        mu = self.penalty
        pixels = self._advance(self._pixels, self.x, self._prox_pixels)
        r = self.kappa * (2 * pixels.split - self._pixels)
        primal, dual, size, multiplier = (float(self.kappa) * v for v in pixels.sums)
        prior = self.weight * float(np.sum(np.abs(self.x), dtype=np.float64))
        if self._psi is not None:
            d = self._psi.forward(self.x)
            prior = self.weight * self._variation(d)
            moved = self._advance(self._differences, d, self._prox_differences)
            r += self._psi.adjoint(2 * moved.split - self._differences)
            primal, dual, size, multiplier = (
                a + b for a, b in zip((primal, dual, size, multiplier), moved.sums, strict=True)
            )
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
            self._misfit + prior,
            residual_norm(self.e),
            primal_residual=float(np.sqrt(primal / max(size, 1e-300))),
            dual_residual=float(np.sqrt(dual / max(multiplier, 1e-300))),
            change=float(np.sqrt(pixels.sums[1] / max(pixels.sums[2], 1e-300))),
        )
        self._misfit = 0.5 * float(np.vdot(self.e, self.e))
        if self.balance and is_due(self.iteration) and record.dual_residual > 0:
            ratio = np.sqrt(record.primal_residual / record.dual_residual)
            self.penalty *= float(np.clip(ratio, 0.2, 5.0))
        self.system.follow(max(record.primal_residual, record.dual_residual))
        return record

    def _advance(self, s: Array, kx: Array, prox: Callable[[Array, float], Array]) -> _Moved:
        """Advance the state of one split in place, from the penalty used last to the present one."""
        before = prox(s, self._used_penalty)
        relaxation = self.relaxation if self.iteration else 1.0
        scale = s.dtype.type(self._used_penalty / self.penalty)
        s -= before
        s *= scale
        s += (1 - s.dtype.type(relaxation)) * before
        s += s.dtype.type(relaxation) * kx
        split = prox(s, self.penalty)
        sums = tuple(float(np.vdot(v, v)) for v in (kx - split, split - before, kx, s - split))
        return _Moved(split, sums)

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
