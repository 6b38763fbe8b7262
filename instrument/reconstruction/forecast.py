"""What a reconstruction will take, time and memory, by its first iterations, which are carried out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

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
        return self._after(self.settles / ASTRAY), self._after(longest)

    def _after(self, iterations: float) -> float:
        return self.beside_s + iterations * self.iteration_s

    def __str__(self) -> str:
        """Say it in a line."""
        each = f", {1e3 * self.iteration_s:.3g} ms an iteration" if self.iterations else ""
        memory = (
            "" if self.memory_bytes != self.memory_bytes else f"; {in_words(self.memory_bytes)} of memory"
        )
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


def forecast(
    measurement: Measurement,
    calibration: Calibration,
    options: ReconstructionOptions,
    on_stage: Stage | None = None,
) -> Forecast:
    """Carry out the first iterations of a reconstruction, or all where that is soon; tell what all takes.

    ``on_stage`` and errors as of :func:`~recon.reconstruction.reconstruct.reconstruct`.
    """
    tell = on_stage or (lambda *_: None)
    soon_s = SOLVED_S / (1 + REPEATS * options.uncertainty)
    one_step = options.solver != "auto" and SOLVERS.named(options.solver).one_step
    tried = options if one_step else limited(options, None, soon_s)
    trial = Trial.of(measurement, calibration, tried, lambda s, w: tell(s / 2, w))
    cut = trial.cut_short(tried, options)
    if cut and trial.longest < TRIED:
        tried = limited(options, TRIED, TRIED_S)
        further = Trial.of(measurement, calibration, tried, lambda s, w: tell((1 + s) / 2, w))
        trial = replace(further, memory_bytes=max(trial.memory_bytes, further.memory_bytes))
        cut = trial.cut_short(tried, options)
    count = trial.longest
    if not cut:
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
class Trial:
    """A reconstruction that was carried out, or its first iterations, and what it took."""

    found: Reconstruction
    seconds: float
    memory_bytes: float
    counted: int
    """Iterations of all runs, those of rounds whose result was not taken too."""

    @classmethod
    def of(
        cls,
        measurement: Measurement,
        calibration: Calibration,
        options: ReconstructionOptions,
        on_stage: Stage,
    ) -> Self:
        """Carry it out; errors as :func:`~recon.reconstruction.reconstruct.reconstruct`."""
        counted = 0

        def note(_record: IterationRecord, _now: Callable[[], Any]) -> None:
            nonlocal counted
            counted += 1

        meter, began = MemoryMeter(), time.perf_counter()
        found = reconstruct(measurement, calibration, options, on_progress=note, on_stage=on_stage)
        return cls(found, time.perf_counter() - began, meter.peak_mib() * 2**20, counted)

    @property
    def longest(self) -> int:
        """Iterations of the longest run."""
        return max(map(len, self.found.histories), default=0)

    @property
    def iteration_s(self) -> float:
        """What an iteration of all channels takes."""
        runs = [history for history in self.found.histories if len(history) > _UNCOUNTED]
        return sum((r[-1].seconds - r[_UNCOUNTED - 1].seconds) / (len(r) - _UNCOUNTED) for r in runs)

    def cut_short(self, tried: ReconstructionOptions, options: ReconstructionOptions) -> bool:
        """Whether it would have gone on by its options, without the limits of what was tried."""
        reasons = self.found.stop_reasons
        counted_out = StopReason.ITERATIONS in reasons and tried.iterations != most_iterations(options)
        return counted_out or (StopReason.TIME in reasons and tried.time_s != options.time_s)

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
    found: Reconstruction, measurement: Measurement, calibration: Calibration, options: ReconstructionOptions
) -> float:
    """Return the change an iteration at which a reconstruction settles."""
    if found.choice is not None:
        return found.choice.tolerance
    return Problem.of(measurement, calibration, options).stop_tolerance
