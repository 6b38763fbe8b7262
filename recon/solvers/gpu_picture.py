"""A picture on any device: the solver for one depth, channel by channel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.base.namespace import Namespace
from recon.camera.base import Array, LinearOperator
from recon.camera.convolution3d import Convolution3D
from recon.errors import StructureError
from recon.priors.base import Prior
from recon.solvers.base import Solver
from recon.solvers.prior_splits import split_prior
from recon.solvers.splitting import Room, SensorData, Tuning
from recon.solvers.stopping import IterationRecord
from recon.solvers.structure import as_cropped_convolution
from recon.solvers.tv_admm_volume import volume_solver


def picture_solver(
    xp: Namespace, operator: LinearOperator, data: Array, prior: Prior, initial: Array | None = None
) -> ChannelByChannel:
    """Return a solver for a (masked) :class:`~recon.camera.convolution.PadCropConvolution`.

    Parameters
    ----------
    xp : module
        ``numpy`` or ``cupy``.
    operator, data, prior, initial
        As of :class:`~recon.solvers.SensorAdmm`; the prior total variation or l1, with non-negativity.

    Raises
    ------
    StructureError
        When operator or prior are something else.
    """
    structure = as_cropped_convolution(operator)
    camera = structure.convolution
    tv, separable, others = split_prior(prior)
    if others:
        names = ", ".join(type(other).__name__ for other in others)
        raise StructureError(
            f"On a GPU the prior is total variation or l1, with non-negativity; got {names}."
        )
    bounds = (separable.lower, separable.upper)
    if bounds != (0.0, np.inf) or (tv and separable.weight > 0):
        raise StructureError(
            "On a GPU the prior is total variation or l1, with non-negativity; "
            f"got bounds {bounds[0]:g} to {bounds[1]:g}"
            + (" and both penalties." if tv and separable.weight > 0 else ".")
        )
    psf_shape = tuple(n + 1 for n in camera.corner)
    psfs = fft.irfft(camera.spectrum.copy(), camera.grid_shape[1])[:, : psf_shape[0], : psf_shape[1]]
    solvers: list[Solver] = []
    for channel, image in enumerate(data):
        plane = Convolution3D(
            psfs[None, channel % len(psfs)][:, None], camera.sensor_shape, dtype=camera.dtype
        )
        start = None if initial is None else initial[channel][None, None]
        valid = structure.weight[channel] > 0
        # A picture's sums are short: nothing is gained by leaving planes out.
        solvers.append(
            volume_solver(
                plane,
                SensorData(image[None], valid),
                prior,
                initial=start,
                tuning=Tuning(drop_empty=False),
                room=Room(xp),
            )
        )
    return ChannelByChannel(solvers)


class ChannelByChannel(Solver):
    """Independent solvers of one channel each, stepped together."""

    def __init__(self, solvers: Sequence[Solver]) -> None:
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
