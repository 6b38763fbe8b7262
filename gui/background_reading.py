"""Reading in the background: of several things asked for in quick succession, only the newest."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from PySide6.QtCore import QObject, Qt, Signal

from gui.jobs import Job, JobRunner
from instrument.files.errors import FileError
from instrument.files.volumes import Plane, VolumeSource

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


Axis = Literal["z", "y", "x"]


@dataclass(frozen=True, slots=True)
class Slice:
    """A slice that was read."""

    axis: Axis
    index: int
    pixels: Plane


class SliceReader(QObject):
    """A thread that reads what was asked for last along each axis.

    Signals, in the thread of the window
    ------------------------------------
    arrived : Slice
    failed : str
    """

    arrived = Signal(object)
    failed = Signal(str)
    _from_thread = Signal(object)

    def __init__(self, source: VolumeSource, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._source = source
        self._wanted: dict[Axis, int] = {}
        self._wake = threading.Condition()
        self._ending = False
        self._from_thread.connect(self._receive, Qt.ConnectionType.QueuedConnection)
        self._thread = threading.Thread(target=self._read, name="volume slices", daemon=True)
        self._thread.start()

    def ask(self, axis: Axis, index: int) -> None:
        """Ask for a slice; an older request along the same axis that was not begun is forgotten."""
        with self._wake:
            self._wanted[axis] = index
            self._wake.notify()

    def end(self) -> None:
        """End the thread, which closes the volume when the slice in progress is read; returns at once."""
        with self._wake:
            self._ending = True
            self._wake.notify()

    def _read(self) -> None:
        try:
            self._read_until_the_end()
        finally:
            self._source.close()

    def _read_until_the_end(self) -> None:
        while True:
            with self._wake:
                while not (self._wanted or self._ending):
                    self._wake.wait()
                if self._ending:
                    return
                axis, index = next(iter(self._wanted.items()))
                del self._wanted[axis]
            reading = {"z": self._source.plane, "y": self._source.across_y, "x": self._source.across_x}
            with contextlib.suppress(RuntimeError):  # the window is gone: nobody is there to be told
                try:
                    self._from_thread.emit(Slice(axis, index, reading[axis](index)))
                except FileError as error:
                    self._from_thread.emit(str(error))

    def _receive(self, what: Slice | str) -> None:
        if isinstance(what, str):
            self.failed.emit(what)
        else:
            self.arrived.emit(what)
