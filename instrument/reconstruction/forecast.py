"""What a reconstruction will take, time and memory: by the last like it, or by its first iterations."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from math import log
from typing import Any, Self

import numpy as np

from instrument.files import kept_times
from instrument.files.errors import duration
from instrument.reconstruction.job import Job
from recon.base.threads import get_threads
from recon.reconstruction.course import TOLD_AT
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import reconstruct
from recon.reconstruction.reduction import on_blocks, reduced_calibration
from recon.reconstruction.solve import ITERATIONS
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.base import IterationRecord, StopReason
from recon.solvers.memory import MemoryMeter, in_words
from recon.types import Calibration

TRIED = 16
"""Iterations that are run to tell what each takes, and how fast they settle; the first ones are slower, of
varying PSFs twice, and do not count."""
_UNCOUNTED = 4
BLOCK = 2
"""Side of the blocks of pixels on which a copy is solved to tell when it settles."""
LEAST_PX = 64
"""Side of sensors that blocks tell anything of."""
COPY_SHARE, COPY_S = 0.5, 5.0
"""Share of the longest that all may take, and seconds, after both of which the copy is given up."""
STRETCHED = 3.0
"""A copy settles at most so many times as fast, or as slowly."""
WORTH_BYTES = 2**20
"""Memory that is told: less was there already."""
DIFFERS = 1.25
"""What the first iterations say is told beside what was told before from this factor on."""
MOST_TIMES, MOST_SIZES = 8, 6
"""A size tells of others at most so many times as large; so many sizes of a kind are remembered."""
COMPILING = 0.05
"""Share of the time: more of it went to compilers, and the next one will take less."""
_NO_MATTER = ("z_um", "scratch", "memory_gib")


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a reconstruction will take on this machine, as busy as it is now.

    Attributes
    ----------
    beside_s : float
        Choosing, first look, set-up, and judging.
    iteration_s : float
        Each iteration, of all channels together; 0 for solvers in one step.
    iterations : int
        At most so many: it may settle before.
    memory_bytes : float
        At the peak beyond what the program takes; NaN where the system does not say.
    time_s : float or None
        The limit that was asked for.
    settles : int or None
        After how many iterations it is expected to settle, by a copy on blocks of pixels; None where none was
        made, or it did not settle.
    """

    beside_s: float
    iteration_s: float
    iterations: int
    memory_bytes: float
    time_s: float | None = None
    settles: int | None = None

    @property
    def seconds(self) -> float:
        """All of it: as long as it is expected to take where that is known, else at most."""
        solving = min(self.iterations, self.settles or self.iterations) * self.iteration_s
        return self.beside_s + (solving if self.time_s is None else min(solving, self.time_s))

    def __str__(self) -> str:
        """Say it in a line."""
        each = f", {1e3 * self.iteration_s:.3g} ms an iteration" if self.iterations else ""
        memory = (
            "" if self.memory_bytes != self.memory_bytes else f"; {in_words(self.memory_bytes)} of memory"
        )
        if self.settles is None:
            return f"at most {duration(self.seconds)}{each} ({TRIED} were tried){memory}"
        most = duration(self.beside_s + self.iterations * self.iteration_s)
        return (
            f"about {duration(self.seconds)}{each}, {self.settles} of them (by how a copy on blocks of "
            f"{BLOCK} x {BLOCK} pixels settles; {self.iterations} take {most}){memory}"
        )


