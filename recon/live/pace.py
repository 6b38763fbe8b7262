"""How fine a live picture the machine affords at present: binning and iterations for a budget of time.

Knows no clock: it is told what things took.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

LEAST_ITERATIONS = 2
"""Iterations a frame below which a coarser binning gives the better picture: one warm iteration a frame does
not keep up with a moving scene, two do, and binning 2 x 2 loses less than the second gains."""

ROOM = 1.25
"""A finer binning is gone back to where it leaves this much room in the budget, so that it stays there."""

PATIENCE_COARSER, PATIENCE_FINER = 3, 20
"""Frames in a row for which another binning must look right: a picture's pixels should not flicker."""

MEMORY = 7
"""Pictures whose median tells how busy the machine is: of single ones it says nothing."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What a picture takes at one binning, milliseconds."""

    fixed_ms: float
    """Everything but the iterations."""
    step_ms: float
    """One iteration."""
    filter_ms: float
    """The Wiener filter in place of iterations."""

    def scaled(self, factor: float) -> Cost:
        """Return the cost on ``factor`` times as many pixels."""
        return Cost(factor * self.fixed_ms, factor * self.step_ms, factor * self.filter_ms)


class Pace:
    """Chooses binning and iterations.

    Parameters
    ----------
    levels : sequence of int
        Binnings to choose from, ascending.
    """

    def __init__(self, levels: Sequence[int]) -> None:
        self.levels = tuple(levels)
        self.costs: dict[int, Cost] = {}
        self._ratios: deque[float] = deque([1.0], MEMORY)
        self._votes = 0

    @property
    def busy(self) -> float:
        """Time that things take at present, relative to when ``costs`` were measured."""
        return median(self._ratios)

    def affordable(self, level: int, budget_ms: float) -> int:
        """Return how many iterations fit into a budget at a level."""
        cost = self.cost(level)
        return max(int((budget_ms / self.busy - cost.fixed_ms) / cost.step_ms), 0)

    def cost(self, level: int) -> Cost:
        """Return the cost of a level, guessed by its pixels from the nearest measured one."""
        if level in self.costs:
            return self.costs[level]
        known = min(self.costs, key=lambda other: abs(other - level))
        return self.costs[known].scaled((known / level) ** 2)

    def fits(self, level: int, budget_ms: float) -> bool:
        """Whether a level leaves time for enough iterations."""
        return self.affordable(level, budget_ms) >= LEAST_ITERATIONS

    def learn(self, took_ms: float, expected_ms: float) -> None:
        """Take note of what a picture took, and what ``costs`` had said."""
        self._ratios.append(took_ms / expected_ms)

    def next_level(self, level: int, budget_ms: float) -> int:
        """Return the level for the next frame: another one only when several frames in a row asked for it."""
        wanted = self._right(level, budget_ms)
        if wanted == level:
            self._votes = 0
            return level
        direction = 1 if wanted > level else -1
        self._votes = self._votes + direction if self._votes * direction > 0 else direction
        if abs(self._votes) < (PATIENCE_COARSER if direction > 0 else PATIENCE_FINER):
            return level
        self._votes = 0
        return wanted

    def _right(self, level: int, budget_ms: float) -> int:
        if not self.fits(level, budget_ms):
            coarser = [b for b in self.levels if b > level]
            return next((b for b in coarser if self.fits(b, budget_ms)), self.levels[-1])
        finer = [b for b in self.levels if b < level]
        return next((b for b in finer if self.fits(b, budget_ms / ROOM)), level)
