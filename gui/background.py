"""Work beside the window: files read in quiet jobs, and a live reconstruction on whatever stream runs."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from PySide6.QtCore import QObject
from shiboken6 import isValid

from drivers.common.stream import FrameStream
from drivers.errors import DeviceError
from drivers.frame import FrameMetadata
from gui.jobs import Job, JobRunner
from instrument.files.errors import BenchError, in_words
from instrument.live.live import LiveResult, LiveStatus, LiveView
from instrument.live.live_camera import LiveCamera
from recon.errors import InputError
from recon.streams.live import LiveReconstructor

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


class LiveFollower:
    """Starts a :class:`LiveView` on each new stream of a camera: regions, runs, reconnections make new ones.

    Nothing here blocks but for ``stop``, which waits for the picture in progress and may be called from any
    thread; until it is done nothing else is begun: a reconstructor is used by one thread at a time.

    Parameters
    ----------
    camera : LiveCamera
    lit : callable
        Whether something was lit during a frame; asked from the view's thread.
    """

    def __init__(self, camera: LiveCamera, lit: Callable[[FrameMetadata], bool]) -> None:
        self._camera, self._lit = camera, lit
        self._view: LiveView | None = None
        self._stream: FrameStream | None = None
        self._shape: tuple[int, ...] = ()
        self._changing = threading.Lock()
        """Held while a view is begun or ended."""
        self.reconstructor: LiveReconstructor | None = None
        self.problem = ""
        """Why there are no pictures, in words."""

    def use(self, reconstructor: LiveReconstructor | None) -> None:
        """Take another reconstructor from the next ``follow`` on; the view before must have been stopped."""
        self.reconstructor = reconstructor
        self._stream = None
        self.problem = ""

    def follow(self) -> None:
        """Begin on a new stream or with another reconstructor; to be called now and then."""
        if not self._changing.acquire(blocking=False):
            return  # a view is being ended: next time
        try:
            self._follow()
        finally:
            self._changing.release()

    def _follow(self) -> None:
        view = self._view
        if view is not None and view.reconstructor is not self.reconstructor:
            view.end()
        if view is not None and not view.is_running:
            self._view = None
            self._close(view)
        stream = self._camera.stream
        if self._view is None and self.reconstructor is not None and stream not in (None, self._stream):
            assert stream is not None
            self._stream = stream
            self.problem = ""
            shape = stream.frame_shape
            if shape != self._shape:
                self.reconstructor.restart()
                self._shape = shape
            self._view = LiveView(stream, self.reconstructor, self._lit).start()

    def newest(self) -> LiveResult | None:
        """Return the newest picture; None before the first."""
        return None if self._view is None else self._view.newest()

    @property
    def is_following(self) -> bool:
        """Whether a view was begun and not yet ended."""
        return self._view is not None

    @property
    def status(self) -> LiveStatus | None:
        """How it does; None while nothing runs."""
        return None if self._view is None else self._view.status

    def end(self) -> None:
        """Ask the view to end after the picture in progress; returns at once."""
        if (view := self._view) is not None:
            view.end()

    def stop(self) -> None:
        """End the view and wait for the picture in progress."""
        with self._changing:
            view, self._view, self._stream = self._view, None, None
            if view is not None:
                self._close(view)

    def _close(self, view: LiveView) -> None:
        try:
            view.close()
        except (DeviceError, BenchError, InputError) as error:
            self.problem = in_words(error) or str(error)
