"""ADMM for any camera, the data term solved exactly on the sensor: the local and low-rank models' solver.

As in :mod:`recon.solvers.volume_admm` only the priors are split off, and the update of x is moved to the
sensor plane:

    x = T^-1 (r + A^H e / mu),  (I + A T^-1 A^H / mu) e = b - A T^-1 r,  T = Psi^T Psi + kappa

A convolution makes that system diagonal but for the crop. Here nothing is known of the operator but
``forward`` and ``adjoint``, and each conjugate gradient step costs one of each, so the preconditioner
matters: that of the camera whose PSF is everywhere the central one. Few steps an iteration suffice,
warm-started. Without wrap-around, cosine transforms along every axis invert T (which is the identity for l1,
where this is Douglas-Rachford splitting). That makes kappa free to change: the penalties of total variation
and of the pixels are each balanced by their own residuals, as those of pictures are.
"""

from __future__ import annotations

import weakref
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.base.namespace import require_memory
from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.priors.base import Prior
from recon.priors.total_variation import TotalVariation
from recon.solvers.base import IterationRecord
from recon.solvers.cosine_preconditioner import laplacian_eigenvalues
from recon.solvers.moving import move
from recon.solvers.prior_splits import ProxSplit, balancing, split_prior
from recon.solvers.splitting import Room, SensorData, Tuning, squares
from recon.solvers.volume_admm import ExactAdmm

_VOLUMES = 16
"""x, four states, and what an update of them passes through."""
FIRST_ITERATIONS = 4
"""Iterations from a cold start whose data term has nothing to set out from."""
FIRST_STEPS, STEPS = 8, 4
"""Conjugate gradient steps of these, and of others; each costs as much as the rest of the iteration. With 4,
warm-started, an iteration gains what it gains with 8."""
LEAST_PIXELS = 0.15
"""Penalty of the pixels below which balancing does not take it beside total variation, relative to the mean
power of a plane's PSF. Where hardly a pixel is held by a bound, its residuals say nothing, and it would fall
without end."""