@dataclass(frozen=True, slots=True)
class Like:
    """Reconstructions like one, of other photographs and of other sizes: what the last ones took here.

    Attributes
    ----------
    key : str
        What they have in common: options, PSFs, channels, threads.
    size : int
        Values of the photograph.
    """

    key: str
    size: int

    @classmethod
    def of(cls, job: Job, options: ReconstructionOptions) -> Like:
        """Return those like a job; its depth does not matter, nor where files go."""
        alike = {f.name: getattr(options, f.name) for f in fields(options) if f.name not in _NO_MATTER}
        psfs, channels = job.calibration.psfs.shape[:2]
        shown = repr((alike, psfs, channels, job.measurement.ndim, job.valid is None, get_threads()))
        return cls(f"reconstruction {hashlib.sha256(shown.encode()).hexdigest()[:12]}", job.measurement.size)

    def took(self) -> tuple[float, float] | None:
        """Return the seconds and bytes that this one will take, by that of the nearest size; None: unknown.

        NaN bytes where the system did not say.
        """
        try:
            known = {
                int(kept_times.sane(size)): (kept_times.sane(s), float(b))
                for size, s, b in kept_times.recall(self.key)
            }
            known.pop(0, None)
        except (LookupError, TypeError, ValueError, OverflowError):
            return None
        nearest = min(known, key=lambda size: abs(log(size / self.size)), default=0)
        if not nearest or abs(log(self.size / nearest)) > log(MOST_TIMES):
            return None
        seconds, taken = known[nearest]
        return seconds * self.size / nearest, taken * self.size / nearest

    def keep(self, seconds: float, memory_bytes: float) -> None:
        """Remember what it took."""
        try:
            known = {int(kept_times.sane(size)): [size, *rest] for size, *rest in kept_times.recall(self.key)}
        except (LookupError, TypeError, ValueError):
            known = {}
        known.pop(self.size, None)
        known[self.size] = [self.size, round(seconds, 3), memory_bytes]
        kept_times.remember(self.key, list(known.values())[-MOST_SIZES:])


class Foretold:
    """Tells what all of a reconstruction will take: before it, where there were like ones, and early in it.

    Its ``watch`` and ``stage`` are called with what the reconstruction tells
    (:func:`recon.reconstruction.reconstruct.reconstruct`); made before it begins. A context, so that
    compilers are watched no longer than it.

    Parameters
    ----------
    tell : callable
        ``tell(words)``: ``"about 12.0 s in all; 340 MiB of memory"``. Once; again where the first dozen of
        iterations say something else.
    like : Like, optional
        By which it is told before, and kept for the next.
    """

    def __init__(self, tell: Callable[[str], object], like: Like | None = None) -> None:
        self._tell, self._iterations, self._told, self._like = tell, 0, False, like
        self._compiled_s, self._timers = 0.0, ExitStack()
        self._began, self._meter = time.perf_counter(), MemoryMeter()
        self.seconds = self.memory_bytes = float("nan")
        self.before = None if like is None else like.took()
        if self.before is not None:
            seconds, taken = self.before
            memory = f"; {in_words(taken)} of memory" if taken >= WORTH_BYTES else ""
            tell(f"about {duration(seconds)} in all{memory}, by the last like it")
        if like is not None:
            from numba.core import event

            self._timers.enter_context(event.install_timer("numba:compile", self._compiled))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._timers.close()

    def _compiled(self, seconds: float) -> None:
        self._compiled_s += seconds

    def watch(self, _record: IterationRecord, _present: Callable[[], Any]) -> None:
        """Count an iteration."""
        self._iterations += 1

    def stage(self, share: float, _what: str) -> None:
        """Tell, where the share has become that of the time."""
        if self._told or self._iterations < TOLD_AT:
            return
        self._told = True
        self.seconds = (time.perf_counter() - self._began) / max(share, 1e-3)
        self.memory_bytes = self._meter.peak_mib() * 2**20
        if self.before is not None and abs(log(self.seconds / max(self.before[0], 1e-3))) < log(DIFFERS):
            return
        memory = (
            f"; {in_words(self.memory_bytes)} of memory so far" if self.memory_bytes >= WORTH_BYTES else ""
        )
        self._tell(f"about {duration(self.seconds)} in all{memory}")

    def ended(self, stop_reasons: Sequence[str]) -> None:
        """Keep what it took; of one that was cancelled, or waited for compilers, nothing."""
        took_s, taken = time.perf_counter() - self._began, self._meter.peak_mib() * 2**20
        self._timers.close()
        whole = StopReason.CANCELLED not in stop_reasons and self._compiled_s < COMPILING * took_s
        if self._like is not None and whole:
            self._like.keep(took_s, taken)


