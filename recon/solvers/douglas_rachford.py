"""Douglas-Rachford splitting for l1 in a volume: one volume of state, one of transfer functions.

Solves ``min_{x >= 0} 1/2 ||b - A x||^2 + tau ||x||_1`` (Kuo 2020, Eqs. 4.2 and 6.2 with the identity as
sparsifying transform) by alternating the exact proximal maps of its two halves:

    x = prox of the data term at z = z + gamma A^H e,    e = b - A x
    u = prox of the prior at 2 x - z                   = max(z + 2 gamma A^H e - gamma tau, 0)
    z <- z + alpha (u - x)

``e`` solves ``(I + gamma A A^H) e = b - A z`` on the sensor plane
(:class:`~recon.solvers.sensor_system.SensorSystem`). x and u are never stored: a plane is back-projected,
updated, transformed and summed while it is in the core's cache. Over-relaxation alpha = 1.7.

Planes in which u has been zero for a while are left out: the problem is solved on the others. Before the
result is called converged (and now and then before), the optimality condition ``A_z^H e <= tau`` is looked
at on the planes left out; those that miss it come back, with ``z = -gamma A_z^H e``, the value of z that an
empty plane has at the minimiser.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.base.threads import in_blocks
from recon.camera.background import BackgroundRemoval
from recon.camera.base import Array
from recon.camera.convolution3d import Convolution3D
from recon.camera.planes import PlaneGroups
from recon.solvers.balance import is_due
from recon.solvers.empty_planes import EXCESS, REVIEW, EmptyPlanes, PlaneWatch
from recon.solvers.memory import Storage
from recon.solvers.scale import expected_height
from recon.solvers.sensor_system import residual_norm
from recon.solvers.splitting import VolumeSplitting
from recon.solvers.stopping import IterationRecord


class DouglasRachford(VolumeSplitting):
    """l1 and non-negativity for one channel of a volume.

    Parameters
    ----------
    operator, data, weight, valid, background, relaxation, keep_state, storage
        As :class:`~recon.solvers.splitting.VolumeSplitting`.
    positive : bool
        Non-negativity as well.
    initial : ndarray, (1, n_z, grid_height, grid_width), optional
        Starting point; default zeros.
    step : float, optional
        gamma. Default: such that the threshold ``gamma tau`` is ``_THRESHOLD`` of the height that a voxel may
        be expected to have.
    balance : bool
        Adapt gamma to ``||u|| / ||A^H e||``, the length of the way that x has to go over that of the
        multiplier.
    drop_empty : bool
        Leave out planes that stay empty.

    Attributes
    ----------
    empty : EmptyPlanes
        The planes left out at the end of a run, and whether they were rightly so.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "z", "e", "gamma", "_used_gamma", "_tolerance", "_active", "_empty_for", "_patience",
    )  # fmt: skip

    def __init__(
        self,
        operator: Convolution3D,
        data: Array,
        weight: float,
        *,
        positive: bool = True,
        valid: npt.NDArray[np.bool_] | None = None,
        background: BackgroundRemoval | None = None,
        initial: Array | None = None,
        step: float | None = None,
        relaxation: float = 1.7,
        balance: bool = True,
        drop_empty: bool = True,
        keep_state: bool = True,
        storage: Storage | None = None,
    ) -> None:
        super().__init__(
            operator,
            data,
            weight,
            valid=valid,
            background=background,
            relaxation=relaxation,
            balance=balance,
            keep_state=keep_state,
            storage=storage,
        )
        from recon.solvers import _l1_kernels

        self._kernels = _l1_kernels
        self.positive = positive
        # Without a threshold no plane is certain to be empty.
        self.drop_empty = drop_empty and self.weight > 0
        dtype = operator.dtype
        self.z = self._storage.zeros(operator.domain_shape[1:], dtype)
        self.watch = PlaneWatch(len(self.z))
        self.empty = EmptyPlanes()
        if initial is not None:
            self.z[...] = np.reshape(initial, self.z.shape)
        self._power = operator.power()
        if step is None:
            height = expected_height(operator, self.system, self.data)
            # Without a threshold to set, the step that weighs data and prior alike at a typical frequency.
            step = (
                _THRESHOLD * height / weight if height > 0 and weight > 0 else 1 / float(self._power.mean())
            )
        self.gamma = self._used_gamma = float(step)
        self.e = np.zeros_like(self.data)
        self._statistics = np.zeros((len(self.z), _l1_kernels.STATISTICS))
        spectrum = fft.spectrum_shape(operator.grid_shape)
        self._totals = np.zeros((operator.groups.count, *spectrum), fft.complex_dtype(dtype))
        self._regroup()
        self._solve_data_term(
            operator.forward(self.z)[0] if initial is not None else np.zeros_like(self.data)
        )

    # The watch's arrays are part of the state.
    @property
    def _active(self) -> Array:
        return self.watch.active

    @property
    def _empty_for(self) -> Array:
        return self.watch.empty_for

    @property
    def _patience(self) -> Array:
        return self.watch.patience

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint taken from a solver of the same problem."""
        super().restore(state)
        self._regroup()

    def _regroup(self) -> None:
        """Share the active planes among the workers."""
        self._planes = np.flatnonzero(self.watch.active)
        self._groups = PlaneGroups(len(self._planes))
        whole = self.watch.active.all()
        self._power = self.operator.power(planes=None if whole else (int(z) for z in self._planes))

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

    def _weighted_spectrum(self) -> Array:
        """Spectrum of ``gamma e``."""
        E = self.system.spectrum_of(self.e)
        E *= E.real.dtype.type(self._used_gamma)
        return E

    def _solve_data_term(self, forward_z: Array) -> None:
        self.system.set_curvature(self._power * self._power.dtype.type(self._used_gamma))
        self.system.solve(self.data - self.system.masked(forward_z), self.e)

    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` and ``data_residual`` are those of x, and of u in the prior."""
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
        residual = residual_norm(self.e)
        l1, gap, size, dual = self._statistics.sum(axis=0)
        total = self._totals[0]
        for other in self._totals[1:]:
            total += other
        gap = float(np.sqrt(gap / size)) if size > 0 else 0.0
        self._used_gamma = self.gamma
        if self.balance and is_due(self.iteration) and size > 0 and dual > 0:
            self.gamma *= float(np.clip(np.sqrt(size / dual), 0.2, 5.0))
        self.system.follow(gap)
        self._solve_data_term(self.system.from_spectrum(total))
        return IterationRecord(
            0,
            0.0,
            0.5 * residual**2 + self.weight * float(l1),
            residual,
            primal_residual=gap,
            change=self.relaxation * gap,
        )

    def _end(self) -> Array:
        self.empty = EmptyPlanes(
            tuple(int(z) for z in np.flatnonzero(~self.watch.active)),
            float(self._peaks().max()) / self.weight if self.weight > 0 else 0.0,
        )
        return self.solution if self.keep_state else self._write_solution(self.z)

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


_THRESHOLD = 0.1
