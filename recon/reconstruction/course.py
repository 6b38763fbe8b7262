"""How far a reconstruction is: the share of its time that is over, which never goes back."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol

import numpy as np

from recon.camera.camera_model import CAMERAS
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part, parts_of, picture_bytes, volume_plan
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.solve import ITERATIONS, Progress
from recon.reconstruction.uncertainty import REPEATS
from recon.solvers.base import IterationRecord
from recon.solvers.memory import in_words, resident_bytes

Name = Literal["refine", "choose", "solve", "uncertainty", "judge"]
TOLD_AT = 12
"""Iterations from which on the share is that of the time: how long one takes, and how fast they settle, shows
then. Of 8 runs by default options the iterations foretold by these were within 25 % in 5, and within 45 %."""
FORESEEN = ("tv", "tv-isotropic", "l1")
"""Priors by which memory is foreseen."""
KEPT = 8
"""Copies of the data that a picture's problem keeps, about."""
_UNCOUNTED = 2
_SETTLING, _EVERY = 30, 10
"""Up to so many iterations their number is foretold after each, then after every so many."""
JUDGING_S = 0.4
"""Processor time that judging takes besides two iterations, of any size: 0.35 to 0.43 s were measured."""


class Course:
    """Gives every stage its share of the whole: about as long as it takes, from measured iterations on.

    Parameters
    ----------
    options : ReconstructionOptions
        Say which stages there are.
    on_stage : callable, optional
        ``on_stage(share, what)``, of the whole.
    """

    def __init__(self, options: ReconstructionOptions, on_stage: Stage | None) -> None:
        self._options, self._tell, self._done = options, on_stage, 0.0
        self._began = time.perf_counter(), time.process_time()
        self._resident = resident_bytes()
        self._left: dict[Name, float] = {  # in units of solving, what is not begun
            "refine": 1.5 * options.refine_psf,
            "choose": 0.25 * (options.model == "auto"),
            "solve": 1.0,
            "uncertainty": float(REPEATS * options.uncertainty),
            "judge": 0.5 * options.judged,
        }

    def stage(self, name: Name) -> Stage:
        """Return what a stage tells its own share; it gets its part of what is left when it begins."""
        span: tuple[float, float] | None = None

        def tell(share: float, what: str) -> None:
            nonlocal span
            if span is None:
                whole = sum(self._left.values())
                span = self._done, (1 - self._done) * self._left.pop(name) / whole if whole else 0.0
            self._say(span[0] + span[1] * min(max(share, 0.0), 1.0), what)

        return tell

    def _say(self, done: float, what: str) -> None:
        self._done = max(self._done, min(done, 1.0))
        if self._tell is not None:
            self._tell(self._done, what)

    def iterations(self, on_progress: Progress | None, runs: int, problem: Problem) -> Progress | None:
        """Return what the solver tells: of each run, one after the other.

        Before the first iteration, and until its end is foretold, the memory is said that solving takes.
        """
        if self._tell is None:
            return on_progress
        tell, run, records, count = self.stage("solve"), -1, list[IterationRecord](), 0
        tolerance, expected = problem.stop_tolerance, expected_bytes(problem)
        if problem.n_planes == 1:  # of choosing much is free again: what is kept is counted
            expected += KEPT * problem.data.nbytes + problem.calibration.psfs.nbytes
        else:
            expected += resident_bytes() - self._resident
        takes = "" if np.isnan(expected) else f"takes about {in_words(expected)} of memory"
        if takes:
            tell(0.0, f"solving: {takes}")

        def watch(record: IterationRecord, present: Callable[[], Any]) -> None:
            nonlocal run, count
            if on_progress is not None:
                on_progress(record, present)
            if run < 0 or record.iteration <= records[-1].iteration:
                run += 1
                records.clear()
            records.append(record)
            what = f"iteration {record.iteration}, change {record.change:.1e}"
            if len(records) < TOLD_AT:
                if not run:
                    what += f"; {takes}" if takes else ""
                    tell(_done_share(self._options, record, runs) / runs, what)
                return
            if len(records) < _SETTLING or len(records) % _EVERY == 0:
                count = expected_iterations(records, self._options, tolerance, runs)
            count = max(count, record.iteration)
            each_s = (record.seconds - records[_UNCOUNTED - 1].seconds) / (len(records) - _UNCOUNTED)
            further = max(runs - 1 - run, 0) * count + count - record.iteration
            wall_s, processor_s = (
                now - began
                for now, began in zip((time.perf_counter(), time.process_time()), self._began, strict=True)
            )
            left_s = each_s * (further + self._left.get("uncertainty", 0.0) * runs * count)
            if "judge" in self._left and self._options.judged:
                left_s += 2 * each_s + JUDGING_S * max(wall_s / max(processor_s, 1e-9), 0.5)
            self._say(wall_s / (wall_s + left_s), f"{what}, of about {count}")

        return watch


