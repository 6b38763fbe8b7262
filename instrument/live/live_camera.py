"""The camera running for somebody to look at: its newest frame, its rates, what it lost."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.camera import Camera
from drivers.common.stream import FrameStream
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.frame import Frame
from instrument.bench.safety import note_failures
from instrument.live.frame_view import Counts

_BUFFERS = 8
"""Enough for a viewer and a preview that hold a frame each while others come."""
_RATE_WINDOW_S = 2.0


@dataclass(frozen=True, slots=True)
class LiveCameraStatus:
    """How the camera is doing."""

    running: bool
    frames_per_s: float
    """Of the camera, over the last two seconds; zero before the second frame."""
    acquired: int
    dropped: int
    """``acquired`` and ``dropped``: frames that came, and that the device or its driver lost, since the view
    was started first."""


class LiveCamera:
    """Runs a camera's stream and gives its newest frame to whoever asks; never a queue.

    Callable from any thread; ``start``, ``stop`` and ``paused`` talk to the camera and block.
    """

    def __init__(self, camera: Camera | None) -> None:
        self._camera = camera
        """None: a bench without one, whose view is never started."""
        self._changing = threading.RLock()
        self._stream: FrameStream | None = None
        self._acquired_before = self._dropped_before = 0
        self._elsewhere: Callable[[], Frame | None] | None = None
        self._history: deque[tuple[float, int]] = deque()
        self._counting = threading.Lock()
        """Held for microseconds, unlike ``_changing``: an end clears what a window's thread counts."""

    def start(self) -> None:
        """Start the camera's sequence; does nothing where it runs.

        Raises DeviceError when the camera refuses or is gone.
        """
        with self._changing:
            if self.is_running:
                return
            self.stop()
            assert self._camera is not None
            stream = FrameStream(self._camera, _BUFFERS)
            self._coarse_first(True)
            stream.start()
            self._stream = stream

    def stop(self) -> None:
        """End the sequence; does nothing without one."""
        with self._changing:
            stream = self._stream
            self._coarse_first(False)
            if stream is not None:
                try:
                    stream.close()
                finally:
                    with self._counting:  # each frame is counted once: by its stream, then here
                        self._stream = None
                        self._acquired_before += stream.acquired
                        self._dropped_before += stream.dropped
                        self._history.clear()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Keep the camera idle for a block (a photograph, a change of its region), then go on as before.

        Where the block failed, that stays the error, whatever keeps the camera from going on.
        """
        with self._changing:
            was_running = self.is_running
            self.stop()
            try:
                yield
            except BaseException as error:
                try:
                    if was_running:
                        self.start()
                except DeviceError as failure:
                    note_failures(error, failure)
                raise
            if was_running:
                self.start()

    @property
    def is_running(self) -> bool:
        """Whether frames are coming."""
        stream = self._stream
        return stream is not None and stream.is_running

    @property
    def stream(self) -> FrameStream | None:
        """The stream that runs now, for other readers; another one after each pause."""
        stream = self._stream
        return stream if stream is not None and stream.is_running else None

    @property
    def error(self) -> DeviceError | None:
        """What ended the stream, if it was not ``stop``."""
        stream = self._stream
        return None if stream is None else stream.error

    @property
    def hangs(self) -> DeviceTimeoutError | None:
        """That the stream's driver has not come back from waiting for a frame: nobody here waits with it."""
        try:
            if (stream := self.stream) is not None:
                stream.require_answer()
        except DeviceTimeoutError as error:
            return error
        return None

    @contextmanager
    def watching(self, newest: Callable[[], Frame | None]) -> Iterator[None]:
        """For a block that uses the camera otherwise (a run, a recording), show what that has newest."""
        self._elsewhere = newest
        try:
            yield
        finally:
            self._elsewhere = None

    def newest(self) -> Frame | None:
        """Return the newest frame, at once; None where nothing runs or came yet."""
        elsewhere = self._elsewhere
        if elsewhere is not None:
            return elsewhere()
        stream = self._stream
        return None if stream is None else stream.newest()

    def coarse(self) -> tuple[Counts, int] | None:
        """Return what the next frame will show, coarsely, and how many of its pixels a side are one.

        Only a simulated camera can tell, and only while it computes light for seconds: None from any other.
        """
        coarse: Callable[[], tuple[Counts, int] | None] | None = getattr(self._camera, "coarse", None)
        return None if coarse is None or not self.is_running else coarse()

    def _coarse_first(self, on: bool) -> None:
        """Have a simulated camera compute light coarsely first, or not: a run has nobody who looks."""
        if hasattr(self._camera, "coarse_first"):
            setattr(self._camera, "coarse_first", on)  # noqa: B010 - of its driver, not of every camera

    def status(self) -> LiveCameraStatus:
        """Return rates and losses; meant to be asked a few times a second."""
        with self._counting:
            stream = self._stream
            acquired = self._acquired_before + (stream.acquired if stream else 0)
            dropped = self._dropped_before + (stream.dropped if stream else 0)
            now_s = time.monotonic()
            history = self._history
            history.append((now_s, acquired))
            while len(history) > 2 and now_s - history[0][0] > _RATE_WINDOW_S:
                history.popleft()
            seconds = now_s - history[0][0]
            rate = (acquired - history[0][1]) / seconds if seconds > 0 else 0.0
        return LiveCameraStatus(self.is_running, rate, acquired, dropped)
