"""Douglas-Rachford splitting for l1 on any device; the iteration of :mod:`recon.solvers.douglas_rachford`."""

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

_THRESHOLD = 0.1
"""Threshold to begin with, relative to the expected height of a voxel."""
_VOLUMES = 6
"""z, H, the back-projection, the prior's iterate and what they pass through."""


class PlainDouglasRachford(PlainSolver):
    """``min_{x >= 0} 1/2 ||b - A x||^2 + weight ||x||_1``.

    Parameters
    ----------
    camera : DepthCamera
    data : ndarray, (height, width)
    weight : float
    initial : ndarray, (n_z, grid_height, grid_width), optional
    relaxation : float
        Between 1 and 2.
    """

    state_names: ClassVar[tuple[str, ...]] = ("z", "e", "gamma", "_used")

    def __init__(
        self,
        camera: DepthCamera,
        data: npt.NDArray[Any],
        weight: float,
        *,
        initial: npt.NDArray[Any] | None = None,
        relaxation: float = 1.7,
    ) -> None:
        super().__init__()
        self.camera, self.weight, self.relaxation = camera, float(weight), relaxation
        xp = camera.xp
        require_memory(xp, _VOLUMES * camera.dtype.itemsize * int(np.prod(camera.domain_shape)))
        self.data = camera.masked(xp.asarray(data, camera.dtype))
        self.system = PlainSensorSystem(camera)
        self.z = xp.zeros(camera.domain_shape, camera.dtype)
        self._power = camera.power()
        height = self._expected_height()
        self.gamma = self._used = (
            _THRESHOLD * height / self.weight
            if height > 0 and self.weight > 0
            else 1 / float(self._power.mean())
        )
        self.e = xp.zeros_like(self.data)
        forward = xp.zeros_like(self.data)
        if initial is not None:
            self.z[...] = xp.asarray(initial, camera.dtype)
            forward = camera.forward(self.z)
        self._solve(forward)

    def _expected_height(self) -> float:
        """Brightest voxel of the regularised back-projection."""
        xp, camera = self.camera.xp, self.camera
        E = camera.embed(self.data) / (self._power + 0.01 * float(self._power.mean()))
        step = max(len(camera.H) // 8, 1)
        back = xp.fft.irfft2(xp.conj(camera.H[::step]) * E, s=camera.grid_shape)
        return max(float(back.max()), 0.0)

    def _solve(self, forward: Array) -> None:
        q = self._power * self.camera.dtype.type(self._used)
        self.e = self.system.solve(q, self.data - forward, self.e)

    def _back_projection(self) -> Array:
        xp, camera = self.camera.xp, self.camera
        E = camera.embed(self.e) * camera.dtype.type(self._used)
        return xp.fft.irfft2(xp.conj(camera.H) * E, s=camera.grid_shape)

    def step(self) -> IterationRecord:
        """Do one iteration. ``objective`` and ``data_residual`` are those of x, and of u in the prior."""
        xp, f = self.camera.xp, self.camera.dtype.type
        d = self._back_projection()
        scale = f(self.gamma / self._used)
        state = self.z + (1 - scale) * d
        d *= scale
        u = xp.maximum(state + 2 * d - f(self.gamma * self.weight), 0)
        r = u - state - d
        self.z = state + f(self.relaxation) * r
        l1, size, dual = float(u.sum(dtype=np.float64)), _squares(u), _squares(d)
        gap = float(np.sqrt(_squares(r) / size)) if size > 0 else 0.0
        residual = float(xp.linalg.norm(self.e))
        residual = residual if np.isfinite(residual) else np.inf
        self._used = self.gamma
        if is_due(self.iteration) and size > 0 and dual > 0:
            self.gamma *= float(np.clip(np.sqrt(size / dual), 0.2, 5.0))
        self.system.follow(gap)
        self._solve(self.camera.forward(self.z))
        return IterationRecord(
            0,
            0.0,
            0.5 * residual**2 + self.weight * l1,
            residual,
            primal_residual=gap,
            change=self.relaxation * gap,
        )

    @property
    def solution(self) -> npt.NDArray[Any]:
        """The prior's iterate (sparse, non-negative) in the host's memory, (1, n_z, height, width)."""
        xp, f = self.camera.xp, self.camera.dtype.type
        u = xp.maximum(self.z + 2 * self._back_projection() - f(self._used * self.weight), 0)
        return to_host(u)[None]


def _squares(a: Array) -> float:
    return float((a * a).sum(dtype=np.float64))