def expected_bytes(problem: Problem) -> float:
    """Return what solving takes beside what the problem is made of; NaN where that is not known.

    Raises NoMemoryError where a camera whose PSFs vary does not fit, before it is made.
    """
    known = isinstance(problem.prior, str) and problem.prior in FORESEEN and problem.options.device == "cpu"
    if not known or problem.patterned or problem.model in CAMERAS:
        return float("nan")
    if problem.varies:
        part = Part(problem, parts_of(problem)[0])
        part.close()
        return float("nan") if part.plan is None else float(part.plan.total)
    if problem.n_planes == 1:
        looks = problem.options.tau is None or problem.solver.name == "admm-sensor"
        return float(picture_bytes(problem)) if looks else float("nan")
    plan = volume_plan(problem)
    return float(plan.total) if plan.fits else float("nan")  # else some of it lies on a disk


class Limits(Protocol):
    """Options that say when a run ends at the latest."""

    @property
    def iterations(self) -> int | None:
        """At most so many."""
        ...

    @property
    def time_s(self) -> float | None:
        """At most so long."""
        ...


def expected_iterations(
    records: Sequence[IterationRecord], options: Limits, tolerance: float, runs: int = 1
) -> int:
    """Return how many iterations a run will take, by those that it did.

    At most as many as count and time allow; fewer where what they change falls to the tolerance before, as a
    power of their number and of its exponential alike: the first foretells too many, the second too few.
    """
    last = records[-1]
    limit = ITERATIONS if options.iterations is None and options.time_s is None else options.iterations
    most = float("inf") if limit is None else float(limit)
    if options.time_s is not None:
        most = min(most, last.iteration * options.time_s / runs / max(last.seconds, 1e-9))
    counted = records[len(records) // 2 - 1 :: max(1, len(records) // 50)]  # 50 at most tell as much
    number = np.array([r.iteration for r in counted], float)
    unrest = np.array([r.unrest for r in counted])
    if tolerance > 0 and len(counted) > 2 and np.isfinite(unrest).all() and (unrest > 0).all():
        if unrest[-1] <= tolerance:  # whether it still falls is rounding
            return last.iteration
        ends = []
        for bent, back in ((np.log, np.exp), (np.sqrt, np.square)):
            slope, start = np.polyfit(bent(number), np.log(unrest), 1)
            with np.errstate(over="ignore"):  # as good as never
                end = float(back(max((np.log(tolerance) - start) / slope, 0.0))) if slope < 0 else most
            ends.append(end)
        settled = np.sqrt(np.prod(np.minimum(ends, max(most, 1.0))))
        most = min(most, float(settled))
    return max(round(min(most, 1e9)), last.iteration)


def _done_share(options: ReconstructionOptions, record: IterationRecord, runs: int = 1) -> float:
    """Return how much of one run's iterations is done, 0 to 1: the nearer of count and time to its end."""
    limit = ITERATIONS if options.iterations is None and options.time_s is None else options.iterations
    by_count = 0.0 if limit is None else record.iteration / limit
    by_time = 0.0 if options.time_s is None else record.seconds * runs / options.time_s
    return min(max(by_count, by_time), 1.0)
