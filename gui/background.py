"""Work beside the window: files read in quiet jobs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from PySide6.QtCore import QObject
from shiboken6 import isValid

from gui.jobs import Job, JobRunner

Read = Callable[[], Any]
Done = Callable[[Any], object]


class NewestOnly:
    """Reads one thing at a time, in quiet jobs; what was not begun gives way to a newer one of its kind.

    What was read while something newer was asked for is shown all the same, so that a slider that is pulled
    shows something, unless ``forget`` came in between.

    Parameters
    ----------
    jobs : JobRunner
    title : str
    failed : callable, optional
        Called with the reason, in words, where something could not be read.
    """

    def __init__(self, jobs: JobRunner, title: str, failed: Callable[[str], object] | None = None) -> None:
        self._jobs = jobs
        self._title = title
        self._failed = failed
        self._job: Job | None = None
        self._wanted: dict[str, tuple[Read, Done]] = {}
        self._last: list[Read] = []
        self._epoch = 0

    @property
    def is_reading(self) -> bool:
        """Whether something is being read."""
        return self._job is not None

    def ask(self, read: Read, done: Done, kind: str = "") -> None:
        """Have ``read`` called in a job's thread, then ``done`` with its result in the window's."""
        self._wanted[kind] = (read, done)
        if self._job is None:
            self._begin()

    def forget(self, last: Read | None = None) -> None:
        """Drop what was asked for, begun or not; ``last`` is called in a job's thread after what is read."""
        self._wanted.clear()
        self._epoch += 1
        if last is not None:
            self._last.append(last)
        if self._job is None:
            self._begin()

    def _begin(self) -> None:
        read: Read
        done: Done = lambda _: None  # noqa: E731 - what is read last is shown nowhere
        if self._last:  # never gives way: a file is closed by it
            read = self._last.pop(0)
        elif self._wanted:
            read, done = self._wanted.pop(next(iter(self._wanted)))
        else:
            return
        epoch = self._epoch
        self._job = job = self._jobs.watch(self._title, lambda _: read())
        job.succeeded.connect(lambda value: done(value) if self._is_awaited(epoch, done) else None)
        if (failed := self._failed) is not None:
            job.failed.connect(lambda why: failed(why) if self._is_awaited(epoch, failed) else None)
        job.ended.connect(self._ended)

    def _is_awaited(self, epoch: int, receiver: Callable[[Any], object]) -> bool:
        """Whether an answer is still wanted, and its receiver was not deleted with its window meanwhile."""
        owner = getattr(receiver, "__self__", None)
        return epoch == self._epoch and not (isinstance(owner, QObject) and not isValid(owner))

    def _ended(self) -> None:
        self._job = None
        self._begin()
