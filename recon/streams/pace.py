"""How fine a live picture the machine affords at present: pixels, planes and iterations for a budget of time.

Knows no clock: it is told what things took. Two times are told apart: the work of the picture's thread, which
pixels cost, and its waiting for a processor that others use, which coarser pixels may or may not lessen. What
a binning takes is measured while it is in use; a coarser one that did not help is left again. Planes left out
are levels like binnings: a level's work is less by its square (:class:`recon.streams.detail.Detail`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

LEAST_ITERATIONS = 2
"""Iterations a frame below which a coarser binning gives the better picture: one warm iteration a frame does
not keep up with a moving scene, two do, and binning 2 x 2 loses less than the second gains."""
ROOM = 1.25
"""A finer binning is gone back to where it leaves this much room in the budget, so that it stays there."""
PATIENCE_COARSER, PATIENCE_FINER, PATIENCE_NEW = 3, 20, 5
"""Frames in a row for which another binning must look right (a finer one that was never tried: fewer): a
picture's pixels should not flicker."""
LARGEST_PATIENCE = 320
"""A finer binning that had to be left again soon is waited for twice as long, up to this."""
SOON = 60
"""Pictures within which a finer binning that is left again has failed."""
MEMORY = 7
"""Pictures whose median tells what things take: of single ones it says nothing."""
HELPED = 0.8
"""A coarser level has helped when its pictures take at most this share of the finer one's time."""
LEAST_WORK = 0.2
"""Share of a picture's time that must be work for coarser pixels to be worth trying."""
HOLD = 150
"""Pictures for which no coarser binning is tried after one did not help."""


@dataclass(frozen=True, slots=True)
class Spent:
    """What something took, milliseconds."""

    wall_ms: float
    work_ms: float
    """Of it, processor time of the thread."""

    def __add__(self, other: Spent) -> Spent:
        return Spent(self.wall_ms + other.wall_ms, self.work_ms + other.work_ms)

    def __sub__(self, other: Spent) -> Spent:
        return self + other.scaled(-1)

    def scaled(self, factor: float) -> Spent:
        """Return so many times as much."""
        return Spent(factor * self.wall_ms, factor * self.work_ms)

    def for_work(self, work_ms: float) -> Spent:
        """Return what other work takes where this is what this work took."""
        return Spent(self.wall_ms * work_ms / max(self.work_ms, 1e-3), work_ms)


@dataclass(frozen=True, slots=True)
class Cost:
    """What a picture takes at one binning."""

    fixed: Spent
    """Everything but the iterations."""
    step: Spent
    """One iteration."""

    def scaled(self, factor: float) -> Cost:
        """Return the cost on ``factor`` times as many pixels."""
        return Cost(self.fixed.scaled(factor), self.step.scaled(factor))

    @property
    def least(self) -> Spent:
        """A picture of ``LEAST_ITERATIONS``."""
        return self.fixed + self.step.scaled(LEAST_ITERATIONS)


@dataclass
class _Record:
    """What one binning's last pictures took."""

    fixed: deque[Spent] = field(default_factory=lambda: deque(maxlen=MEMORY))
    step: deque[Spent] = field(default_factory=lambda: deque(maxlen=MEMORY))
    least_step_ms: float = float("inf")
    least_filter_ms: float = float("inf")

    @property
    def cost(self) -> Cost | None:
        return Cost(_median(self.fixed), _median(self.step)) if self.fixed and self.step else None


