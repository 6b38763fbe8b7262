"""Douglas-Rachford splitting for a prior with a prox: one volume of state, one of transfer functions.

Solves ``min_x 1/2 ||b - A x||^2 + p(x)`` by alternating the exact proximal maps of its two halves (for the
sparse volumes of Kuo 2020, Eqs. 4.2 and 6.2, ``p`` is ``tau ||x||_1`` for ``x >= 0``):

    x = prox of the data term at z = z + gamma A^H e,    e = b - A x
    u = prox of p at 2 x - z                           (of l1: max(z + 2 gamma A^H e - gamma tau, 0))
    z <- z + alpha (u - x)

``e`` solves ``(I + gamma A A^H) e = b - A z`` on the sensor plane
(:class:`~recon.solvers.splitting.SensorSystem`). Over-relaxation alpha = 1.7.

:class:`SparseDouglasRachford` does so for l1 on the processor without ever storing x and u: a plane is
back-projected, updated, transformed and summed while it is in the core's cache. Planes in which u has been
zero for a while are left out: the problem is solved on the others. Before the result is called converged (and
now and then before), the optimality condition ``A_z^H e <= tau`` is looked at on the planes left out; those
that miss it come back, with ``z = -gamma A_z^H e``, the value of z that an empty plane has at the minimiser.
"""

from __future__ import annotations

from copy import copy as shallow_copy
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float64Array
from recon.base import fft
from recon.base.namespace import require_memory, to_host
from recon.base.threads import in_blocks
from recon.camera.convolution import Convolution, PlaneGroups
from recon.errors import StructureError
from recon.priors.base import Prior, Separable
from recon.solvers.base import IterationRecord
from recon.solvers.moving import move
from recon.solvers.prior_splits import require_exact
from recon.solvers.splitting import Room, SensorData, Tuning, VolumeSplitting, is_due, residual_norm, squares

PATIENCE = 10
"""Iterations that a plane is empty before it is left out; twice as many each time it had to come back."""
REVIEW = 10
"""Iterations between looks at which planes may be left out: each changes the problem that is being solved."""
EXCESS = 0.01
"""How far above tau the residual's correlation with a plane may be for it to count as rightly empty."""


@dataclass(frozen=True, slots=True)
class EmptyPlanes:
    """Planes that took no part at the end, and whether they could be spared.

    The optimality condition of l1 on a plane that is zero is ``A_z^H e <= tau`` at every voxel, with ``e``
    the data's residual (both ways where voxels may be negative).

    Attributes
    ----------
    planes : tuple of int
    worst : float
        Largest ``A_z^H e / tau`` on these planes; 0 where there are none.
    """

    planes: tuple[int, ...] = ()
    worst: float = 0.0

    @property
    def certified(self) -> bool:
        """Whether the condition holds, but for ``EXCESS``."""
        return self.worst <= 1 + EXCESS


class PlaneWatch:
    """Keeps count of how long planes have been empty.

    Attributes
    ----------
    active : ndarray of bool, (n_z,)
        Planes that take part.
    empty_for : ndarray of int, (n_z,)
        Iterations since a plane last held light.
    patience : ndarray of int, (n_z,)
        Iterations after which each plane is left out.
    """

    def __init__(self, n_z: int) -> None:
        self.active = np.ones(n_z, bool)
        self.empty_for = np.zeros(n_z, np.int64)
        self.patience = np.full(n_z, PATIENCE)

    def note(self, light: Float64Array) -> None:
        """Take down each plane's sum of magnitudes after an iteration."""
        self.empty_for = np.where(light > 0, 0, self.empty_for + 1)

    def due(self) -> BoolArray:
        """Return which active planes may be left out, at least one plane staying in."""
        due = self.active & (self.empty_for >= self.patience)
        if due.sum() == self.active.sum():
            due[np.flatnonzero(due)[0]] = False
        return due

    def bring_back(self, planes: npt.NDArray[np.intp]) -> None:
        """Let planes take part again."""
        self.active[planes] = True
        self.empty_for[planes] = 0
        self.patience[planes] *= 2


