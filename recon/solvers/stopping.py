"""When a solver stops, and what it records on the way."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np


class StopReason(enum.StrEnum):
    """Why a solver stopped."""

    NOISE_LEVEL = "the residual is down to the expected noise"
    CONVERGED = "the change per iteration fell below the tolerance"
    TIME = "the time budget is spent"
    ITERATIONS = "the number of iterations is reached"
    CANCELLED = "cancelled"
    ONE_STEP = "solved in one step"
    NOT_FINITE = "the iterate is no longer finite; the starting point is returned"


@dataclass(frozen=True, slots=True)
class IterationRecord:
    """What one iteration reached. NaN stands for what the solver does not know at this iteration."""

    iteration: int
    """Counted from 1."""
    seconds: float
    """Wall time since the run began, without callbacks."""
    objective: float = np.nan
    """``1/2 ||A x - b||^2 + prior(x)``."""
    data_residual: float = np.nan
    """``||A x - b||``; compare with the expected noise norm."""
    primal_residual: float = np.nan
    """How far the split variables disagree, relative to their size (splitting methods)."""
    dual_residual: float = np.nan
    """How far the optimality condition is missed, relative to its terms (splitting methods)."""
    change: float = np.nan
    """``||x - x_previous|| / ||x||``; every solver knows it, and one that is not finite ends the run."""

    @property
    def unrest(self) -> float:
        """What is compared with the tolerance: the change, or the residuals over ``RESIDUAL_FACTOR``."""
        residual = float(np.nanmax([self.primal_residual, self.dual_residual, 0.0]))
        return max(self.change, residual / RESIDUAL_FACTOR)


RESIDUAL_FACTOR = 10.0
"""Primal and dual residuals may be so much larger than the tolerance: pictures were seen to settle to 0.1 dB
while these were ten times the change an iteration."""


@dataclass(frozen=True, slots=True)
class StoppingRules:
    """The rules; whichever fires first ends the run.

    Attributes
    ----------
    iterations : int or None
        At most so many.
    time_s : float or None
        Wall time budget, seconds; the iteration that runs out of it is completed.
    tolerance : float
        Stop when the change per iteration has been below this for ``patience`` iterations in a row and,
        where the solver knows them, primal and dual residual below ``RESIDUAL_FACTOR`` times this;
        0 disables.
    noise_norm : float or None
        Expected ``||noise||`` over the valid data; stop when the residual norm is down to it.
    patience : int
    """

    iterations: int | None = 1000
    time_s: float | None = None
    tolerance: float = 1e-4
    noise_norm: float | None = None
    patience: int = 3

    def __post_init__(self) -> None:
        if self.iterations is None and self.time_s is None and self.tolerance <= 0:
            raise ValueError("A run needs an end: give iterations, time_s or a tolerance above 0.")
        if self.iterations is not None and self.iterations < 1:
            raise ValueError(f"iterations must be 1 or more, not {self.iterations}.")
        if self.time_s is not None and not self.time_s > 0:
            raise ValueError(f"time_s must be above 0, not {self.time_s:g}.")
        if not self.tolerance >= 0:
            raise ValueError(f"tolerance must not be negative; got {self.tolerance:g}.")


@dataclass(slots=True)
class StopCheck:
    """Applies :class:`StoppingRules` to a run as it goes."""

    rules: StoppingRules
    _calm: int = field(default=0, init=False)

    def __call__(self, record: IterationRecord) -> StopReason | None:
        """Return the reason to stop after this iteration, or None."""
        rules = self.rules
        if not np.isfinite(record.change) or np.isinf([record.data_residual, record.objective]).any():
            return StopReason.NOT_FINITE
        if rules.noise_norm is not None and record.data_residual <= rules.noise_norm:
            return StopReason.NOISE_LEVEL
        self._calm = self._calm + 1 if record.unrest < rules.tolerance else 0
        if rules.tolerance > 0 and self._calm >= rules.patience:
            return StopReason.CONVERGED
        if rules.time_s is not None and record.seconds >= rules.time_s:
            return StopReason.TIME
        if rules.iterations is not None and record.iteration >= rules.iterations:
            return StopReason.ITERATIONS
        return None
