"""A live reconstruction on whatever stream runs."""

from __future__ import annotations

import threading
from collections.abc import Callable

from drivers.common.stream import FrameStream
from drivers.errors import DeviceError
from drivers.frame import FrameMetadata
from instrument.files.errors import BenchError, in_words
from instrument.live.live import LiveResult, LiveStatus, LiveView
from instrument.live.live_camera import LiveCamera
from recon.errors import InputError
from recon.streams.live import LiveReconstructor


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
