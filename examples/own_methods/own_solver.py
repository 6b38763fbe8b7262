"""A solver of one's own: Landweber's iteration with a prior, in other words proximal gradient descent."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from recon.camera.base import LinearOperator
from recon.priors import Prior
from recon.reconstruction.part import Part
from recon.reconstruction.solvers import OfferedSolver
from recon.solvers.base import IterationRecord, Solver

Array = npt.NDArray[Any]


class Landweber(Solver):
    """``x <- prox(x - A^H (A x - b) / ||A||^2)`` for any camera, of pictures and volumes."""

    state_names: ClassVar[tuple[str, ...]] = ("x",)

    def __init__(self, operator: LinearOperator, data: Array, prior: Prior, start: Array | None) -> None:
        super().__init__()
        self.operator, self.data, self.prior = operator, data, prior
        self.x = np.zeros(operator.domain_shape, operator.dtype) if start is None else start.copy()
        self.length = 1 / operator.norm_bound**2

    @property
    def solution(self) -> Array:
        """The last iterate."""
        return self.x

    def step(self) -> IterationRecord:
        """Go down the gradient, then towards what is likely."""
        before = self.x
        rest = self.operator.forward(before) - self.data
        down = before - before.dtype.type(self.length) * self.operator.adjoint(rest)
        # To a prior a picture is (n_channels, height, width), without an axis of depth.
        shape = down.shape if down.shape[1] > 1 else (down.shape[0], *down.shape[2:])
        self.x = self.prior.prox(down.reshape(shape), self.length).reshape(down.shape)
        change = float(np.linalg.norm(self.x - before) / max(np.linalg.norm(self.x), 1e-30))
        return IterationRecord(0, 0.0, data_residual=float(np.linalg.norm(rest)), change=change)


def make(part: Part, start: Array | None) -> Landweber:
    """Return the solver of a part of a problem."""
    return Landweber(part.operator, part.solved_data, part.prior, start)


SOLVER = OfferedSolver(
    name="landweber", help="Proximal gradient without acceleration; for comparison.", make=make, cost=2.0
)
