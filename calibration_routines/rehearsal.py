"""How long a routine takes in all before its first run: it is carried out on a simulated bench of its own."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING, Any

from calibration_routines.procedure import Listener
from calibration_routines.routine import Routine
from calibration_routines.times import IN_ALL
from drivers.errors import DeviceError
from instrument.files.errors import BenchError, duration
from instrument.runs.acquire import time_scale
from instrument.runs.rehearsal import not_waited_s, twin_of
from instrument.runs.run_control import RunControl

if TYPE_CHECKING:
    from instrument.bench.bench import Bench
    from instrument.runs.runner import RunStatus

ENOUGH_S = 20.0
"""After so many seconds a rehearsal ends in the next step of which as much is left, by its share."""
_PARTS = 5
"""Of a step, before that is judged: one of two or three that is slow would stand for all."""
_OF_SEVERAL = re.compile(r"\s*(\d+) of (\d+)$")


def rehearse_whole(
    routine: Routine,
    options: Any,
    bench: Bench,
    on_progress: Callable[[float, float], object],
    work: Sequence[tuple[str, float]] = (),
) -> tuple[str, ...]:
    """Say how long a routine takes on a simulated bench: homing, exposures, frames, analysis, files.

    All of it is done on a bench like the open one that waits for nothing; what waiting would take is added,
    and what kernels took to compile, which are there from then on, is taken off. A long one is ended on the
    way, and told by how far it came; what follows by its ``work`` (:class:`Outlook`), as quickly as the work
    was computed that was done or told up to there: what waited is no such work. ``on_progress`` gets the
    seconds that it has gone on and :data:`ENOUGH_S`. Nothing where a device is not simulated, where frames
    that were kept are seen again, and where it cannot be done there.
    """
    if getattr(options, "again", None) is not None:
        return ()
    with suppress(BenchError, DeviceError), twin_of(bench) as made:
        if made is None:
            return ()
        twin, folder = made
        if getattr(options, "out", None) is not None:
            options = replace(options, out=folder / options.out.name)
        procedure, control = routine.procedure(options), RunControl()
        watch = _Watch(control, lambda: time_scale(bench) * not_waited_s(twin), on_progress, work)
        try:
            with watch.compiling(), control.procedure(twin):
                procedure.perform(twin, folder, control, watch)
        except BenchError:
            if control.ending is None:
                raise
        return (watch.words(),)
    return ()


class _Watch(Listener):
    """Takes the time of the steps; ends a rehearsal that has gone on for long enough."""

    def __init__(
        self,
        control: RunControl,
        waiting_s: Callable[[], float],
        on_progress: Callable[[float, float], object],
        work: Sequence[tuple[str, float]],
    ) -> None:
        self._control, self._waiting_s, self._on_progress = control, waiting_s, on_progress
        self._work, self._works_since_s = list(work), 0.0
        self._began_s = time.perf_counter()
        self._step = ""
        self._done, self._total, self._at_most, self._several = 0.0, 0.0, False, False
        self._paces_s: list[tuple[float, float]] = []
        self._seen_s = (0.0, 0.0)
        self._compiled_s, self._compiling, self._compiles_since_s = 0.0, 0, 0.0

    @contextmanager
    def compiling(self) -> Iterator[None]:
        """Note how long kernels are compiled in this context, those within others once."""
        from numba.core import event

        watch = self

        class Compiles(event.Listener):
            def on_start(self, event: object) -> None:
                if watch._compiling == 0:
                    watch._compiles_since_s = time.perf_counter()
                watch._compiling += 1

            def on_end(self, event: object) -> None:
                watch._compiling -= 1
                if watch._compiling == 0:
                    watch._compiled_s += time.perf_counter() - watch._compiles_since_s

        with event.install_listener("numba:compile", Compiles()):
            yield

    def _now_s(self) -> tuple[float, float]:
        """Return the seconds so far: computed and waited, and those of computing alone."""
        computed_s = time.perf_counter() - self._began_s - self._compiled_s
        return computed_s + self._waiting_s(), computed_s

    def step(self, words: str) -> None:
        """Begin another step; of several alike, as slides are, they are counted and not their frames."""
        several = _OF_SEVERAL.search(words)
        name = words[: several.start()] if several else words
        if name != self._step:
            self._step = name
            self._done = self._total = 0.0
            self._paces_s = []
            if self._work and name == self._work[0][0]:
                self._works_since_s = self._now_s()[1]
        self._several = several is not None
        if several is not None:
            self._see(int(several[1]) - 1, int(several[2]), at_most=False)

    def frame(self, status: RunStatus) -> None:
        """Count the frames of a plan."""
        self.share(status.done, status.total)

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        """Note how much of a step is done."""
        if not self._several:
            self._see(done, total, at_most=at_most)

    def _see(self, done: float, total: float, *, at_most: bool) -> None:
        seconds = time.perf_counter() - self._began_s
        self._on_progress(min(seconds, ENOUGH_S), ENOUGH_S)
        if self._control.ending is None:
            now_s = self._now_s()
            if 0 < self._done < done:
                part = done - self._done
                took_s, computing_s = (now - seen for now, seen in zip(now_s, self._seen_s, strict=True))
                self._paces_s.append((took_s / part, computing_s / part))
            self._done, self._total, self._at_most, self._seen_s = done, total, at_most, now_s
            if seconds > ENOUGH_S and len(self._paces_s) >= _PARTS and self._left_s()[0] > ENOUGH_S:
                self._control.abort()

    def _left_s(self) -> tuple[float, float]:
        """Return what is left of the step, as ``_now_s``: as most parts were; one may load and compile."""
        took_s, computing_s = (median(paces) for paces in zip(*self._paces_s, strict=True))
        left = self._total - self._done
        return took_s * left, computing_s * left

    def words(self) -> str:
        """Say how long all of it takes, or what it was told by."""
        if self._control.ending is None:
            return (
                f"{IN_ALL}by a rehearsal on a simulated bench of its own: about {duration(self._now_s()[0])}."
            )
        most = "at most " if self._at_most else "about "
        end_s, computed_s = (seen + left for seen, left in zip(self._seen_s, self._left_s(), strict=True))
        step, share = f'"{self._step}"', f"by a rehearsal up to {max(0.01, self._done / self._total):.0%} of"
        if (following_s := self._following_s(computed_s)) is not None:
            whole = duration(end_s + following_s)
            sizes = "" if self._step == self._work[-1][0] else " and the sizes of what follows"
            return f"{IN_ALL}{share} {step}{sizes}: {most}{whole}."
        return f"Up to the end of {step}, {share} it: {most}{duration(end_s)}. What follows it comes on top."

    def _following_s(self, computed_s: float) -> float | None:
        """Return what follows a step, as quick as work was so far without waiting; None: not known."""
        steps = [step for step, _ in self._work]
        if self._step not in steps:
            return None
        following = steps.index(self._step) + 1
        done, left = (sum(w for _, w in part) for part in (self._work[:following], self._work[following:]))
        return (computed_s - self._works_since_s) * left / done
