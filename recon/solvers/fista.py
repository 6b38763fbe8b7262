"""ISTA and FISTA with restart (Kuo 2020, Eqs. 2.5-2.9 and Algorithm 1)."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from recon.arrays import Array
from recon.base.arguments import require_argument
from recon.camera.base import LinearOperator
from recon.priors.base import Prior
from recon.solvers.base import IterationRecord, Solver, require_parts, starting_point

Restart = Literal["function", "gradient", "none"]


class Fista(Solver):
    """Proximal gradient descent with Nesterov's acceleration.

    One forward and one adjoint an iteration: the residual at the extrapolated point follows from those of the
    last two iterates by linearity, so that the objective is known at no extra cost.

    Parameters
    ----------
    operator : LinearOperator
    data : ndarray, ``operator.range_shape``
    prior : Prior
    initial : ndarray, optional
        Starting point on the operator's domain; default zeros.
    restart : "function", "gradient" or "none"
        When to forget the momentum: when the objective grows, or when the momentum points against the descent
        (O'Donoghue & Candès 2015).
    accelerate : bool
        False gives ISTA.
    step : float, optional
        Step length; default the safe ``1 / norm_bound**2``.
    """

    state_names: ClassVar[tuple[str, ...]] = (
        "x",
        "previous",
        "forward_x",
        "forward_previous",
        "t",
        "objective",
    )

    def __init__(
        self,
        operator: LinearOperator,
        data: Array,
        prior: Prior,
        *,
        initial: Array | None = None,
        restart: Restart = "gradient",
        accelerate: bool = True,
        step: float | None = None,
    ) -> None:
        super().__init__()
        self.data = np.asarray(require_parts(operator, data, prior), operator.dtype)
        self.operator = operator
        self.prior: Prior = prior.for_a_run()
        self.restart = require_argument("restart", restart, Restart)
        step = require_argument("step", step, float | None, above=0)
        self.accelerate = accelerate
        bound = operator.norm_bound
        self.step_length = step if step is not None else 1.0 / bound**2 if bound > 0 else 1.0
        self.x = starting_point(operator, initial)
        self.previous = self.x.copy()
        self.forward_x = operator.forward(self.x)
        self.forward_previous = self.forward_x.copy()
        self.t = 1.0
        self.objective = np.inf
        self._gradient = np.empty_like(self.x)

    @property
    def solution(self) -> Array:
        """The last iterate."""
        return self.x

    def step(self) -> IterationRecord:
        """Do one gradient step from the extrapolated point, and the prox."""
        t_next = (1 + np.sqrt(1 + 4 * self.t**2)) / 2 if self.accelerate else 1.0
        # y = x + beta (x - previous), in the storage of ``previous``; the same on the data side.
        beta = self.x.dtype.type((self.t - 1) / t_next)
        y, forward_y = self.previous, self.forward_previous
        for ahead, at in ((y, self.x), (forward_y, self.forward_x)):
            ahead *= -beta
            ahead += (1 + beta) * at
        forward_y -= self.data
        gradient = self.operator.adjoint(forward_y, self._gradient)
        gradient *= -self.x.dtype.type(self.step_length)
        gradient += y
        new = self.prior.checked_prox(gradient, self.step_length)
        against = float(np.vdot(y - new, new - self.x)) > 0
        self._gradient, self.previous, self.x = y, self.x, new
        self.forward_previous, self.forward_x = self.forward_x, self.forward_previous
        self.operator.forward(self.x, self.forward_x)

        residual = float(np.linalg.norm(self.forward_x - self.data))
        if not np.isfinite(residual):
            residual = np.inf  # NaN would mean "not known", and a prox may make zeros of it
        objective = 0.5 * residual**2 + self.prior.checked_value(self.x)
        grew = objective > self.objective
        self.objective = objective
        restart = (self.restart == "gradient" and against) or (self.restart == "function" and grew)
        self.t = 1.0 if restart else t_next
        size = float(np.linalg.norm(self.x))
        change = float(np.linalg.norm(self.x - self.previous)) / size if size > 0 else 0.0
        return IterationRecord(0, 0.0, objective, residual, change=change)
