"""Lean ADMM for total variation in a volume (the default for depth stacks).

Solves ``min_{x >= 0} 1/2 ||b - A x||^2 + tau ||Psi x||_1`` (Kuo 2020, Eq. 4.2), as the dissertation's ADMM
(Eq. 4.5, A.3) does, with three changes that leave the minimiser as it is:

* The data term is not split. ``v = M x`` of Eq. 4.5 is a volume of which only one plane meets the data; the
  others act as a brake. Here the update of x solves the cropped data term exactly, on the sensor plane
  (:class:`~recon.solvers.sensor_system.SensorSystem`), so that mu_1 is gone.
* Depth is not transformed. Per lateral spatial frequency ``T = Psi^T Psi + kappa`` is tridiagonal in z and is
  solved as such: no wrap-around between first and last plane, two-dimensional transforms only, and weights
  that may differ from plane to plane (voxels grow with depth).
* Split variable and multiplier are kept as one state. With ``s = Psi x + eta / mu``, ``u = shrink(s)`` and
  ``eta / mu = s - u``, an over-relaxed iteration is ``s <- s + alpha (Psi x - u)``.

An iteration is one sweep over planes (states, right-hand side r, transform R, sum with ``conj(g)``),
one solve on the sensor plane, and one sweep over spectral rows, ``X <- T^-1 R + g E``, where
``g = T^-1 M^H``. Six volumes are kept: X (which R overwrites), g and four states.

Only the common penalty mu is adapted, by balancing the relative residuals (Wohlberg 2017): it scales ``g``
and ``q`` and costs nothing. kappa, the ratio of the penalties of non-negativity and TV, is fixed.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.base.threads import get_threads, in_blocks
from recon.camera.background import BackgroundRemoval
from recon.camera.base import Array
from recon.camera.convolution3d import Convolution3D
from recon.solvers.balance import is_due
from recon.solvers.memory import Storage
from recon.solvers.sensor_system import residual_norm
from recon.solvers.splitting import VolumeSplitting
from recon.solvers.stopping import IterationRecord

_POSITIVE = 3
"""Which of the four states is that of non-negativity."""
_TILE = 256
"""Spectral columns solved together: all planes of a tile fit a core's second-level cache."""


