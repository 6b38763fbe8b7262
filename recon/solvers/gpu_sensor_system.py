"""The exact data term on the sensor plane, on any device; see :mod:`recon.solvers.sensor_system`."""

from __future__ import annotations

import numpy as np

from recon.solvers.gpu_camera import Array, DepthCamera

MAX_STEPS = 30


class PlainSensorSystem:
    """Solves ``(I + C q C^T) e = r`` by warm-started conjugate gradients; ``C`` is the camera's crop."""

    def __init__(self, camera: DepthCamera) -> None:
        self.camera = camera
        self.tolerance = 1e-4

    def follow(self, progress: float) -> None:
        """Set the tolerance by how far the solver around has still to go (a relative residual)."""
        floor = 10 * float(np.finfo(self.camera.dtype).eps)
        self.tolerance = float(np.clip(0.02 * progress, floor, 1e-4))

    def solve(self, q: Array, right: Array, e: Array) -> Array:
        """Return ``e`` improved until the residual is down to the tolerance."""
        xp, camera = self.camera.xp, self.camera
        preconditioner = 1 / (1 + 0.5 * q)

        def filtered(y: Array, transfer: Array) -> Array:
            return camera.crop(camera.embed(y) * transfer)

        target = self.tolerance * float(xp.linalg.norm(right))
        if not np.isfinite(target):
            return xp.full_like(e, np.nan)
        residual = right - e - filtered(e, q)
        direction, rho = xp.zeros_like(e), 1.0
        for step in range(MAX_STEPS):
            if not float(xp.linalg.norm(residual)) > target:
                break
            z = filtered(residual, preconditioner)
            rho, before = float(xp.vdot(residual, z)), rho
            direction = z + direction * camera.dtype.type(rho / before) if step else z
            image = direction + filtered(direction, q)
            length = camera.dtype.type(rho / float(xp.vdot(direction, image)))
            e = e + length * direction
            residual = residual - length * image
        return e
