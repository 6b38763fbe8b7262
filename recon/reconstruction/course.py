"""How far a reconstruction is: one measure of all that it does, which never goes back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Stage
from recon.reconstruction.solve import ITERATIONS, Progress
from recon.reconstruction.uncertainty import REPEATS
from recon.solvers.base import IterationRecord

Name = Literal["refine", "choose", "solve", "uncertainty", "judge"]


class Course:
    """Gives every stage its share of the whole, about as long as it takes.

    Parameters
    ----------
    options : ReconstructionOptions
        Say which stages there are.
    on_stage : callable, optional
        ``on_stage(share, what)``, of the whole.
    """

    def __init__(self, options: ReconstructionOptions, on_stage: Stage | None) -> None:
        self._options, self._tell, self._done = options, on_stage, 0.0
        costs: dict[Name, float] = {  # in units of solving
            "refine": 1.5 * options.refine_psf,
            "choose": 0.25 * (options.model == "auto"),
            "solve": 1.0,
            "uncertainty": float(REPEATS * options.uncertainty),
            "judge": 0.5 * options.judged,
        }
        self._of = {name: cost / sum(costs.values()) for name, cost in costs.items()}
        names = list(costs)
        self._before = {name: sum(self._of[n] for n in names[:i]) for i, name in enumerate(names)}

    def stage(self, name: Name) -> Stage:
        """Return what a stage tells its own share."""

        def tell(share: float, what: str) -> None:
            self._done = max(self._done, self._before[name] + self._of[name] * min(max(share, 0.0), 1.0))
            if self._tell is not None:
                self._tell(self._done, what)

        return tell

    def iterations(self, on_progress: Progress | None, runs: int) -> Progress | None:
        """Return what the solver tells: of each run, one after the other, the nearer of count and time."""
        if self._tell is None:
            return on_progress
        tell, run, last = self.stage("solve"), -1, 0

        def watch(record: IterationRecord, present: Callable[[], Any]) -> None:
            nonlocal run, last
            if on_progress is not None:
                on_progress(record, present)
            run, last = run + (run < 0 or record.iteration <= last), record.iteration
            share = (min(run, runs - 1) + done_share(self._options, record, runs)) / runs
            tell(share, f"iteration {record.iteration}, change {record.change:.1e}")

        return watch


def done_share(options: ReconstructionOptions, record: IterationRecord, runs: int = 1) -> float:
    """Return how much of one run's iterations is done, 0 to 1: the nearer of count and time to its end."""
    limit = ITERATIONS if options.iterations is None and options.time_s is None else options.iterations
    by_count = 0.0 if limit is None else record.iteration / limit
    by_time = 0.0 if options.time_s is None else record.seconds * runs / options.time_s
    return min(max(by_count, by_time), 1.0)