def forecast(measurement: Measurement, calibration: Calibration, options: ReconstructionOptions) -> Forecast:
    """Run the first iterations of a reconstruction, and tell what all of it takes.

    Errors as :func:`~recon.reconstruction.reconstruct.reconstruct`.
    """
    records: list[IterationRecord] = []

    def note(record: IterationRecord, _now: Callable[[], Any]) -> None:
        records.append(record)

    limits: dict[str, Any] = {}
    if options.solver == "auto" or not SOLVERS.named(options.solver).one_step:
        limits = {"iterations": TRIED, "time_s": None, "tolerance": 0.0, "stop_at_noise": False}
    meter, began = MemoryMeter(), time.perf_counter()
    found = reconstruct(measurement, calibration, replace(options, **limits), on_progress=note)
    spent, memory = time.perf_counter() - began, meter.peak_mib() * 2**20
    runs = [history for history in found.histories if len(history) > _UNCOUNTED]
    each = sum((run[-1].seconds - run[_UNCOUNTED - 1].seconds) / (len(run) - _UNCOUNTED) for run in runs)
    count = (options.iterations or ITERATIONS) if runs else 0
    if options.iterations is None and options.time_s is not None and each > 0:
        count = int(options.time_s / each)
    beside_s = max(spent - len(records) * each / max(len(runs), 1), 0.0)
    settles = None
    if count > TRIED and options.time_s is None:
        longest, smooth = max(runs, key=lambda run: run[-1].unrest), found.background is not None
        settles = _settling(
            measurement,
            calibration,
            options if options.positive_background else replace(options, estimate_background=smooth),
            longest,
            max(COPY_SHARE * count * each, COPY_S),
        )
    return Forecast(beside_s, each, count, memory, options.time_s, settles)


def _settling(
    measurement: Measurement,
    calibration: Calibration,
    options: ReconstructionOptions,
    first: Sequence[IterationRecord],
    time_s: float,
) -> int | None:
    """Return after how many iterations all settles, by its first ones and a copy on blocks of pixels.

    None where no copy can be made, or it does not settle in its number of iterations or its time.
    """
    if options.tolerance == 0 or options.stop_at_noise or measurement.patterns is not None:
        return None
    problem = Problem.of(measurement, calibration, options)
    if min(problem.sensor_shape) < LEAST_PX:
        return None
    copy = on_blocks(problem.data, problem.valid, 1.0, BLOCK, flat=problem.flat)
    asked = replace(
        options,
        judged=False,
        refine_psf=False,
        uncertainty=False,
        time_s=time_s,
        iterations=options.iterations or ITERATIONS,
    )
    found = reconstruct(copy, reduced_calibration(problem.calibration, BLOCK, None), asked)
    if set(found.stop_reasons) != {StopReason.CONVERGED}:  # its number or time ended it, which tells nothing
        return None
    slowest = max(found.histories, key=len)
    most = options.iterations or ITERATIONS
    return min(round(len(slowest) * _stretch(first, slowest)), most)


def _stretch(first: Sequence[IterationRecord], copy: Sequence[IterationRecord]) -> float:
    """Return how many times as many iterations it takes to come as far as a copy, by the first of them."""
    reached = np.array([record.unrest for record in first])
    course = np.array([record.unrest for record in copy])
    number, differs = np.arange(1, len(first) + 1), []
    place = np.flatnonzero(course > 0)  # the first iteration of varying PSFs and volumes changes nothing
    if place.size == 0:
        return 1.0
    stretches = np.geomspace(1 / STRETCHED, STRETCHED, 120)
    for stretch in stretches:
        at = number / stretch
        told = (number > _UNCOUNTED) & (at >= _UNCOUNTED - 1) & (at <= len(copy)) & (reached > 0)
        told_by = np.interp(at[told], place + 1, np.log(course[place]))
        many = np.count_nonzero(told) >= _UNCOUNTED
        differs.append(np.mean((np.log(reached[told]) - told_by) ** 2) if many else np.inf)
    return float(stretches[int(np.argmin(differs))]) if np.isfinite(differs).any() else 1.0
