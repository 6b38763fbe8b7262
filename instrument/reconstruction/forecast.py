"""What work will take, time and memory, by its beginning, which is carried out: pictures and volumes.

What is the same for all work stands here: a :class:`Forecast`, and how much is carried out for it
(:func:`carried_out`). Films and holograms have theirs beside what they are.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, TypeVar

import numpy.typing as npt

from instrument.files.errors import duration
from recon.reconstruction.course import expected_iterations
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.reconstruct import LEAST, SHARE, reconstruct
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import ITERATIONS
from recon.reconstruction.solvers import SOLVERS
from recon.reconstruction.uncertainty import REPEATS
from recon.solvers.base import IterationRecord, StopReason
from recon.solvers.memory import MemoryMeter, in_words
from recon.types import Calibration

SOLVED_S = 5.0
"""What solving takes no longer than is carried out whole."""
TRIED, TRIED_S = 64, 60.0
"""Iterations of what takes longer, or seconds of them, whose course tells when it settles."""
_LEAST, _UNCOUNTED = 16, 4
"""Fewer tell nothing of when they settle; the first are slower, of varying PSFs twice, and do not count."""
ASTRAY = 1.5
"""How many times as many, or as few, the iterations may turn out that were told by the first."""
UNEVEN = 1.2
"""How many times as long, or as short, one may take later as the first ones did. A guess: a volume by the
low-rank model took 1.05 and 1.06 times the end that is told without this (docs/benchmarks/time-told.md)."""


@dataclass(frozen=True, slots=True, repr=False)
class Forecast:
    """What work will take on this machine, as busy as it is now.

    Attributes
    ----------
    beside_s : float
        Choosing, first look, set-up, and judging.
    iteration_s : float
        Each iteration, of all channels together; 0 for solvers in one step. Of a film each frame.
    iterations : int
        At most so many: it may settle before.
    memory_bytes : float
        At the peak beyond what the program takes; NaN where the system does not say.
    settles : int or None
        After how many iterations it ends, by the course of the first ones; None where they do not tell.
    counted : bool
        How many there are is known: as many as were asked for, or it was carried out to its end.
    """

    beside_s: float
    iteration_s: float
    iterations: int
    memory_bytes: float
    settles: int | None = None
    counted: bool = False
    each: str = "iteration"
    """What there are several of."""
    where: str = ""
    """Whose memory it is, where not this program's."""

    @property
    def seconds(self) -> float:
        """All of it: as long as it is expected to take where that is known, else at most."""
        return self._after(self.iterations if self.settles is None else self.settles)

    @property
    def between_s(self) -> tuple[float, float]:
        """Shortest and longest that it is expected to take."""
        if self.counted:
            return self.seconds, self.seconds
        if self.settles is None:
            return self.beside_s, self.seconds
        longest = min(self.settles * ASTRAY, self.iterations)
        return self._after(self.settles / ASTRAY) / UNEVEN, self._after(longest) * UNEVEN

    def _after(self, iterations: float) -> float:
        return self.beside_s + iterations * self.iteration_s

    def __repr__(self) -> str:
        """Say it in a line, as Python shows what it is."""
        return f"<Forecast: {self}>"

    def __str__(self) -> str:
        """Say it in a line."""
        an = "an" if self.each[0] in "aeiou" else "a"
        each = f", {1e3 * self.iteration_s:.3g} ms {an} {self.each}" if self.iterations else ""
        known = self.memory_bytes == self.memory_bytes
        memory = f"; {in_words(self.memory_bytes)} of memory{self.where}" if known else ""
        if self.counted or not self.iterations:
            count = f", {self.settles} of them" if each else ""
            return f"about {duration(self.seconds)}{each}{count}{memory}"
        if self.settles is None:
            return f"at most {duration(self.seconds)}{each}{memory}"
        least, most = map(duration, self.between_s)
        return (
            f"about {duration(self.seconds)} ({least} to {most}){each}, about {self.settles} of them "
            f"by the course of the first{memory}"
        )


