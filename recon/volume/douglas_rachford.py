"""Douglas-Rachford splitting for l1 in a volume: one volume of state, one of transfer functions.

Solves ``min_{x >= 0} 1/2 ||b - A x||^2 + tau ||x||_1`` (Kuo 2020, Eqs. 4.2 and 6.2 with the identity as
sparsifying transform) by alternating the exact proximal maps of its two halves:

    x = prox of the data term at z = z + gamma A^H e,    e = b - A x
    u = prox of the prior at 2 x - z                   = max(z + 2 gamma A^H e - gamma tau, 0)
    z <- z + alpha (u - x)

``e`` solves ``(I + gamma A A^H) e = b - A z`` on the sensor plane
(:class:`~recon.volume.sensor_system.SensorSystem`). x and u are never stored: a plane is back-projected,
updated, transformed and summed while it is in the core's cache. Over-relaxation alpha = 1.7.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt

from recon import fft
from recon.operators.background import BackgroundRemoval
from recon.operators.base import Array
from recon.operators.convolution3d import Convolution3D
from recon.solvers.base import Solver
from recon.solvers.stopping import IterationRecord
from recon.volume.balance import is_due
from recon.volume.memory import Storage
from recon.volume.scale import expected_height
from recon.volume.sensor_system import SensorSystem, residual_norm


class DouglasRachford(Solver):
    """l1 and non-negativity for one channel of a volume.

    Parameters
    ----------
    operator : Convolution3D
        One channel.
    data : ndarray, (1, height, width)
    weight : float
        tau, absolute; 0 leaves non-negativity alone.
    positive : bool
        Non-negativity as well.
    valid : ndarray of bool, (height, width), optional
        Pixels that were measured.
    background : BackgroundRemoval, optional
        A smooth background to be estimated as well, for the same valid pixels.
    initial : ndarray, (1, n_z, grid_height, grid_width), optional
        Starting point; default zeros.
    step : float, optional
        gamma. Default: such that the threshold ``gamma tau`` is ``_THRESHOLD`` of the height that a voxel may
        be expected to have.
    relaxation : float
        alpha, between 1 and 2.
    balance : bool
        Adapt gamma to ``||u|| / ||A^H e||``, the length of the way that x has to go over that of the
        multiplier.
    keep_state : bool
        False lets the result take the state's place when :meth:`run` ends.
    storage : Storage, optional
        Where the state lives; default memory. (The transfer functions are the operator's.)
    """

    state_names: ClassVar[tuple[str, ...]] = ("z", "e", "gamma", "_used_gamma")

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
        keep_state: bool = True,
        storage: Storage | None = None,
    ) -> None:
        super().__init__()
        if operator.domain_shape[0] != 1:
            raise ValueError(f"One channel at a time, not {operator.domain_shape[0]}.")
        from recon.volume import _l1_kernels

        self._kernels = _l1_kernels
        self.operator = operator
        self.weight = float(weight)
        self.positive = positive
        self.relaxation = relaxation
        self.balance = balance
        self.keep_state = keep_state
        dtype = operator.dtype
        self.system = SensorSystem(
            operator.grid_shape, operator.sensor_window, valid, background, dtype=dtype
        )
        self.data = self.system.masked(np.array(data, dtype).reshape(operator.sensor_shape))
        self._storage = storage or Storage()
        self.z = self._storage.zeros(operator.domain_shape[1:], dtype)
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
        self._solve_data_term(
            operator.forward(self.z)[0] if initial is not None else np.zeros_like(self.data)
        )

    def _solve_data_term(self, forward_z: Array) -> None:
        self.system.set_curvature(self._power * self._power.dtype.type(self._used_gamma))
        self.system.solve(self.data - self.system.masked(forward_z), self.e)

    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` and ``data_residual`` are those of x, and of u in the prior."""
        k = self._kernels
        dtype = self.operator.dtype
        E = self.system.spectrum_of(self.e)
        E *= dtype.type(self._used_gamma)
        step_scale = dtype.type(self.gamma / self._used_gamma)
        H = self.operator.channel_spectrum(0)
        threshold, relaxation = dtype.type(self.gamma * self.weight), dtype.type(self.relaxation)
        self._totals[...] = 0

        def job(group: int, z0: int, z1: int) -> None:
            plane, spectrum = k.plane_scratch(self.operator.grid_shape, dtype)
            k.l1_sweep(
                self.z, H, E, threshold, relaxation, step_scale, self.positive, self._totals[group],
                self._statistics, z0, z1, plane, spectrum,
            )  # fmt: skip

        self.operator.groups.run(job)
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

    def _start(self) -> Array | None:
        return None

    def _end(self) -> Array:
        return self.solution if self.keep_state else self._write_solution(self.z)

    @property
    def solution(self) -> Array:
        """The prior's iterate u (sparse, non-negative); computed on demand."""
        return self._write_solution(self.z.copy())

    def _write_solution(self, z: Array) -> Array:
        k = self._kernels
        E = self.system.spectrum_of(self.e)
        E *= z.dtype.type(self._used_gamma)
        H = self.operator.channel_spectrum(0)
        threshold = z.dtype.type(self._used_gamma * self.weight)

        def job(_: int, z0: int, z1: int) -> None:
            plane, spectrum = k.plane_scratch(self.operator.grid_shape, z.dtype)
            for i in range(z0, z1):
                k.conjugate_product(H[i], E, spectrum)
                k.from_spectrum(spectrum, plane)
                k.l1_solution_plane(z[i], plane, threshold, self.positive)

        self.operator.groups.run(job)
        return z[None]


_THRESHOLD = 0.1
