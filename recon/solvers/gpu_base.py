"""What the solvers on any device have in common: state that leaves the device as NumPy arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.namespace import to_host
from recon.solvers.base import Solver
from recon.solvers.gpu_camera import DepthCamera
from recon.solvers.gpu_sensor_system import PlainSensorSystem


class PlainSolver(Solver):
    """A solver whose arrays live on its camera's device."""

    camera: DepthCamera
    system: PlainSensorSystem

    def checkpoint(self, *, copy: bool = True) -> dict[str, Any]:
        """Return the state in the host's memory; there always as a copy."""
        state = {name: getattr(self, name) for name in ("iteration", *self.state_names)}
        state["tolerance"] = self.system.tolerance
        return {k: to_host(v).copy() if hasattr(v, "shape") else v for k, v in state.items()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint of a solver of the same problem, whichever device it was taken on."""
        for name in ("iteration", *self.state_names):
            value = state[name]
            setattr(self, name, self.camera.xp.array(value) if isinstance(value, np.ndarray) else value)
        self.system.tolerance = state["tolerance"]

    def _start(self) -> npt.NDArray[Any] | None:
        return None  # zeros will do: a copy of a volume is too much to pay for a fall-back
