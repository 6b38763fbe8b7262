"""The compiled sweeps of the volumes' ADMM for total variation without negatives; which solver a prior gets.

An iteration is one sweep over planes (states, right-hand side r, transform R, sum with ``conj(g)``), one
solve on the sensor plane, and one sweep over spectral rows, ``X <- T^-1 R + g E``. Six volumes are kept: X
(which R overwrites), g and four states.
"""

from __future__ import annotations

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.base.threads import get_threads, in_blocks
from recon.camera.convolution import Convolution
from recon.priors.base import Prior
from recon.solvers.cosine_preconditioner import laplacian_eigenvalues
from recon.solvers.douglas_rachford import DouglasRachford, SparseDouglasRachford
from recon.solvers.prior_splits import split_prior
from recon.solvers.splitting import Room, SensorData, Tuning
from recon.solvers.volume_admm import VolumeAdmm, is_lateral_periodic

_POSITIVE = 3
"""Which of the four states is that of non-negativity."""
_TILE = 256
"""Spectral columns solved together, about: all planes of a tile fit a core's second-level cache."""


class LeanTotalVariation(VolumeAdmm):
    """ADMM for one channel of a volume with total variation and non-negativity, on the processor.

    Parameters and attributes are those of :class:`~recon.solvers.volume_admm.VolumeAdmm`, and so is every
    iteration but for rounding; the state ``S`` is (n_z, grid_height, 4, grid_width).
    """

    @staticmethod
    def knows(prior: Prior) -> bool:
        """Whether a prior is total variation (of any weight) with non-negativity, and nothing else."""
        _, separable, others = split_prior(prior, is_lateral_periodic)
        bounds = (separable.weight, separable.lower, separable.upper)
        return not others and bounds == (0.0, 0.0, np.inf)

    def _allocate(self, start: Array | None) -> None:
        from recon.solvers import _volume_kernels

        self._kernels = _volume_kernels
        self.splits = ()
        operator, zeros = self.operator, self.room.zeros
        dtype = operator.dtype
        _, nz, ny, nx = operator.domain_shape
        self.g = zeros((nz, *fft.spectrum_shape((ny, nx))), fft.complex_dtype(dtype))
        self._dy2, dx2 = (laplacian_eigenvalues(n).astype(dtype) for n in (ny, nx))
        self._dx2 = dx2[: nx // 2 + 1].copy()
        self._prepare_transfer()
        self.X = zeros(self.g.shape, self.g.dtype)
        self.S = zeros((nz, ny, 4, nx), dtype)
        self._totals = np.empty((operator.groups.count, *self.g.shape[1:]), self.g.dtype)
        self._statistics = np.zeros((nz, _volume_kernels.STATISTICS))
        if start is not None:
            fft.rfft(start[0], out=self.X)
            np.maximum(start[0], 0, out=self.S[:, :, _POSITIVE])

    @property
    def _differences_state(self) -> Array:
        return np.moveaxis(self.S, 2, 1)

    def _prepare_transfer(self) -> None:
        k = self._kernels
        nz, ny, nxh = self.g.shape
        q = np.empty((ny, nxh), self.operator.dtype)
        for z in range(nz):
            self.operator.transfer_plane(z, out=self.g[z])

        def job(y0: int, y1: int) -> None:
            ratio = self._ratios()
            row = np.empty((nz, nxh), self.g.dtype)
            k.solve_transfer_rows(
                self.g, self.axis_weights, self._dy2, self._dx2, self.kappa, q, y0, y1, ratio, row
            )

        in_blocks(job, ny)
        self.system.set_curvature(q)

    def _ratios(self) -> Array:
        """Return a worker's scratch for tiles of equal width: one of a last column costs as many pages."""
        nz, _, columns = self.g.shape
        tiles = max(round(columns / _TILE), 1)
        return np.zeros((nz + 1, -(-columns // tiles)), self.operator.dtype)

    @property
    def solution(self) -> Array:
        """The split variable that is not negative: what is empty is zero, not nearly so. A copy."""
        return np.asarray(np.maximum(self.S[:, :, _POSITIVE], 0))[None]

    def _sweep(self) -> tuple[Array, Array]:
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
            spectrum = np.empty_like(self._totals[0])
            rows = np.empty((k.SCRATCH_ROWS, nx), dtype)
            for i in range(i0, i1):
                end = starts[i + 1] if i + 1 < workers else groups.count
                z0, z1 = int(groups.edges[starts[i]]), int(groups.edges[end])
                following = first.get(z1, none)
                k.plane_sweep(
                    self.X, self.S, self.g, self._totals, groups.of_plane, self.axis_weights, p,
                    self.isotropic, self._statistics, z0, z1, first.get(z0, none), following,
                    before.get(z0, none), planes, spectrum, rows,
                )  # fmt: skip

        in_blocks(worker, workers)
        total = self._totals[0]
        for other in self._totals[1:]:
            total += other
        return self.system.from_spectrum(self._keep_total(total)), np.asarray(self._statistics.sum(axis=0))

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
            rows = np.empty((k.SCRATCH_ROWS, nx), above.dtype)
            k.z_reflection(
                self.S[z - 1], above, first[z], self.axis_weights[z - 1], p, self.isotropic, rows, before[z]
            )
        return first, before

    def _update(self) -> None:
        k, E = self._kernels, self._weighted_spectrum()
        dtype = self.operator.dtype
        X, g, E = self.X.view(dtype), self.g.view(dtype), E.view(dtype)

        def job(y0: int, y1: int) -> None:
            ratio = self._ratios()
            k.solve_rows(X, g, E, self.axis_weights, self._dy2, self._dx2, self.kappa, True, y0, y1, ratio)

        in_blocks(job, len(self._dy2))


def volume_solver(
    operator: Convolution,
    data: Array | SensorData,
    prior: Prior,
    *,
    initial: Array | None = None,
    tuning: Tuning | None = None,
    room: Room | None = None,
) -> VolumeAdmm | DouglasRachford:
    """Return the solver of one channel of a volume, or of a picture of one plane, for its prior and device.

    Parameters are those of :class:`~recon.solvers.volume_admm.VolumeAdmm`. Total variation, and sums without
    a common prox, are ADMM's; any other prior is Douglas-Rachford's. Both have compiled sweeps for what they
    are used for most.

    Raises StructureError when the prior's prox is not that of its value.
    """
    compiled = room is None or room.xp is np
    tv, separable, others = split_prior(prior, is_lateral_periodic)
    kind: type[VolumeAdmm | DouglasRachford]
    if tv is not None or len(others) > 1 or (others and not separable.is_zero):
        kind = LeanTotalVariation if compiled and LeanTotalVariation.knows(prior) else VolumeAdmm
    else:
        kind = SparseDouglasRachford if compiled and SparseDouglasRachford.knows(prior) else DouglasRachford
    return kind(operator, data, prior, initial=initial, tuning=tuning, room=room)
