"""Those who read a stream: at their own pace, each with its own account of what it missed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from drivers.errors import DeviceError
from drivers.frame import Frame

if TYPE_CHECKING:
    from drivers.common.stream import FrameStream, Slot


_POLL_S = 1.0


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """Where every frame of a stream went, as one reader sees it since it began.

    ``acquired == delivered + overwritten + waiting`` at any moment; the camera exposed
    ``acquired + dropped_by_device`` frames.

    Attributes
    ----------
    acquired : int
        Frames that came out of the driver.
    delivered : int
        Frames that the reader got.
    overwritten : int
        Frames that the reader was too slow for: they left the ring before it asked, or found no free buffer.
    waiting : int
        Frames in the ring that the reader has yet to get.
    dropped_by_device : int
        Frames that the device or its driver lost, by its own count.
    """

    acquired: int
    delivered: int
    overwritten: int
    waiting: int
    dropped_by_device: int


class Missed(NamedTuple):
    """Frames between one that a reader got and the one before."""

    by_device: int
    """Lost by the device or its driver."""
    overwritten: int
    """Lost in the ring, because the reader was too slow."""


class StreamReader:
    """Gets every frame of a stream in order, from the moment it is made, and knows what it missed.

    Made by :meth:`drivers.common.stream.FrameStream.reader`; for one thread. ``missed`` says what lies
    between the last frame got and the one before.
    """

    def __init__(self, stream: FrameStream) -> None:
        self._stream = stream
        with stream.changed:
            self._first = self._next = stream.acquired
            self._dropped_at_start = stream.dropped
            self._number = stream.acquired - 1
            self._position = self._number + stream.dropped
        self._delivered = 0
        self.missed = Missed(0, 0)

    @property
    def is_running(self) -> bool:
        """Whether more frames may come."""
        return self._stream.is_running

    def next_frame(self, timeout_s: float | None = None) -> Frame | None:
        """Return the oldest frame not yet got; None when the stream has ended or ``timeout_s`` is over.

        The frame's ``dropped_before`` counts all frames between it and the one got before: lost by the
        device, or missed by this reader.

        Raises DeviceError when the camera failed, DeviceTimeoutError when its driver hangs; frames that came
        before are returned first.
        """
        stream = self._stream
        with stream.changed:
            while not stream.changed.wait_for(
                lambda: not stream.is_running or self._oldest() is not None,
                _POLL_S if timeout_s is None else timeout_s,
            ):
                stream.require_answer()
                if timeout_s is not None:
                    break
            slot = self._oldest()
            if slot is None:
                if stream.error is not None:
                    raise stream.error
                return None
            overwritten = slot.number - self._number - 1
            self.missed = Missed(slot.position - self._position - 1 - overwritten, overwritten)
            self._number, self._position = slot.number, slot.position
            self._next = slot.number + 1
            self._delivered += 1
        if sum(self.missed) == slot.frame.metadata.dropped_before:
            return slot.frame
        return Frame(slot.frame.image, replace(slot.frame.metadata, dropped_before=sum(self.missed)))

    def skip_to_newest(self) -> None:
        """Pass over all waiting frames but the newest; they count as overwritten."""
        with self._stream.changed:
            if self._stream.ring:
                self._next = max(self._next, self._stream.ring[-1].number)

    @property
    def status(self) -> StreamStatus:
        """Where every frame went since this reader was made."""
        stream = self._stream
        with stream.changed:
            acquired = stream.acquired - self._first
            waiting = sum(slot.number >= self._next for slot in stream.ring)
            return StreamStatus(
                acquired=acquired,
                delivered=self._delivered,
                overwritten=acquired - self._delivered - waiting,
                waiting=waiting,
                dropped_by_device=stream.dropped - self._dropped_at_start,
            )

    def _oldest(self) -> Slot | None:
        return next((slot for slot in self._stream.ring if slot.number >= self._next), None)


class Subscription:
    """A callback that gets a stream's frames in a thread of its own.

    Made by :meth:`drivers.common.stream.FrameStream.subscribe`.
    """

    def __init__(self, stream: FrameStream, callback: Callable[[Frame], None], newest_only: bool) -> None:
        self._reader = StreamReader(stream)
        self._callback = callback
        self._newest_only = newest_only
        self._cancelled = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="stream callback", daemon=True)
        self._thread.start()

    @property
    def status(self) -> StreamStatus:
        """Where every frame went since the subscription began."""
        return self._reader.status

    def cancel(self) -> None:
        """End the subscription after the frame that the callback is at."""
        self._cancelled = True

    def join(self) -> Exception | None:
        """Wait for the thread's end; returns what the callback raised."""
        if self._thread is not threading.current_thread():
            self._thread.join()
        return self._error

    def _run(self) -> None:
        try:
            while not self._cancelled:
                if self._newest_only:
                    self._reader.skip_to_newest()
                frame = self._reader.next_frame()
                if frame is None:
                    return
                self._callback(frame)
        except DeviceError:
            return  # the stream's own failure, which its other readers raise
        except Exception as error:  # noqa: BLE001 - kept for the stream's close to raise
            self._error = error