@dataclass(frozen=True)
class Carried:
    """Work that was carried out, or its first iterations, and what it took.

    Attributes
    ----------
    seconds, memory_bytes : float
        All of it.
    histories : sequence of sequences of records
        Of each run after the other; of a record its ``iteration`` and ``seconds`` count.
    cut : bool
        Whether it would have gone on without the limits of what was tried.
    """

    seconds: float
    memory_bytes: float
    histories: Sequence[Sequence[Any]]
    cut: bool

    @property
    def longest(self) -> int:
        """Iterations of the longest run."""
        return max((run[-1].iteration for run in self.histories if run), default=0)

    @property
    def iteration_s(self) -> float:
        """What an iteration of all runs takes, the first of each left out as far as others are there."""

        def each_s(run: Sequence[Any]) -> float:
            first = min(_UNCOUNTED, len(run) - 1)
            began_s = run[first - 1].seconds if first else 0.0
            return float((run[-1].seconds - began_s) / (len(run) - first))

        return sum(each_s(run) for run in self.histories if run)


C = TypeVar("C", bound=Carried)


@contextlib.contextmanager
def _kernels_made() -> Iterator[list[object]]:
    """Give a list that gets an entry for each kernel that is compiled, or read from the disk, within.

    Both hold numba's lock of its compiler, which tells of it; a call of what is there does not.
    """
    if "numba" not in sys.modules:  # what is not there yet is told by the modules that it reads
        yield []
        return
    from numba.core import event

    with event.install_recorder("numba:compiler_lock") as recorder:
        yield recorder.buffer


def carried_out(begin: Callable[[int | None, float, float], C], soon_s: float) -> C:
    """Carry work out for so many seconds; where that tells too little, its first iterations anew.

    ``begin(iterations, time_s, done)`` carries it out up to these limits, the first none where None; ``done``
    is the share of all that is carried out before. A program's first work of a kind reads libraries and
    kernels on its way, which the work that is told finds there: what it took does not count. What another
    thread reads or compiles meanwhile passes for it: it is then carried out once more.
    """

    def tells(trial: Carried) -> bool:
        return not trial.cut or trial.longest >= TRIED

    before = len(sys.modules)
    with _kernels_made() as made:
        trial = begin(None, soon_s, 0.0)
    is_first = len(sys.modules) > before or bool(made)
    if is_first and tells(trial):
        trial, is_first = begin(None, soon_s, 0.5), False
    if tells(trial):
        return trial
    further = begin(TRIED, TRIED_S, 0.5)
    most = further.memory_bytes if is_first else max(trial.memory_bytes, further.memory_bytes)
    return replace(further, memory_bytes=most)


def forecast(
    measurement: Measurement,
    calibration: Calibration | npt.ArrayLike,
    options: ReconstructionOptions,
    on_stage: Stage | None = None,
) -> Forecast:
    """Carry out the first iterations of a reconstruction, or all where that is soon; tell what all takes.

    ``on_stage`` and errors as of :func:`~recon.reconstruction.reconstruct.reconstruct`.
    """
    over = 0.0

    def tell(share: float, what: str) -> None:
        nonlocal over
        over = max(over, share)
        if on_stage is not None:
            on_stage(over, what)

    one_step = options.solver != "auto" and SOLVERS.named(options.solver).one_step

    def begin(iterations: int | None, time_s: float, done: float) -> Trial:
        tried = options if one_step else limited(options, iterations, time_s)
        return Trial.of(measurement, calibration, tried, lambda s, w: tell(done + s / 2, w), options)

    trial = carried_out(begin, SOLVED_S / (1 + REPEATS * options.uncertainty))
    count = trial.longest
    if not trial.cut:
        return Forecast(trial.beside_s(count), trial.iteration_s, count, trial.memory_bytes, count, True)
    most = trial.most(options)
    settles = trial.settles(options, _tolerance(trial.found, measurement, calibration, options))
    beside_s, counted = trial.beside_s(settles or most), options.tolerance == 0 and settles is not None
    return Forecast(beside_s, trial.iteration_s, most, trial.memory_bytes, settles, counted)


