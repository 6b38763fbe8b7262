"""What a reconstruction will take, time and memory, by its first iterations: tried before, or its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from instrument.files.errors import duration
from recon.reconstruction.course import TOLD_AT
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.reconstruct import reconstruct
from recon.reconstruction.solve import ITERATIONS
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.base import IterationRecord
from recon.solvers.memory import MemoryMeter, in_words
from recon.types import Calibration

TRIED = 6
"""Iterations that are run to tell what each takes; the first ones are slower and do not count."""
_UNCOUNTED = 2
WORTH_BYTES = 2**20
"""Memory that is told: less was there already."""


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
    """

    beside_s: float
    iteration_s: float
    iterations: int
    memory_bytes: float
    time_s: float | None = None

    @property
    def seconds(self) -> float:
        """All of it, at most."""
        solving = self.iterations * self.iteration_s
        return self.beside_s + (solving if self.time_s is None else min(solving, self.time_s))

    def __str__(self) -> str:
        """Say it in a line."""
        each = f", {1e3 * self.iteration_s:.3g} ms an iteration" if self.iterations else ""
        memory = (
            "" if self.memory_bytes != self.memory_bytes else f"; {in_words(self.memory_bytes)} of memory"
        )
        return f"at most {duration(self.seconds)}{each} ({TRIED} were tried){memory}"


class Foretold:
    """Tells once, early in a reconstruction, what all of it will take.

    Its ``watch`` and ``stage`` are called with what the reconstruction tells
    (:func:`recon.reconstruction.reconstruct.reconstruct`); made before it begins.

    Parameters
    ----------
    tell : callable
        ``tell(words)``, once: ``"about 12.0 s in all; 340 MiB of memory so far"``.
    """

    def __init__(self, tell: Callable[[str], object]) -> None:
        self._tell, self._iterations, self._told = tell, 0, False
        self._began, self._meter = time.perf_counter(), MemoryMeter()
        self.seconds = self.memory_bytes = float("nan")

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
        memory = (
            f"; {in_words(self.memory_bytes)} of memory so far" if self.memory_bytes >= WORTH_BYTES else ""
        )
        self._tell(f"about {duration(self.seconds)} in all{memory}")


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
    return Forecast(
        max(spent - len(records) * each / max(len(runs), 1), 0.0), each, count, memory, options.time_s
    )
