"""ADMM with the exact data term for volumes, on any device and with any prior.

Solves ``min_x 1/2 ||b - A x||^2 + tau ||Psi x||_1 + sum_i p_i(x)`` (Kuo 2020, Eq. 4.2, with non-negativity
and whatever else has a prox for ``p_i``), as the dissertation's ADMM (Eq. 4.5, A.3) does, with three changes
that leave the minimiser as it is:

* The data term is not split. ``v = M x`` of Eq. 4.5 is a volume of which only one plane meets the data; the
  others act as a brake. Here the update of x solves the cropped data term exactly, on the sensor plane
  (:class:`~recon.solvers.splitting.SensorSystem`), so that mu_1 is gone.
* Depth is not transformed. Per lateral spatial frequency ``T = Psi^T Psi + kappa`` is tridiagonal in z and is
  solved as such: no wrap-around between first and last plane, two-dimensional transforms only, and weights
  that may differ from plane to plane (voxels grow with depth).
* Split variable and multiplier are kept as one state. With ``s = Psi x + eta / mu``, ``u = shrink(s)`` and
  ``eta / mu = s - u``, an over-relaxed iteration is ``s <- s + alpha (Psi x - u)``.

An iteration makes the right-hand side r from x, its transform R and the sum over planes of ``conj(g) R``,
solves once on the sensor plane, and updates ``X <- T^-1 R + g E``, where ``g = T^-1 M^H``. Only the common
penalty mu is adapted, by balancing the relative residuals (Wohlberg 2017): it scales ``g`` and ``q`` and
costs nothing. kappa, the ratio of the other splits' penalties to TV's, is fixed for volumes of one PSF a
depth.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.base.namespace import require_memory, to_host
from recon.camera.convolution import Convolution
from recon.priors.base import Prior, Separable
from recon.priors.total_variation import TotalVariation
from recon.solvers.base import IterationRecord
from recon.solvers.cosine_preconditioner import laplacian_eigenvalues
from recon.solvers.moving import move, move_spectra
from recon.solvers.prior_splits import ProxSplit, split_prior
from recon.solvers.splitting import Room, SensorData, Tuning, VolumeSplitting, is_due, residual_norm, squares

FIRST_PENALTY = 0.5
"""First penalty relative to the mean of ``sum_z |H_z|^2``."""
_VOLUMES = 16
"""X, H, g, the tridiagonal factors, four states, and what an update of them passes through."""


def is_lateral_periodic(tv: TotalVariation) -> bool:
    """Whether differences wrap around as the sweeps of volumes have them: in the plane only."""
    axes = np.shape(tv.axis_weights)[-1]
    wrap = (True,) * axes if tv.wrap is None else tv.wrap
    return axes in (2, 3) and wrap == (False, True, True)[3 - axes :]


class ExactAdmm(VolumeSplitting):
    """The driver of iterations: a data term solved exactly on the sensor, priors split off.

    A subclass says what the object is kept as, how ``T`` is inverted and what the sensor sees
    (:meth:`_iterate`, :meth:`_predict`, :meth:`_update`), and how differences are taken.

    Attributes
    ----------
    S : ndarray, (3, ...)
        State of the differences; nothing without total variation.
    splits : tuple of ProxSplit
        Of the bounds and l1, and of any other prior.
    """

    S: Array
    splits: tuple[ProxSplit, ...]
    separable: Separable
    kappa: np.floating[Any]

    def _begin(self, tv: TotalVariation | None, seen: Array | None, power: Array) -> None:
        """Set out from an object of which the sensor sees so much; ``power``: the data term's curvature."""
        self.weight, self.isotropic = (tv.weight, tv.isotropic) if tv else (0.0, False)
        self.e = self.data.copy() if seen is None else self.data - seen
        first = self.tuning.first
        self.penalty = FIRST_PENALTY * float(power.mean()) if first is None else float(first)
        self._used_penalty = self.penalty
        self._misfit = 0.5 * squares(self.e)

    def move(self, rows: float, columns: float) -> None:
        """Move object and dual variables."""
        super().move(rows, columns)
        move(self._differences_state, rows, columns)
        for one in self.splits:
            one.move(rows, columns)

    @property
    def _differences_state(self) -> Array:
        """The state of the differences as images, (..., height, width)."""
        return self.S

    # What depends on the camera ----------------------------------------------------------------------
    def _iterate(self) -> Array:
        """Return the object, (1, n_z, height, width)."""
        raise NotImplementedError

    def _differences(self, x: Array) -> Array:
        """Return ``Psi x``."""
        raise NotImplementedError

    def _back(self, d: Array) -> Array:
        """Return ``Psi^T d``."""
        raise NotImplementedError

    def _predict(self, r: Array) -> Array:
        """Take the right-hand side; return what the sensor would see of ``T^-1 r``, masked."""
        raise NotImplementedError

    def _update(self) -> None:
        """``x <- T^-1 (r + A^H e / mu)``."""
        raise NotImplementedError

    # -------------------------------------------------------------------------------------------------
    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` is that of the iterate before, negative parts aside."""
        seen, sums = self._sweep()
        self._used_penalty = self.penalty
        self.system.set_scale(1 / self.penalty)
        self.system.solve(self.data - seen, self.e)
        self._update()
        record = self._record(sums)
        self.system.follow(max(record.primal_residual, record.dual_residual))
        return record

    def _sweep(self) -> tuple[Array, Array]:
        """Update the states from x and take the next right-hand side.

        Returns
        -------
        ndarray, (height, width)
            What the sensor would see of ``T^-1 r``.
        ndarray, (9,)
            TV; squared primal residual, dual residual, size of ``Psi x`` and of the multipliers; those four
            of the splits of x itself.
        """
        x = self._iterate()
        relax = self.relaxation if self.iteration else 1.0
        sums = np.zeros(9)
        r = self._advance(x, relax, sums) if self.S.size else self.xp.zeros_like(x)
        size = squares(x)
        for one in self.splits:
            one.set_penalty(self.penalty * float(self.kappa))
            one.meet(x, relax)
            r += self.kappa * (2 * one.split - one.state)
            primal, change, _, multiplier = one.sums
            sums[5:] += primal, change, size, multiplier
        return self._predict(r), sums

    def _advance(self, x: Array, relax: float, sums: Array) -> Array:
        """Advance the differences' state to the present penalty; return its part of the right-hand side."""
        f, mu, used = x.dtype.type, self.penalty, self._used_penalty
        d = self._differences(x)
        taken = self._multiplier(self.S, self.weight / used)
        before = self.S - taken
        taken *= f(used / mu)
        taken += before
        taken += f(relax) * (d - before)
        self.S = taken
        multiplier = self._multiplier(self.S, self.weight / mu)
        split = self.S - multiplier
        sizes = self.xp.sqrt((d * d).sum(axis=0)) if self.isotropic else abs(d)
        sums[0] = float(sizes.sum(dtype=np.float64))
        sums[1:5] = [squares(v) for v in (d - split, split - before, d, multiplier)]
        split -= multiplier
        return self._back(split)

    def _multiplier(self, s: Array, threshold: float) -> Array:
        """Return the part of the differences' states that shrinking takes away."""
        xp, t = self.xp, s.dtype.type(threshold)
        if self.isotropic:
            least = max(t, xp.finfo(s.dtype).tiny)
            taken: Array = s * (t / xp.maximum(xp.sqrt((s * s).sum(axis=0)), least))
        else:
            taken = xp.clip(s, -t, t)
        return taken

    def _record(self, sums: Array) -> IterationRecord:
        tv, primal, dual, kx, y, primal_p, dual_p, xx, y_p = sums
        kappa = float(self.kappa)
        # Relative to both sides of the constraint, in the metric of the augmented Lagrangian.
        primal_residual = float(np.sqrt((primal + kappa * primal_p) / max(kx + kappa * xx, 1e-300)))
        dual_residual = float(np.sqrt((dual + kappa * dual_p) / max(y + kappa * y_p, 1e-300)))
        objective = self._misfit + self.weight * float(tv) + self._value()
        self._misfit = 0.5 * float(self.xp.vdot(self.e, self.e))
        if self.balance and is_due(self.iteration) and dual_residual > 0:
            self._rebalance(primal_residual / dual_residual, sums)
        change = float(np.sqrt(dual_p / max(xx, 1e-300)))
        data = residual_norm(self.e)
        return IterationRecord(0, 0.0, objective, data, primal_residual, dual_residual, change)

    def _rebalance(self, residuals: float, sums: Array) -> None:
        """Adapt the penalty to the ratio of primal to dual residual; ``sums`` as of :meth:`_sweep`."""
        self.penalty *= float(np.clip(np.sqrt(residuals), 0.2, 5.0))

    def _value(self) -> float:
        """Value of the priors other than total variation, of their split variables."""
        return sum(one.prior.checked_value(one.split) for one in self.splits)

    @property
    def _solved(self) -> Array:
        """The split variable that obeys the bounds; without any, the first other prior's."""
        return self.splits[1 if self.separable.is_zero and len(self.splits) > 1 else 0].split

    @property
    def solution(self) -> Array:
        """The same, in host memory."""
        return np.array(to_host(self._solved))

    def _end(self) -> Array:
        return self.solution


class VolumeAdmm(ExactAdmm):
    """ADMM for one channel of a volume, or of a picture as a volume of one plane.

    Parameters
    ----------
    operator : Convolution
        One channel.
    data : ndarray, (1, height, width), or SensorData
    prior : Prior
        Total variation (periodic in the plane, not in depth; ``axis_weights`` (3,) or (n_z, 3)), separable
        priors, and any other with an exact prox; they see arrays (1, n_z, height, width).
    initial : ndarray, (1, n_z, grid_height, grid_width), optional
        Starting point; default zeros.
    tuning, room
        As :class:`~recon.solvers.splitting.VolumeSplitting`. The first penalty is by default
        ``FIRST_PENALTY`` of the mean over frequencies of ``sum_z |H_z|^2``, the curvature of the data
        term: independent of exposure, size and tau.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "X", "S", "e", "penalty", "_used_penalty", "_misfit", "system.tolerance",
    )  # fmt: skip

    def __init__(
        self,
        operator: Convolution,
        data: Array | SensorData,
        prior: Prior,
        *,
        initial: Array | None = None,
        tuning: Tuning | None = None,
        room: Room | None = None,
    ) -> None:
        super().__init__(operator, data, tuning, room, 1.8)
        dtype, (_, nz, _, _) = operator.dtype, operator.domain_shape
        tv, self.separable, self._others = split_prior(prior, is_lateral_periodic)
        weights = np.asarray((0.0, 0.0, 0.0) if tv is None else tv.axis_weights, dtype)
        if weights.shape[-1] == 2:
            weights = np.concatenate([np.zeros_like(weights[..., :1]), weights], axis=-1)
        # Never the read-only view: for that, numba would compile every kernel a second time.
        self.axis_weights = np.broadcast_to(weights, (nz, 3)).copy()
        self.kappa = dtype.type(self.tuning.kappa)
        start = (
            None if initial is None else np.ascontiguousarray(initial, dtype).reshape(operator.domain_shape)
        )
        self._allocate(start)
        seen = None if start is None else self._forward(self.xp.asarray(start[0]))
        self._begin(tv, seen, operator.power())

    _cast: Array | None = None
    """Spectrum of ``e / mu`` as X has it, where it was moved since."""

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint of a solver of the same problem."""
        super().restore(state)
        self._cast = None

    def set_data(self, data: SensorData) -> None:
        """Go on with other data, the data term solved for them at once."""
        super().set_data(data)
        if self._total is None:
            return
        before = self._weighted_spectrum().copy() if self._cast is None else self._cast
        self.system.solve(self.data - self.system.from_spectrum(self._total.copy()), self.e)
        change, self._cast = self._weighted_spectrum() - before, None
        for X, g in zip(self.X, self.g, strict=True):
            X += g * change

    def move(self, rows: float, columns: float) -> None:
        """Move object and dual variables."""
        super().move(rows, columns)
        width = self.operator.grid_shape[1]
        self._cast = self._weighted_spectrum().copy()
        for spectra in (self.X, self._cast):
            move_spectra(spectra, rows, columns, width)

    # Steps that compiled code replaces ---------------------------------------------------------------
    def _allocate(self, start: Array | None) -> None:
        """Make the state and what it is updated with: X, S, g, q."""
        xp, operator = self.xp, self.operator
        domain = operator.domain_shape
        require_memory(
            xp, (_VOLUMES + 3 * len(self._others)) * operator.dtype.itemsize * int(np.prod(domain))
        )
        zeros = xp.zeros(domain, operator.dtype) if start is None else xp.asarray(start)
        self.splits = tuple(ProxSplit(term, zeros) for term in (self.separable, *self._others))
        self._weights = xp.asarray(np.ascontiguousarray(self.axis_weights.T)[:, :, None, None])
        self._factorise()
        H = self._transfer
        self.g = self._solve_depths(xp.conj(H))
        self.system.set_curvature((H * self.g).real.sum(axis=0))
        self.S = xp.zeros((3, *domain[1:]), operator.dtype)
        self.X = fft.rfft(zeros[0])

    def _factorise(self) -> None:
        """Eliminate along depth once for all: ``T`` is tridiagonal in z for every lateral frequency."""
        xp, dtype = self.xp, self.operator.dtype
        ny, nx = self.operator.grid_shape
        rows, columns = (xp.asarray(laplacian_eigenvalues(n).astype(dtype)) for n in (ny, nx))
        rows, columns = rows[:, None], columns[None, : nx // 2 + 1]
        squared = self.axis_weights**2
        self._deeper = [float(w) for w in squared[:-1, 0]]
        shape = (len(squared), ny, nx // 2 + 1)
        self._inverse, self._ratio = xp.empty(shape, dtype), xp.empty(shape, dtype)
        pixels = self.kappa * dtype.type(len(self.splits))
        for z, (_, wy, wx) in enumerate(squared):
            after = self._deeper[z] if z < len(self._deeper) else 0.0
            before = self._deeper[z - 1] if z else 0.0
            diagonal = pixels + dtype.type(after + before) + wy * rows + wx * columns
            if z:
                diagonal = diagonal - dtype.type(before) * self._ratio[z - 1]
            self._inverse[z] = 1 / diagonal
            self._ratio[z] = dtype.type(after) * self._inverse[z]

    def _solve_depths(self, R: Array) -> Array:
        """``T^-1 R`` by Thomas' algorithm along z, without wrap-around. A new array."""
        R = R.copy()
        R[0] *= self._inverse[0]
        for z in range(1, len(R)):
            R[z] += self.operator.dtype.type(self._deeper[z - 1]) * R[z - 1]
            R[z] *= self._inverse[z]
        for z in range(len(R) - 2, -1, -1):
            R[z] += self._ratio[z] * R[z + 1]
        return R

    def _iterate(self) -> Array:
        return fft.irfft(self.X, self.operator.grid_shape[1])[None]

    def _differences(self, x: Array) -> Array:
        xp, x = self.xp, x[0]
        d: Array = xp.empty((3, *x.shape), x.dtype)
        d[0, :-1] = x[1:] - x[:-1]
        d[0, -1] = 0
        d[1] = xp.roll(x, -1, 1) - x
        d[2] = xp.roll(x, -1, 2) - x
        d *= self._weights
        return d

    def _back(self, d: Array) -> Array:
        v = self._weights * d
        r: Array = self.xp.roll(v[1], 1, 1) - v[1] + self.xp.roll(v[2], 1, 2) - v[2] - v[0]
        r[1:] += v[0, :-1]
        return r[None]

    def _predict(self, r: Array) -> Array:
        self.X = fft.rfft(r[0])
        return self.system.from_spectrum(self._keep_total((self.xp.conj(self.g) * self.X).sum(axis=0)))

    def _update(self) -> None:
        self.X = self._solve_depths(self.X) + self.g * self._weighted_spectrum()

    # -------------------------------------------------------------------------------------------------
    def _weighted_spectrum(self) -> Array:
        """Spectrum of ``e / mu``."""
        E = self.system.spectrum_of(self.e)
        E /= self.operator.dtype.type(self._used_penalty)
        return E

    def _end(self) -> Array:
        solution = self.solution
        if not self.room.keep_state:
            del self.X, self.g
        return solution