_THRESHOLD = 0.1
"""Threshold to begin with, relative to the expected height of a voxel."""
_PLANES = 8
"""Planes, spread over the depths, from which that height is told."""
_VOLUMES = 6
"""z, H, the back-projection, the prior's iterate and what they pass through."""


class DouglasRachford(VolumeSplitting):
    """A prior with an exact prox for one channel of a volume, on any device.

    Parameters
    ----------
    operator : Convolution
        One channel.
    data : ndarray, (1, height, width), or SensorData
    prior : Prior
        Sees arrays (1, n_z, height, width). Of a sum without a common prox, see
        :class:`~recon.solvers.volume_admm.VolumeAdmm`.
    initial : ndarray, (1, n_z, grid_height, grid_width), optional
        Starting point; default zeros.
    tuning, room
        As :class:`~recon.solvers.splitting.VolumeSplitting`. The first step gamma is by default such that
        l1's threshold ``gamma tau`` is ``_THRESHOLD`` of the height that a voxel may be expected to have; it
        is balanced by ``||u|| / ||A^H e||``, the length of the way that x has to go over that of the
        multiplier.

    Attributes
    ----------
    empty : EmptyPlanes
        The planes left out at the end of a run, and whether they were rightly so.
    """

    state_names: ClassVar[tuple[str, ...]] = ("z", "e", "gamma", "_used_gamma", "system.tolerance")

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
        super().__init__(operator, data, tuning, room, 1.7)
        require_exact(*prior.terms())
        self.prior: Prior = prior.for_a_run()
        self.weight = sum(term.weight for term in prior.terms() if isinstance(term, Separable))
        self.empty = EmptyPlanes()
        self.z = self.room.zeros(operator.domain_shape[1:], operator.dtype)
        if initial is not None:
            self.z[...] = self.xp.asarray(np.reshape(initial, self.z.shape))
        self._allocate()
        first = self.tuning.first
        if first is None:
            height = self._expected_height()
            # Without a threshold to set, the step that weighs data and prior alike at a typical frequency.
            set_by_height = height > 0 and self.weight > 0
            first = _THRESHOLD * height / self.weight if set_by_height else 1 / float(self._power.mean())
        self.gamma = self._used_gamma = float(first)
        self.e = self.xp.zeros_like(self.data)
        self._solve_data_term(self.xp.zeros_like(self.data) if initial is None else self._forward(self.z))

    # Steps that compiled code replaces ---------------------------------------------------------------
    def _allocate(self) -> None:
        """Make what an iteration works with."""
        require_memory(self.xp, _VOLUMES * self.operator.dtype.itemsize * int(self.z.size))
        self._set_power(self.xp.asarray(self.operator.power()[0]))

    def _set_power(self, power: Array) -> None:
        """Give ``sum_z |H_z|^2`` of the planes that take part."""
        self._power = power
        self.system.set_curvature(power)

    def _sweep(self) -> tuple[Array, Array]:
        """Update z; return the transform of what the sensor sees of it, and the sums of :meth:`step`."""
        f = self.operator.dtype.type
        d = self._back_projection()
        scale = f(self.gamma / self._used_gamma)
        state = self.z + (1 - scale) * d
        d *= scale
        u = self.prior.checked_prox((state + 2 * d)[None], self.gamma)[0].astype(state.dtype, copy=False)
        r = u - state - d
        self.z = state + f(self.relaxation) * r
        sums = np.array([self.prior.checked_value(u[None]), squares(r), squares(u), squares(d)])
        return (self._transfer * fft.rfft(self.z)).sum(axis=0), sums

    def _back_projection(self) -> Array:
        """``gamma A^H e``."""
        return fft.irfft(
            self.xp.conj(self._transfer) * self._weighted_spectrum(), self.operator.grid_shape[1]
        )

    @property
    def solution(self) -> Array:
        """The prior's iterate u, in the host's memory; computed on demand."""
        prior = shallow_copy(self.prior)  # leaves what its prox starts from as it is
        return to_host(prior.prox((self.z + 2 * self._back_projection())[None], self._used_gamma))

    # -------------------------------------------------------------------------------------------------
    def _expected_height(self) -> float:
        """Brightest voxel of the regularised back-projection ``M^H (M M^H + lambda)^-1 C^T b``.

        What the data say when no prior is asked: within a small factor of the brightest voxels of the
        solution, whatever exposure and size.
        """
        xp, operator = self.xp, self.operator
        spectrum = self.system.spectrum_of(self.data) / (self._power + 0.01 * float(self._power.mean()))
        height = 0.0
        for z in range(0, operator.domain_shape[1], max(operator.domain_shape[1] // _PLANES, 1)):
            X = xp.conj(xp.asarray(operator.transfer_plane(z))) * spectrum
            height = max(height, float(fft.irfft(X, operator.grid_shape[1]).max()))
        return height

    def _weighted_spectrum(self) -> Array:
        """Spectrum of ``gamma e``."""
        E = self.system.spectrum_of(self.e)
        E *= E.real.dtype.type(self._used_gamma)
        return E

    def _solve_data_term(self, forward_z: Array) -> None:
        """Solve for e from ``A z``, masked."""
        self.system.set_scale(self._used_gamma)
        self.system.solve(self.data - forward_z, self.e)

    def set_data(self, data: SensorData) -> None:
        """Go on with other data, the data term solved for them at once."""
        super().set_data(data)
        if self._total is not None:
            self._solve_data_term(self.system.from_spectrum(self._total.copy()))

    def move(self, rows: float, columns: float) -> None:
        """Move the object."""
        super().move(rows, columns)
        move(self.z, rows, columns)

    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` and ``data_residual`` are those of x, and of u in the prior."""
        residual = residual_norm(self.e)
        total, sums = self._sweep()
        value, gap, size, dual = sums
        gap = float(np.sqrt(gap / size)) if size > 0 else 0.0
        self._used_gamma = self.gamma
        if self.balance and is_due(self.iteration) and size > 0 and dual > 0:
            self.gamma *= float(np.clip(np.sqrt(size / dual), 0.2, 5.0))
        self.system.follow(gap)
        self._solve_data_term(self.system.from_spectrum(self._keep_total(total)))
        objective, change = 0.5 * residual**2 + float(value), self.relaxation * gap
        return IterationRecord(0, 0.0, objective, residual, primal_residual=gap, change=change)


class SparseDouglasRachford(DouglasRachford):
    """l1 with or without non-negativity, compiled, on the processor.

    As :class:`DouglasRachford`; planes that stay empty are left out, where ``tuning`` does not forbid it.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        *DouglasRachford.state_names, "watch.active", "watch.empty_for", "watch.patience",
    )  # fmt: skip

    @staticmethod
    def knows(prior: Prior) -> bool:
        """Whether a prior is l1 (of any weight) and perhaps non-negativity, and nothing else."""
        return isinstance(prior, Separable) and prior.upper == np.inf and prior.lower in (0.0, -np.inf)

    def _allocate(self) -> None:
        from recon.solvers import _volume_kernels

        if not (isinstance(self.prior, Separable) and self.knows(self.prior)):
            raise StructureError("These sweeps are for l1 and non-negativity alone.")
        self._kernels: Any = _volume_kernels
        self.positive = self.prior.lower == 0
        operator = self.operator
        # Without a threshold no plane is certain to be empty.
        self.drop_empty = self.tuning.drop_empty and self.weight > 0
        self.watch = PlaneWatch(len(self.z))
        self._statistics = np.zeros((len(self.z), _volume_kernels.L1_STATISTICS))
        spectrum = fft.spectrum_shape(operator.grid_shape)
        self._totals = np.zeros((operator.groups.count, *spectrum), fft.complex_dtype(operator.dtype))
        self._regroup()

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint taken from a solver of the same problem."""
        super().restore(state)
        self._regroup()

    def _regroup(self) -> None:
        """Share the active planes among the workers."""
        self._planes = np.flatnonzero(self.watch.active)
        self._groups = PlaneGroups(len(self._planes))
        whole = self.watch.active.all()
        self._set_power(self.operator.power(None if whole else (int(z) for z in self._planes))[0])

    def _leave_out(self) -> None:
        """Leave out what has been empty for long."""
        due = self.watch.due()
        if due.any():
            self.watch.active[due] = False
            self._regroup()

    def _bring_back(self) -> bool:
        """Let planes that miss the optimality condition take part again; return whether there were any."""
        peaks = self._peaks()
        missing = np.flatnonzero(peaks > (1 + EXCESS) * self.weight)
        if not missing.size:
            return False
        E = self._weighted_spectrum()
        H = self.operator.channel_spectrum(0)
        plane, spectrum = self._kernels.plane_scratch(self.operator.grid_shape, self.operator.dtype)
        for z in missing:
            self._kernels.conjugate_product(H[z], E, spectrum)
            self._kernels.from_spectrum(spectrum, plane)
            np.negative(plane, out=self.z[z])
        self.watch.bring_back(missing)
        self._regroup()
        self._total = None  # it has nothing of them
        return True

    def _peaks(self) -> Array:
        """``max A_z^H e`` of the planes that are left out; 0 of the others."""
        peaks = np.zeros(len(self.z))
        rest = np.flatnonzero(~self.watch.active)
        E = self.system.spectrum_of(self.e)
        H = self.operator.channel_spectrum(0)

        def job(start: int, stop: int) -> None:
            scratch = self._kernels.plane_scratch(self.operator.grid_shape, self.operator.dtype)
            self._kernels.correlation_peaks(H, E, self.positive, peaks, rest[start:stop], *scratch)

        if rest.size:
            in_blocks(job, len(rest))
        return peaks

    def confirm(self) -> bool:
        """Look at the optimality condition on the planes left out; go on where one misses it."""
        return not self._bring_back()

    def _sweep(self) -> tuple[Array, Array]:
        k = self._kernels
        dtype = self.operator.dtype
        if self.drop_empty and self.iteration:
            if self.iteration % REVIEW == 0:
                self._leave_out()
            if is_due(self.iteration):
                self._bring_back()
        E = self._weighted_spectrum()
        step_scale = dtype.type(self.gamma / self._used_gamma)
        H = self.operator.channel_spectrum(0)
        threshold, relaxation = dtype.type(self.gamma * self.weight), dtype.type(self.relaxation)
        self._totals[...] = 0

        def job(group: int, z0: int, z1: int) -> None:
            plane, spectrum = k.plane_scratch(self.operator.grid_shape, dtype)
            k.l1_sweep(
                self.z, H, E, threshold, relaxation, step_scale, self.positive, self._totals[group],
                self._statistics, self._planes[z0:z1], plane, spectrum,
            )  # fmt: skip

        self._statistics[...] = 0
        self._groups.run(job)
        self.watch.note(self._statistics[:, 0])
        total = self._totals[0]
        for other in self._totals[1:]:
            total += other
        return total, self._statistics.sum(axis=0) * (self.weight, 1, 1, 1)

    def _end(self) -> Array:
        self.empty = EmptyPlanes(
            tuple(int(z) for z in np.flatnonzero(~self.watch.active)),
            float(self._peaks().max()) / self.weight if self.weight > 0 else 0.0,
        )
        return self.solution if self.room.keep_state else self._write_solution(self.z)

    @property
    def solution(self) -> Array:
        """The prior's iterate u (sparse, non-negative); computed on demand."""
        return self._write_solution(self.z.copy())

    def _write_solution(self, z: Array) -> Array:
        k = self._kernels
        E = self._weighted_spectrum()
        H = self.operator.channel_spectrum(0)
        threshold = z.dtype.type(self._used_gamma * self.weight)

        def job(_: int, z0: int, z1: int) -> None:
            plane, spectrum = k.plane_scratch(self.operator.grid_shape, z.dtype)
            for i in self._planes[z0:z1]:
                k.conjugate_product(H[i], E, spectrum)
                k.from_spectrum(spectrum, plane)
                k.l1_solution_plane(z[i], plane, threshold, self.positive)

        self._groups.run(job)
        z[~self.watch.active] = 0
        return z[None]