class LeanTotalVariation(VolumeSplitting):
    """ADMM for one channel of a volume with total variation and non-negativity.

    Parameters
    ----------
    operator, data, weight, valid, background, relaxation, keep_state, storage
        As :class:`~recon.solvers.splitting.VolumeSplitting`; ``weight`` is tau of Eq. 4.2.
    axis_weights : ndarray, (3,) or (n_z, 3)
        Weights of the z, y and x differences, at each plane where they differ; z is not x.
    isotropic : bool
        Length of the gradient instead of the sum of its components.
    initial : ndarray, (1, n_z, grid_height, grid_width), optional
        Starting point; default zeros.
    penalty : float, optional
        mu to start with. Default: ``_PENALTY`` of the mean over frequencies of ``sum_z |H_z|^2``, the
        curvature of the data term: independent of exposure, size and tau.
    kappa : float
        Penalty of non-negativity relative to that of TV.
    balance : bool
        Adapt mu to the residuals.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "X",
        "S",
        "e",
        "penalty",
        "_used_penalty",
        "_misfit",
        "_tolerance",
    )

    def __init__(
        self,
        operator: Convolution3D,
        data: Array,
        weight: float,
        *,
        axis_weights: npt.ArrayLike = (1.0, 1.0, 1.0),
        isotropic: bool = False,
        valid: npt.NDArray[np.bool_] | None = None,
        background: BackgroundRemoval | None = None,
        initial: Array | None = None,
        penalty: float | None = None,
        kappa: float = 1.0,
        relaxation: float = 1.8,
        balance: bool = True,
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
        from recon.solvers import _tv_kernels

        self._kernels = _tv_kernels
        self.isotropic = isotropic
        dtype = operator.dtype
        _, nz, ny, nx = operator.domain_shape
        self.axis_weights = np.ascontiguousarray(np.broadcast_to(np.asarray(axis_weights, dtype), (nz, 3)))
        self.kappa = dtype.type(kappa)
        zeros = self._storage.zeros
        self.g = zeros((nz, *fft.spectrum_shape((ny, nx))), fft.complex_dtype(dtype))
        self._dy2 = (4 * np.sin(np.pi * np.arange(ny) / ny) ** 2).astype(dtype)
        self._dx2 = (4 * np.sin(np.pi * np.arange(nx // 2 + 1) / nx) ** 2).astype(dtype)
        self._q = np.empty(self.g.shape[1:], dtype)
        self._prepare_transfer()
        self.X = zeros(self.g.shape, self.g.dtype)
        self.S = zeros((nz, ny, 4, nx), dtype)
        self.e = self.data.copy()
        self._totals = np.empty((operator.groups.count, *self.g.shape[1:]), self.g.dtype)
        self._statistics = np.zeros((nz, _tv_kernels.STATISTICS))
        if initial is not None:
            volume = np.ascontiguousarray(initial, dtype).reshape(operator.domain_shape)
            self.e -= self.system.masked(operator.forward(volume)[0])
            fft.rfft(volume[0], out=self.X)
            np.maximum(volume[0], 0, out=self.S[:, :, _POSITIVE])
        if penalty is None:
            penalty = _PENALTY * float(operator.power().mean())
        self.penalty = float(penalty)
        self._used_penalty = self.penalty
        self._misfit = 0.5 * float(np.vdot(self.e, self.e))

    def _prepare_transfer(self) -> None:
        k = self._kernels
        nz, ny, nxh = self.g.shape
        for z in range(nz):
            self.operator.transfer_plane(z, out=self.g[z])

        def job(y0: int, y1: int) -> None:
            ratio = np.zeros((nz, min(_TILE, nxh)), self._q.dtype)
            row = np.empty((nz, nxh), self.g.dtype)
            k.solve_transfer_rows(
                self.g, self.axis_weights, self._dy2, self._dx2, self.kappa, self._q, y0, y1, ratio, row
            )

        in_blocks(job, ny)

    @property
    def solution(self) -> Array:
        """The split variable that is not negative: what is empty is zero, not nearly so. A copy."""
        return np.asarray(np.maximum(self.S[:, :, _POSITIVE], 0))[None]

    def _end(self) -> Array:
        if not self.keep_state:
            del self.X, self.g
        return self.solution

    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` is that of the iterate before, negative parts aside."""
        self._sweep_planes()
        total = self._totals[0]
        for other in self._totals[1:]:
            total += other
        mu = self.penalty
        self.system.set_curvature(self._q / self._q.dtype.type(mu))
        self.system.solve(self.data - self.system.from_spectrum(total), self.e)
        E = self.system.spectrum_of(self.e)
        E /= self._q.dtype.type(mu)
        self._solve_rows(E)
        self._used_penalty = mu
        record = self._record()
        self.system.follow(max(record.primal_residual, record.dual_residual))
        return record

    def _record(self) -> IterationRecord:
        tv, primal, dual, kx, y, primal_p, dual_p, xx, y_p = self._statistics.sum(axis=0)
        kappa = float(self.kappa)
        # Relative to both sides of the constraint, in the metric of the augmented Lagrangian.
        primal_residual = float(np.sqrt((primal + kappa * primal_p) / max(kx + kappa * xx, 1e-300)))
        dual_residual = float(np.sqrt((dual + kappa * dual_p) / max(y + kappa * y_p, 1e-300)))
        objective = self._misfit + self.weight * float(tv)
        self._misfit = 0.5 * float(np.vdot(self.e, self.e))
        if self.balance and is_due(self.iteration) and dual_residual > 0:
            ratio = np.sqrt(primal_residual / dual_residual)
            self.penalty *= float(np.clip(ratio, 0.2, 5.0))
        return IterationRecord(
            0,
            0.0,
            objective,
            residual_norm(self.e),
            primal_residual,
            dual_residual,
            change=float(np.sqrt(dual_p / max(xx, 1e-300))),
        )

    def _sweep_planes(self) -> None:
        k = self._kernels
        dtype = self.operator.dtype
        ny, nx = self.operator.grid_shape
        mu, used = self.penalty, self._used_penalty
        relaxation = self.relaxation if self.iteration else 1.0
        p = np.array([relaxation, self.weight / mu, self.weight / used, used / mu, self.kappa], dtype)
        groups = self.operator.groups
        self._totals[...] = 0
        workers = min(get_threads(), groups.count)
        starts = [groups.count * i // workers for i in range(workers)]
        first, before = self._boundaries([int(groups.edges[i]) for i in starts], p)
        none = np.empty((0, 0), dtype)

        def worker(i0: int, i1: int) -> None:
            planes = np.empty((k.SCRATCH_PLANES, ny, nx), dtype)
            rows = np.empty((k.SCRATCH_ROWS, nx), dtype)
            for i in range(i0, i1):
                end = starts[i + 1] if i + 1 < workers else groups.count
                z0, z1 = int(groups.edges[starts[i]]), int(groups.edges[end])
                following = first.get(z1, none)
                k.plane_sweep(
                    self.X, self.S, self.g, self._totals, groups.of_plane, self.axis_weights, p,
                    self.isotropic, self._statistics, z0, z1, first.get(z0, none), following,
                    before.get(z0, none), planes, rows,
                )  # fmt: skip

        in_blocks(worker, workers)

    def _boundaries(self, starts: list[int], p: Array) -> tuple[dict[int, Array], dict[int, Array]]:
        """Return the estimate at each worker's first plane, and the z reflections of the plane before it."""
        k = self._kernels
        nx = self.operator.grid_shape[1]
        first, before = {}, {}
        for z in starts:
            if z == 0:
                continue
            first[z] = fft.irfft(self.X[z].copy(), nx)
            above = fft.irfft(self.X[z - 1].copy(), nx)
            before[z] = np.empty_like(above)
            rows = np.zeros((k.SCRATCH_ROWS + 1, nx), above.dtype)
            k.z_reflection(
                self.S[z - 1], above, first[z], self.axis_weights[z - 1], p, self.isotropic, rows,
                np.empty((4, nx), above.dtype), before[z],
            )  # fmt: skip
        return first, before

    def _solve_rows(self, E: Array) -> None:
        k = self._kernels
        dtype = self.operator.dtype
        X, g, E = self.X.view(dtype), self.g.view(dtype), E.view(dtype)

        def job(y0: int, y1: int) -> None:
            ratio = np.zeros((len(g), min(_TILE, len(self._dx2))), dtype)
            k.solve_rows(X, g, E, self.axis_weights, self._dy2, self._dx2, self.kappa, True, y0, y1, ratio)

        in_blocks(job, len(self._dy2))


_PENALTY = 0.5
