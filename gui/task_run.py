"""A task that is carried out for a panel: its desk in the job's thread, started, paused, ended; looked at."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

from PySide6.QtCore import QObject, Signal

from gui.jobs import Job, JobContext, JobRunner
from gui.procedure_run import Situation
from gui.widgets.building import every
from instrument.files.orientation import AS_IT_IS, Kind, Orientation
from instrument.tasks.task import Advance, Desk, Done

_LOOK_MS = 100


@dataclass(frozen=True, slots=True)
class Told:
    """A sentence, a warning or a table of a task.

    Attributes
    ----------
    kind : "say", "warn" or "table"
    text : str
        Of a table its title.
    headings, rows : sequences of str
        Of a table.
    """

    kind: Literal["say", "warn", "table"]
    text: str
    headings: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


class WindowDesk(Desk):
    """Keeps what a task tells, in the job's thread, until the window fetches it; lets the task wait.

    Nothing is locked: a task that tells often would keep the window waiting for its turn. What is handed over
    is handed over in one step.
    """

    def __init__(self, context: JobContext, seen: Mapping[Kind, Orientation]) -> None:
        self._context = context
        self._seen = seen
        self._told: deque[Told] = deque()
        self._situation = Situation()
        self._go_on = threading.Event()
        self._go_on.set()
        self._keeps = False
        """Whether the task ends by itself where it is cancelled, and keeps what there is."""
        context.on_cancel(self._go_on.set)

    # In the job's thread -------------------------------------------------------------------------
    def say(self, text: str) -> None:
        """Keep it; where nothing tells how far it is, this is where it waits and ends."""
        self._tell(Told("say", text))
        self._wait()

    def warn(self, text: str) -> None:
        """Keep it."""
        self._tell(Told("warn", text))

    def table(self, headings: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
        """Keep it; wait and end as in ``say``."""
        self._tell(Told("table", title, tuple(headings), tuple(map(tuple, rows))))
        self._wait()

    @contextmanager
    def step(self, what: str, total: float | None = None, *, done: int = 0) -> Iterator[Advance]:
        """Show a step; whoever advances it waits while it is paused."""
        began_s, words, whole, first = time.monotonic(), what, total, done
        self._show(Situation(step=what, done=done, total=total or 0.0))

        def advance(done: float, total: float | None = None, *, note: str | None = None) -> None:
            nonlocal whole, words
            whole = total if total is not None else whole
            words = f"{what}: {note}" if note else words
            spent_s = time.monotonic() - began_s
            left = spent_s * (whole - done) / (done - first) if whole and done > first else None
            self._show(Situation(step=words, done=done, total=whole or 0.0, seconds_left=left))
            self._wait()

        yield advance
        self._wait()

    def seen(self, kind: Kind) -> Orientation:
        """Return how the window turned pictures of a kind when the task was started."""
        return self._seen.get(kind, AS_IT_IS)

    @contextmanager
    def interruptible(self) -> Iterator[threading.Event]:
        """Give the job's own event."""
        before, self._keeps = self._keeps, True
        try:
            yield self._context.cancel
        finally:
            self._keeps = before

    def _tell(self, told: Told) -> None:
        self._told.append(told)

    def _show(self, situation: Situation) -> None:
        self._situation = situation

    def _wait(self) -> None:
        self._go_on.wait()
        if not self._keeps:
            self._context.check()

    # In the window's thread ----------------------------------------------------------------------
    @property
    def situation(self) -> Situation:
        """How it goes on."""
        return replace(self._situation, paused=not self._go_on.is_set())

    def fetch(self) -> list[Told]:
        """Return what was told since it was fetched last."""
        return [self._told.popleft() for _ in range(len(self._told))]

    def pause(self, on: bool) -> None:
        """Let it wait where it next tells how far it is, or go on; what is ended does not wait."""
        (self._go_on.clear if on and not self._context.cancel.is_set() else self._go_on.set)()


class TaskRun(QObject):
    """Carries out one task after the other in jobs of their own.

    Signals
    -------
    looked : Situation
        Ten times a second while it goes on.
    told : Told
    succeeded : Done
    ended_early : str
        Somebody ended it; what is left, in words.
    failed : str
    over
        After one of these three.
    """

    looked = Signal(object)
    told = Signal(object)
    succeeded = Signal(object)
    ended_early = Signal(str)
    failed = Signal(str)
    over = Signal()

    def __init__(self, jobs: JobRunner, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._jobs = jobs
        self._job: Job | None = None
        self._desk: WindowDesk | None = None
        self._held = False
        """Whether it is to wait, also where its job has not begun yet."""
        self._holding = threading.Lock()
        self._timer = every(self, _LOOK_MS, self._look)
        self._timer.stop()

    @property
    def is_running(self) -> bool:
        """Whether a task goes on."""
        return self._job is not None

    def start(
        self, title: str, do: Callable[[Desk], Done], seen: Mapping[Kind, Orientation] | None = None
    ) -> Job:
        """Carry out a task, in a job; ``seen``: how pictures are turned now."""

        def work(context: JobContext) -> Done:
            desk = WindowDesk(context, seen or {})
            with self._holding:
                self._desk = desk
                desk.pause(self._held)
            return do(desk)

        self._desk, self._held = None, False
        self._job = job = self._jobs.compute(title, work)
        job.succeeded.connect(self._succeeded)
        job.failed.connect(lambda why: self._end(self.failed, why))
        job.cancelled.connect(lambda words: self._end(self.ended_early, words))
        job.ended.connect(self._over)
        self._timer.start()
        return job

    def pause(self) -> None:
        """Let it wait where it next tells how far it is."""
        self._hold(True)

    def resume(self) -> None:
        """Go on."""
        self._hold(False)

    def _hold(self, on: bool) -> None:
        with self._holding:
            self._held = on
            if self._desk is not None:
                self._desk.pause(on)

    def abort(self) -> None:
        """End it as soon as it can; what can be kept is kept."""
        if self._job is not None:
            self._job.cancel()

    def _look(self) -> None:
        if self._desk is not None:
            for told in self._desk.fetch():
                self.told.emit(told)
            self.looked.emit(self._desk.situation)

    def _succeeded(self, done: Done) -> None:
        self._end(self.succeeded, done)

    def _end(self, how: object, what: object) -> None:
        self._look()
        how.emit(what)  # type: ignore[attr-defined]

    def _over(self) -> None:
        self._timer.stop()
        self._job = None
        self.over.emit()
