"""What a reconstruction takes, told while it runs: before it by the last like it, and early in it."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from math import log
from typing import Any, Self

from instrument.files import kept_times
from instrument.files.errors import duration
from instrument.reconstruction.job import Job
from recon.base.threads import get_threads
from recon.reconstruction.course import TOLD_AT
from recon.reconstruction.options import ReconstructionOptions
from recon.solvers.base import IterationRecord, StopReason
from recon.solvers.memory import MemoryMeter, in_words

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
