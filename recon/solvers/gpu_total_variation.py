"""Lean ADMM for total variation on any device; the iteration of :mod:`recon.solvers.tv_admm_volume`.

With one depth it is the exact-data ADMM of a picture.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from recon.base.namespace import require_memory, to_host
from recon.solvers.balance import is_due
from recon.solvers.gpu_base import PlainSolver
from recon.solvers.gpu_camera import Array, DepthCamera
from recon.solvers.gpu_sensor_system import PlainSensorSystem
from recon.solvers.stopping import IterationRecord

_PENALTY = 0.5
"""First penalty relative to the mean of ``sum_z |H_z|^2``."""
_VOLUMES = 16
"""X, H, g, the tridiagonal factors, four states, and what an update of them passes through."""


class PlainTotalVariation(PlainSolver):
    """``min_{x >= 0} 1/2 ||b - A x||^2 + weight TV(x)``.

    Parameters
    ----------
    camera : DepthCamera
    data : ndarray, (height, width)
    weight : float
    axis_weights : array, (3,) or (n_z, 3)
        Weights of the z, y and x differences.
    isotropic : bool
    initial : ndarray, (n_z, grid_height, grid_width), optional
    kappa : float
        Penalty of non-negativity relative to that of TV.
    relaxation : float
        Between 1 and 2.
    """

    state_names: ClassVar[tuple[str, ...]] = ("X", "S", "e", "penalty", "_used", "_misfit")

    def __init__(
        self,
        camera: DepthCamera,
        data: npt.NDArray[Any],
        weight: float,
        *,
        axis_weights: npt.ArrayLike = (1.0, 1.0, 1.0),
        isotropic: bool = False,
        initial: npt.NDArray[Any] | None = None,
        kappa: float = 1.0,
        relaxation: float = 1.8,
    ) -> None:
        super().__init__()
        self.camera, self.weight, self.isotropic = camera, float(weight), isotropic
        self.relaxation, self.kappa = relaxation, camera.dtype.type(kappa)
        xp, dtype = camera.xp, camera.dtype
        require_memory(xp, _VOLUMES * dtype.itemsize * int(np.prod(camera.domain_shape)))
        n_z = camera.domain_shape[0]
        weights = np.broadcast_to(np.asarray(axis_weights, dtype), (n_z, 3))
        self._weights = xp.asarray(np.ascontiguousarray(weights.T)[:, :, None, None])
        self._factorise(weights)
        self.g = self._solve_depths(xp.conj(camera.H))
        self._q = (camera.H * self.g).real.sum(axis=0)
        self.system = PlainSensorSystem(camera)
        self.data = camera.masked(xp.asarray(data, dtype))
        self.S = xp.zeros((4, *camera.domain_shape), dtype)
        self.X = xp.zeros_like(camera.H)
        self.e = self.data.copy()
        if initial is not None:
            volume = xp.asarray(initial, dtype).reshape(camera.domain_shape)
            self.e = self.data - camera.forward(volume)
            self.X = xp.fft.rfft2(volume)
            self.S[3] = xp.maximum(volume, 0)
        self.penalty = self._used = _PENALTY * float(camera.power().mean())
        self._misfit = 0.5 * float(xp.vdot(self.e, self.e))

    def _factorise(self, weights: npt.NDArray[Any]) -> None:
        """Eliminate along depth once for all: ``T`` is tridiagonal in z for every lateral frequency."""
        xp, dtype = self.camera.xp, self.camera.dtype
        ny, nx = self.camera.grid_shape
        rows = xp.asarray((4 * np.sin(np.pi * np.arange(ny) / ny) ** 2).astype(dtype))[:, None]
        columns = xp.asarray((4 * np.sin(np.pi * np.arange(nx // 2 + 1) / nx) ** 2).astype(dtype))[None]
        squares = weights**2
        self._deeper = [float(w) for w in squares[:-1, 0]]
        self._inverse, self._ratio = (
            xp.empty(self.camera.H.shape, dtype),
            xp.empty(self.camera.H.shape, dtype),
        )
        for z, (_, wy, wx) in enumerate(squares):
            after = self._deeper[z] if z < len(self._deeper) else 0.0
            before = self._deeper[z - 1] if z else 0.0
            diagonal = self.kappa + dtype.type(after + before) + wy * rows + wx * columns
            if z:
                diagonal = diagonal - dtype.type(before) * self._ratio[z - 1]
            self._inverse[z] = 1 / diagonal
            self._ratio[z] = dtype.type(after) * self._inverse[z]

    def _solve_depths(self, R: Array) -> Array:
        """``T^-1 R`` by Thomas' algorithm along z, without wrap-around. A new array."""
        R = R.copy()
        R[0] *= self._inverse[0]
        for z in range(1, len(R)):
            R[z] += self.camera.dtype.type(self._deeper[z - 1]) * R[z - 1]
            R[z] *= self._inverse[z]
        for z in range(len(R) - 2, -1, -1):
            R[z] += self._ratio[z] * R[z + 1]
        return R

    def _differences(self, x: Array) -> Array:
        xp = self.camera.xp
        d = xp.empty((3, *x.shape), x.dtype)
        d[0, :-1] = x[1:] - x[:-1]
        d[0, -1] = 0
        d[1] = xp.roll(x, -1, 1) - x
        d[2] = xp.roll(x, -1, 2) - x
        d *= self._weights
        return d

    def _multiplier(self, s: Array, threshold: float) -> Array:
        """Return the part of the differences' states that shrinking takes away."""
        xp, t = self.camera.xp, self.camera.dtype.type(threshold)
        if self.isotropic:
            return s * (t / xp.maximum(xp.sqrt((s * s).sum(axis=0)), t))
        return xp.clip(s, -t, t)

    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` is that of the iterate before, negative parts aside."""
        xp, camera, f = self.camera.xp, self.camera, self.camera.dtype.type
        mu, used = self.penalty, self._used
        relax, dual_scale = f(self.relaxation if self.iteration else 1.0), f(used / mu)
        x = xp.fft.irfft2(self.X, s=camera.grid_shape)
        d = self._differences(x)
        tv = xp.sqrt((d * d).sum(axis=0)) if self.isotropic else abs(d)
        sums = {"tv": float(tv.sum(dtype=np.float64))}

        c = self._multiplier(self.S[:3], self.weight / used)
        u = self.S[:3] - c
        state = u + dual_scale * c + relax * (d - u)
        self.S[:3] = state
        c = self._multiplier(state, self.weight / mu)
        split = state - c
        sums |= {
            "primal": _squares(d - split),
            "dual": _squares(split - u),
            "kx": _squares(d),
            "y": _squares(c),
        }
        v = self._weights * (split - c)
        r = xp.roll(v[1], 1, 1) - v[1] + xp.roll(v[2], 1, 2) - v[2] - v[0]
        r[1:] += v[0, :-1]

        u = xp.maximum(self.S[3], 0)
        state = u + dual_scale * (self.S[3] - u) + relax * (x - u)
        self.S[3] = state
        split = xp.maximum(state, 0)
        r += self.kappa * abs(state)
        sums |= {
            "primal_p": _squares(x - split),
            "dual_p": _squares(split - u),
            "xx": _squares(x),
            "y_p": _squares(state - split),
        }

        R = xp.fft.rfft2(r)
        total = (xp.conj(self.g) * R).sum(axis=0)
        self.e = self.system.solve(self._q / f(mu), self.data - camera.crop(total), self.e)
        self.X = self._solve_depths(R) + self.g * (camera.embed(self.e) / f(mu))
        self._used = mu
        return self._record(sums)

    def _record(self, s: dict[str, float]) -> IterationRecord:
        kappa, least = float(self.kappa), 1e-300
        primal = np.sqrt((s["primal"] + kappa * s["primal_p"]) / max(s["kx"] + kappa * s["xx"], least))
        dual = np.sqrt((s["dual"] + kappa * s["dual_p"]) / max(s["y"] + kappa * s["y_p"], least))
        objective = self._misfit + self.weight * s["tv"]
        squared = float(self.camera.xp.vdot(self.e, self.e))
        self._misfit = 0.5 * squared
        if is_due(self.iteration) and dual > 0:
            self.penalty *= float(np.clip(np.sqrt(primal / dual), 0.2, 5.0))
        self.system.follow(float(max(primal, dual)))
        residual = float(np.sqrt(squared)) if np.isfinite(squared) else np.inf
        change = float(np.sqrt(s["dual_p"] / max(s["xx"], least)))
        return IterationRecord(0, 0.0, objective, residual, float(primal), float(dual), change=change)

    @property
    def solution(self) -> npt.NDArray[Any]:
        """The split variable that is not negative, in the host's memory, (1, n_z, height, width)."""
        return to_host(self.camera.xp.maximum(self.S[3], 0))[None]


def _squares(a: Array) -> float:
    return float((a * a).sum(dtype=np.float64))