class OperatorAdmm(ExactAdmm):
    """ADMM for one channel of a picture or volume seen by any operator.

    Parameters
    ----------
    camera : LinearOperator
        Domain (1, n_z, height, width), range (1, sensor height, sensor width); without erasures and
        background.
    central : Convolution
        The camera that has the central PSF of each depth everywhere, for the same sensor: what the operator
        is preconditioned with.
    data : ndarray, (1, height, width), or SensorData
    prior : Prior
        Total variation without wrap-around (``axis_weights`` (z, y, x), ``wrap`` all False), separable
        priors, and any other with an exact prox.
    initial : ndarray, ``camera.domain_shape``, optional
    tuning : Tuning, optional
    room : Room, optional
        On which device.
    shown : tuple of slice, optional
        Rows and columns whose change an iteration is told, by default all: the field beyond the sensor, which
        hardly bends the data, goes on moving long after what is shown has settled. All where they are dark.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "x", "S", "e", "penalty", "kappa", "_used_penalty", "_misfit", "system.tolerance",
    )  # fmt: skip

    def __init__(
        self,
        camera: LinearOperator,
        central: Convolution,
        data: Array | SensorData,
        prior: Prior,
        *,
        initial: Array | None = None,
        tuning: Tuning | None = None,
        room: Room | None = None,
        shown: tuple[slice, slice] = (slice(None), slice(None)),
    ) -> None:
        own = weakref.WeakMethod(self._bend)  # else its memory was free only when Python looks for circles
        super().__init__(central, data, tuning, room, 1.7, lambda e: own()(e))  # type: ignore[misc]
        self.camera, self.shown = camera, shown
        dtype = camera.dtype
        tv, self.separable, others = split_prior(prior, _is_not_periodic)
        self.kappa = dtype.type(self.tuning.kappa if tv else 1.0)
        xp = self.xp
        require_memory(xp, _VOLUMES * dtype.itemsize * int(np.prod(camera.domain_shape)))
        self.x: Array = xp.zeros(camera.domain_shape, dtype)
        if initial is not None:
            self.x[...] = xp.asarray(initial)
        self.splits = tuple(ProxSplit(term, self.x) for term in (self.separable, *others))
        self._weights = None if tv is None else tv.axis_weights
        self._cosines = xp.empty_like(self.x[0] if tv else self.x[:0])
        self._psi = tv.differences(self.x) if tv else None
        self.S = xp.zeros(0, dtype) if self._psi is None else self._psi.forward(self.x)
        self._power = xp.asarray(central.power()[0])
        self._invert_anew()
        self._begin(tv, self.system.masked(camera.forward(self.x)[0]), self._power)
        self._least_pixels = LEAST_PIXELS * float(self._power.mean()) / camera.domain_shape[1]

    def step(self) -> IterationRecord:
        """Do one iteration; the first ones solve their data term better."""
        self.system.max_steps = FIRST_STEPS if self.iteration < FIRST_ITERATIONS else STEPS
        window = (..., *self.shown)
        before = self._solved[window].copy()
        record = super().step()
        now = self._solved[window]
        size = squares(now)
        if size == 0:  # all light is beyond what is shown, and decides
            return record
        return replace(record, change=float(np.sqrt(squares(now - before) / size)))

    def move(self, rows: float, columns: float) -> None:
        """Move object and dual variables."""
        super().move(rows, columns)
        move(self.x, rows, columns)

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint, with its kappa."""
        super().restore(state)
        self._invert_anew()

    def _rebalance(self, residuals: float, sums: Array) -> None:
        """Adapt both penalties, each to its own residuals; the only one, without total variation."""
        if self._weights is None:
            super()._rebalance(residuals, sums)
            return
        pixels = self.penalty * float(self.kappa) * balancing(*sums[5:])
        self.penalty *= balancing(*sums[1:5])
        self.kappa = self.camera.dtype.type(max(pixels, self._least_pixels) / self.penalty)
        self._invert_anew()

    def _invert_anew(self) -> None:
        """Make what T depends on follow kappa."""
        self._pixels = float(self.kappa) * len(self.splits)  # what the splits of x itself add to T
        self._eigenvalues = None if self._weights is None else self._laplacian(self._weights)
        self.system.set_curvature(self._power / self._lateral_eigenvalues(self._weights))

    def _laplacian(self, weights: Array) -> Array:
        """Eigenvalues of T under cosine transforms."""
        n_z, height, width = self.camera.domain_shape[1:]
        axes = [
            w * w * laplacian_eigenvalues(2 * n)[:n]
            for w, n in zip(weights, (n_z, height, width), strict=True)
        ]
        total = axes[0][:, None, None] + axes[1][:, None] + axes[2] + self._pixels
        return self._there(total)

    def _lateral_eigenvalues(self, weights: Array | None) -> Array:
        """T as the preconditioner has it: periodic, and without depth."""
        if weights is None:
            return self._there(np.full((1, 1), self._pixels))
        height, width = self.operator.grid_shape
        y, x = (laplacian_eigenvalues(n) for n in (height, width))
        total = weights[1] ** 2 * y[:, None] + weights[2] ** 2 * x[: width // 2 + 1] + self._pixels
        return self._there(total)

    def _there(self, values: Array) -> Array:
        """Return the host's numbers on the device, in the solver's precision."""
        there: Array = self.xp.asarray(values.astype(self.camera.dtype))
        return there

    def _invert(self, x: Array) -> Array:
        """``T^-1 x``; may overwrite ``x``."""
        if self._eigenvalues is None:
            if self._pixels != 1:
                x /= x.dtype.type(self._pixels)
            return x
        X = fft.dct(x[0], self._cosines)
        X /= self._eigenvalues
        fft.idct(X, x[0])
        return x

    def _bend(self, e: Array) -> Array:
        """Return ``A T^-1 A^H e / mu``."""
        seen: Array = self.camera.forward(self._invert(self.camera.adjoint(e[None])))[0]
        seen /= seen.dtype.type(self._used_penalty)
        return seen

    def _iterate(self) -> Array:
        return self.x

    def _differences(self, x: Array) -> Array:
        assert self._psi is not None
        return self._psi.forward(x)

    def _back(self, d: Array) -> Array:
        assert self._psi is not None
        return self._psi.adjoint(d)

    def _predict(self, r: Array) -> Array:
        self._l1 = self.separable.weight * float(abs(self.x).sum(dtype=np.float64))
        self.x = self._invert(r)
        return self.system.masked(self.camera.forward(self.x)[0])

    def _update(self) -> None:
        back = self._invert(self.camera.adjoint(self.system.weighed(self.e)[None]))
        back /= back.dtype.type(self._used_penalty)
        self.x += back

    def _value(self) -> float:
        return self._l1 + sum(split.prior.checked_value(split.split) for split in self.splits[1:])


def _is_not_periodic(tv: TotalVariation) -> bool:
    return tv.axis_weights.shape == (3,) and tv.wrap == (False, False, False)
