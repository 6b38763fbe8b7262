"""What the solvers on any device have in common: state that leaves the device as NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.namespace import to_host
from recon.solvers.base import Solver
from recon.solvers.gpu_camera import DepthCamera
from recon.solvers.gpu_sensor_system import PlainSensorSystem
from recon.solvers.stopping import IterationRecord


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


class ChannelByChannel(Solver):
    """Independent solvers of one channel each, stepped together."""

    def __init__(self, solvers: Sequence[PlainSolver]) -> None:
        super().__init__()
        self.solvers = solvers

    def step(self) -> IterationRecord:
        """Step every channel; objectives add up, of relative residuals the largest counts."""
        records = []
        for solver in self.solvers:
            records.append(solver.step())
            solver.iteration += 1
        return IterationRecord(
            0,
            0.0,
            sum(r.objective for r in records),
            float(np.sqrt(sum(r.data_residual**2 for r in records))),
            primal_residual=max(r.primal_residual for r in records),
            dual_residual=max(r.dual_residual for r in records),
            change=max(r.change for r in records),
        )

    @property
    def solution(self) -> npt.NDArray[Any]:
        """One object a channel, (n_channels, grid_height, grid_width)."""
        return np.concatenate([solver.solution[0] for solver in self.solvers])

    def _start(self) -> npt.NDArray[Any] | None:
        return None

    def checkpoint(self, *, copy: bool = True) -> dict[str, Any]:
        """Return every channel's state."""
        return {"iteration": self.iteration, "channels": [s.checkpoint(copy=copy) for s in self.solvers]}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.iteration = state["iteration"]
        for solver, part in zip(self.solvers, state["channels"], strict=True):
            solver.restore(part)
