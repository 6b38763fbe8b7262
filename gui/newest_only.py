"""Files read in jobs: of several asked for in quick succession only the newest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gui.jobs import Job, JobRunner

Read = Callable[[], Any]
Done = Callable[[Any], object]


class NewestOnly:
    """Reads one thing at a time, in quiet jobs; a request that was not begun gives way to a newer one.

    What was read while something newer was asked for is shown all the same, so that a slider that is pulled
    shows something, unless ``forget`` came in between.

    Parameters
    ----------
    jobs : JobRunner
    title : str
    """

    def __init__(self, jobs: JobRunner, title: str) -> None:
        self._jobs = jobs
        self._title = title
        self._job: Job | None = None
        self._wanted: tuple[Read, Done] | None = None
        self._epoch = 0

    def ask(self, read: Read, done: Done) -> None:
        """Have ``read`` called in a job's thread, then ``done`` with its result in the window's."""
        self._wanted = (read, done)
        if self._job is None:
            self._begin()

    def forget(self) -> None:
        """Drop what was asked for, begun or not."""
        self._wanted = None
        self._epoch += 1

    def _begin(self) -> None:
        if self._wanted is None:
            return
        (read, done), self._wanted, epoch = self._wanted, None, self._epoch
        self._job = job = self._jobs.compute(self._title, lambda _: read())
        job.quiet = True
        job.succeeded.connect(lambda value: done(value) if epoch == self._epoch else None)
        job.ended.connect(self._ended)

    def _ended(self) -> None:
        self._job = None
        self._begin()