def limited(options: ReconstructionOptions, iterations: int | None, time_s: float) -> ReconstructionOptions:
    """Return options that end after so many iterations or seconds, where they do not end before."""
    most = [n for n in (most_iterations(options), iterations) if n is not None]
    time_s = time_s if options.time_s is None else min(time_s, options.time_s)
    return replace(options, iterations=min(most, default=None), time_s=time_s)


def most_iterations(options: ReconstructionOptions) -> int | None:
    """Return how many iterations there may be by their number; None where the time alone ends them."""
    return ITERATIONS if options.iterations is None and options.time_s is None else options.iterations


@dataclass(frozen=True)
class Trial(Carried):
    """A reconstruction that was carried out, or its first iterations, and what it took."""

    found: Reconstruction
    counted: int
    """Iterations of all runs, those of rounds whose result was not taken too."""

    @classmethod
    def of(
        cls,
        measurement: Measurement,
        calibration: Calibration | npt.ArrayLike,
        tried: ReconstructionOptions,
        on_stage: Stage,
        options: ReconstructionOptions | None = None,
    ) -> Self:
        """Carry it out up to the limits that are ``tried``; ``options`` are those of all of it.

        Errors as :func:`~recon.reconstruction.reconstruct.reconstruct`.
        """
        counted, options = 0, options or tried

        def note(_record: IterationRecord, _now: Callable[[], Any]) -> None:
            nonlocal counted
            counted += 1

        meter, began = MemoryMeter(), time.perf_counter()
        found = reconstruct(measurement, calibration, tried, on_progress=note, on_stage=on_stage)
        seconds, memory_bytes = time.perf_counter() - began, meter.peak_mib() * 2**20
        counted_out = StopReason.ITERATIONS in found.stop_reasons
        cut = counted_out and tried.iterations != most_iterations(options)
        cut = cut or (StopReason.TIME in found.stop_reasons and tried.time_s != options.time_s)
        return cls(seconds, memory_bytes, found.histories, cut, found, counted)

    def most(self, options: ReconstructionOptions) -> int:
        """Return how many iterations there may be, by their number and time."""
        count = most_iterations(options)
        in_time = None if options.time_s is None else int(options.time_s / max(self.iteration_s, 1e-9))
        return min(n for n in (count, in_time) if n is not None)

    def settles(self, options: ReconstructionOptions, tolerance: float) -> int | None:
        """Return after how many iterations all ends, by its first ones; None where they do not tell."""
        if options.stop_at_noise or self.longest < _LEAST:
            return None
        runs = self.found.histories
        return max(expected_iterations(run, options, tolerance, len(runs)) for run in runs if run)

    def beside_s(self, iterations: int) -> float:
        """Return what all else takes where there are so many iterations, which some of it goes by."""
        else_s = self.seconds - self.counted / max(len(self.found.histories), 1) * self.iteration_s
        more = self._with(iterations) - self._with(self.longest)
        return max(else_s + more * self.iteration_s, 0.0)

    def _with(self, iterations: int) -> float:
        """Return how many further iterations an uncertainty and held-out pixels take."""
        verdict, runs = self.found.verdict, max(len(self.found.histories), 1)
        held_out = verdict is not None and verdict.held_out is not None
        repeated = REPEATS * iterations * (self.found.uncertainty is not None)
        return repeated + held_out * max(iterations / SHARE, LEAST) / runs


def _tolerance(
    found: Reconstruction,
    measurement: Measurement,
    calibration: Calibration | npt.ArrayLike,
    options: ReconstructionOptions,
) -> float:
    """Return the change an iteration at which a reconstruction settles."""
    if found.choice is not None:
        return found.choice.tolerance
    return Problem.of(measurement, calibration, options).stop_tolerance