class Pace:
    """Chooses binning and iterations.

    Parameters
    ----------
    levels : sequence of float
        Coarsenesses to choose from, ascending: a binning's is its factor.
    """

    def __init__(self, levels: Sequence[float]) -> None:
        self.levels = tuple(levels)
        self._records: dict[float, _Record] = {}
        self._known: dict[float, Cost] = {}
        """Of binnings that were in use before: their work still tells, their waiting does not."""
        self._level = self.levels[0]
        self._votes = 0
        self._since = 0
        """Pictures since the binning in use was entered."""
        self._held = 0
        """Pictures for which no coarser binning is tried."""
        self._came_from: tuple[float, float] | None = None
        """The finer binning that was left for this one, and what its pictures took."""
        self._went_finer = False
        self._patience = PATIENCE_FINER

    # What things take ------------------------------------------------------------------------------
    def note(self, fixed: Spent, steps: Spent, count: int) -> None:
        """Take note of a picture of ``count`` iterations, which took ``steps``, and ``fixed`` the rest."""
        record = self._record
        step = steps.scaled(1 / count)
        record.fixed.append(fixed)
        record.step.append(step)
        record.least_step_ms = min(record.least_step_ms, step.wall_ms)

    def note_filter(self, spent: Spent) -> None:
        """Take note of a Wiener picture: it tells how busy the machine is, so what a step would take."""
        record = self._record
        record.least_filter_ms = min(record.least_filter_ms, spent.wall_ms)
        if record.step:
            step_ms = record.least_step_ms * spent.wall_ms / record.least_filter_ms
            record.step.append(Spent(step_ms, min(_median(record.step).work_ms, step_ms)))

    def cost(self, level: float) -> Cost | None:
        """Return what a level takes, another's guessed from the one in use; None where that is not known."""
        here = self._record.cost
        if level == self._level or here is None:
            return here
        known = self._known.get(level)
        if known is None:
            return here.scaled((self._level / level) ** 2)
        return Cost(here.fixed.for_work(known.fixed.work_ms), here.step.for_work(known.step.work_ms))

    def affordable(self, level: float, budget_ms: float) -> int:
        """Return how many iterations fit into a budget at a level; the least before anything is known."""
        cost = self.cost(level)
        if cost is None:
            return LEAST_ITERATIONS
        return max(int((budget_ms - cost.fixed.wall_ms) / max(cost.step.wall_ms, 1e-3)), 0)

    def fits(self, level: float, budget_ms: float) -> bool:
        """Whether a level leaves time for enough iterations."""
        return self.affordable(level, budget_ms) >= LEAST_ITERATIONS

    # The binning -----------------------------------------------------------------------------------
    def enter(self, level: float) -> None:
        """Go on at another level."""
        before = self._record.cost
        if before is not None:
            self._known[self._level] = before
        self._came_from = None
        if level > self._level:
            if self._went_finer and self._since < SOON:
                self._patience = min(2 * self._patience, LARGEST_PATIENCE)
            if before is not None and self._held == 0:
                self._came_from = self._level, before.least.wall_ms
        self._went_finer = level < self._level
        self._level, self._votes, self._since = level, 0, 0
        self._records[level] = _Record()

    def give_up(self, level: float) -> None:
        """Choose a level no more that cannot be had, nor finer ones unless one of those is in use."""
        self.levels = tuple(b for b in self.levels if b > level or (level > self._level and b != level))
        self._came_from = None
        self._votes = 0

    def next_level(self, budget_ms: float) -> float:
        """Return the level for the pictures to come: another one only when several in a row asked for it."""
        self._since += 1
        self._held = max(self._held - 1, 0)
        if self._went_finer and self._since == SOON:
            self._patience = PATIENCE_FINER
        if self._did_not_help():
            assert self._came_from is not None
            self._held = HOLD
            return self._came_from[0]
        wanted = self._right(budget_ms)
        if wanted == self._level:
            self._votes = 0
            return wanted
        direction = 1 if wanted > self._level else -1
        self._votes = self._votes + direction if self._votes * direction > 0 else direction
        finer = self._patience if wanted in self._known else PATIENCE_NEW
        patience = PATIENCE_COARSER if direction > 0 else finer
        if abs(self._votes) < patience:
            return self._level
        self._votes = 0
        return wanted

    def _did_not_help(self) -> bool:
        """Whether this level, by now measured, is hardly faster than the finer one that was left for it."""
        if self._came_from is None or len(self._record.step) < MEMORY:
            return False
        cost = self._record.cost
        finer, took_ms = self._came_from
        share = max(HELPED, (1 + (finer / self._level) ** 2) / 2)  # half of what a small step can save
        helped = cost is not None and cost.least.wall_ms <= share * took_ms
        if helped:
            self._came_from = None
        return not helped

    def _right(self, budget_ms: float) -> float:
        level, cost = self._level, self._record.cost
        if cost is None or len(self._record.step) < PATIENCE_COARSER:
            return level
        if self.fits(level, budget_ms):
            finer = [b for b in self.levels if b < level]
            return next((b for b in finer if self.fits(b, budget_ms / ROOM)), level)
        coarser = [b for b in self.levels if b > level]
        least = cost.least
        if self._held or not coarser or least.work_ms < LEAST_WORK * least.wall_ms:
            return level
        return next((b for b in coarser if self.fits(b, budget_ms)), coarser[-1])

    @property
    def _record(self) -> _Record:
        return self._records.setdefault(self._level, _Record())


def _median(spent: deque[Spent]) -> Spent:
    return Spent(median(s.wall_ms for s in spent), median(s.work_ms for s in spent))
