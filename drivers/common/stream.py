"""Continuous acquisition into a ring of buffers: all frames for who wants them, the newest for live views."""

from __future__ import annotations

import mmap
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from drivers.common.answers import CALL_MARGIN_S, STOP_ANSWER_S, Computed, within
from drivers.common.stream_reader import StreamReader, Subscription
from drivers.errors import DeviceError, DeviceTimeoutError, StoppedError
from drivers.frame import Frame

if TYPE_CHECKING:
    from drivers.camera import Camera


Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


class BufferPool:
    """``n_buffers`` preallocated images that are used again once nobody holds them.

    :meth:`take` gives an image over a free buffer. The buffer is free again when that image, and every
    array that was sliced or viewed from it, is gone: a consumer may keep an image as long as it likes and
    never sees it overwritten, it only keeps one buffer from the others.

    Parameters
    ----------
    n_buffers : int
    shape : tuple of int
        ``(height, width)`` or ``(height, width, 3)``.
    dtype
        uint8 or uint16.
    """

    def __init__(self, n_buffers: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._shape = shape
        self._dtype = np.dtype(dtype)
        n_bytes = int(np.prod(shape)) * self._dtype.itemsize
        self._memory = [mmap.mmap(-1, n_bytes) for _ in range(n_buffers)]
        for memory in self._memory:  # page faults now, not while streaming
            np.frombuffer(memory, np.uint8).fill(0)
        self._free: deque[int] = deque(range(n_buffers))

    @property
    def n_free(self) -> int:
        """Number of buffers that nobody holds."""
        return len(self._free)

    def take(self) -> Pixels | None:
        """Return a writeable image over a free buffer, or None when all are held."""
        try:
            number = self._free.popleft()
        except IndexError:
            return None
        # Arrays made from this one refer to it, and not to what lies under it, only because that is no array
        # (numpy's rule for a view's base). So its end is the end of everything that looks at the buffer.
        image: Pixels = np.ndarray(self._shape, self._dtype, buffer=self._memory[number])
        # Called in whatever thread lets go last, so it must not take a lock; append is atomic.
        weakref.finalize(image, self._free.append, number).atexit = False
        return image


_POLL_S = 0.25


class Slot(NamedTuple):
    """A frame in the ring."""

    number: int
    """Running number among the frames that came out of the driver."""
    position: int
    """Running number among the frames that the camera exposed: dropped ones count."""
    frame: Frame


class FrameStream:
    """A running sequence of a camera, read by one thread into a fixed ring of preallocated buffers.

    The thread never waits for a consumer: who is slow misses frames, and is told how many. Frames are
    read-only views of the ring's buffers; a buffer that somebody still holds is not used again, so a frame
    never changes, but who keeps more frames than the ring has buffers starves the stream (copy images that
    you keep).

    Use as a context manager, or iterate over it, which starts and ends it::

        for frame in camera.stream():
            ...

    Parameters
    ----------
    camera : Camera
        Open and not streaming.
    n_buffers : int
        Frames that the ring holds.
    """

    def __init__(self, camera: Camera, n_buffers: int = 16) -> None:
        if n_buffers < 3:
            raise ValueError(f"A stream needs at least 3 buffers, not {n_buffers}.")
        self.camera = camera
        self.n_buffers = n_buffers
        self.changed = threading.Condition()
        self.ring: deque[Slot] = deque()
        self.acquired = 0
        self.dropped = 0
        self.error: DeviceError | None = None
        self.frame_shape: tuple[int, ...] = ()
        """Of its frames, once it was started."""
        self._running = False
        self._thread: threading.Thread | None = None
        self._subscriptions: list[Subscription] = []
        self._asked_s: float | None = None
        self._answer_limit_s = 0.0

    # Starting and ending -------------------------------------------------------------------------
    def start(self) -> Self:
        """Start the camera's sequence.

        Raises DeviceError when it cannot be started, DeviceTimeoutError when its driver hangs.
        """
        if self._thread is not None:
            raise DeviceError(self.camera.name, "this stream has been started before.", "Make a new one.")
        self.frame_shape = shape = self.camera.frame_shape
        dtype = self.camera.frame_dtype
        # Two beyond the ring: one being filled, one for a reader that has just taken the oldest.
        self._pool = BufferPool(self.n_buffers + 2, shape, dtype)
        self._scratch: Pixels = np.empty(shape, dtype)
        self._answer_limit_s = self.camera.longest_wait_s + STOP_ANSWER_S
        start, stop = partial(self.camera.start_sequence, self.n_buffers), self.camera.stop_sequence
        # Begun late, or when Ctrl-C came, it does not run on.
        within(CALL_MARGIN_S, self.camera.name, "starting its sequence", start, undo=stop)
        self._running = True
        self._thread = threading.Thread(
            target=self._produce, name=f"stream of {self.camera.name}", daemon=True
        )
        self._thread.start()
        return self

    def close(self) -> None:
        """End the sequence and wait for the stream's threads; closing twice does nothing.

        The ring is let go of; frames that somebody holds stay as they are.

        Raises Exception: what a callback given to ``subscribe`` raised.
        """
        self._end()
        try:
            if self._thread is not None:
                name = self.camera.name
                within(STOP_ANSWER_S, name, "ending its sequence", self.camera.stop_sequence)
                if self._thread is not threading.current_thread():
                    within(STOP_ANSWER_S, name, "handing out a frame", self._thread.join)
        finally:  # a camera that hangs is given up, not its frames' readers
            subscriptions, self._subscriptions = self._subscriptions, []
            errors = [error for error in (s.join() for s in subscriptions) if error is not None]
            with self.changed:
                self.ring.clear()
        if errors:
            raise errors[0]

    def require_answer(self) -> None:
        """Refuse to wait on for a driver that hangs: its call for the next frame should long have returned.

        Raises DeviceTimeoutError.
        """
        asked_s = self._asked_s
        if asked_s is not None and time.monotonic() - asked_s > self._answer_limit_s:
            raise DeviceTimeoutError(
                self.camera.name,
                f"hangs: its driver has not come back from waiting for {self._answer_limit_s:g} s.",
                "Unplug it or switch it off and on, then start the program again.",
            )

    @property
    def is_running(self) -> bool:
        """Whether frames are coming."""
        return self._running

    def __enter__(self) -> Self:
        return self.start() if self._thread is None else self

    def __exit__(self, _type: object, error: BaseException | None, _traceback: object) -> None:
        try:
            self.close()
        except Exception as failure:
            if error is None or isinstance(error, StoppedError):
                raise
            error.add_note(str(failure))  # what came first tells more, and Ctrl-C is not taken for a failure

    # Getting frames ------------------------------------------------------------------------------
    def __iter__(self) -> Iterator[Frame]:
        """Yield every frame from now on; starts the stream, and ends it, if it was not running."""
        reader = self.reader()
        mine = self._thread is None
        if mine:
            self.start()
        try:
            while (frame := reader.next_frame()) is not None:
                yield frame
        finally:
            if mine:
                self.close()

    def reader(self) -> StreamReader:
        """Return a reader that gets every frame from now on; any number may read, each at its own pace.

        Made before ``start``, it gets the first frame too.
        """
        return StreamReader(self)

    def newest(self) -> Frame | None:
        """Return the newest frame, at once; None before the first."""
        with self.changed:
            return self.ring[-1].frame if self.ring else None

    def wait_newer(self, than: Frame | None, timeout_s: float) -> Frame | None:
        """Return the newest frame as soon as it is another than ``than``; None when none came in time."""
        with self.changed:
            self.changed.wait_for(
                lambda: not self._running or (bool(self.ring) and self.ring[-1].frame is not than), timeout_s
            )
            newest = self.ring[-1].frame if self.ring else None
        if self.error is not None:
            raise self.error
        if newest is not than:
            return newest
        self.require_answer()
        return None

    def fresh(self) -> Frame:
        """Return a frame that was exposed wholly after now: after a move, a change of light.

        As many frames are let go as can have been on their way: in the driver's buffers, between sensor and
        host (the camera's ``frames_in_flight``), and the one being exposed. Frames that were lost do not
        count: they may have been lost before. No clock is asked: where every frame lies in a buffer for a
        while, clocks call an old one new.

        Raises DeviceTimeoutError when the camera falls silent; StoppedError when the stream ends meanwhile.
        """
        reader = self.reader()
        for _ in range(self.n_buffers + self.camera.frames_in_flight + 1):
            self._next_of(reader)
        return self._next_of(reader)

    def _next_of(self, reader: StreamReader) -> Frame:
        computed = Computed(self.camera.computed_s)
        frame = reader.next_frame(self.camera.longest_wait_s)
        while frame is None and self._running and computed.went_on():
            frame = reader.next_frame(self.camera.longest_wait_s)
        if frame is None and self._running:
            raise DeviceTimeoutError(self.camera.name, "sent no frame while a fresh one was waited for.")
        if frame is None:
            raise StoppedError(self.camera.name, "the stream ended while a fresh frame was waited for.")
        return frame

    def subscribe(self, callback: Callable[[Frame], None], *, newest_only: bool = False) -> Subscription:
        """Have ``callback`` called with frames in a thread of its own, until the stream ends.

        Parameters
        ----------
        callback : callable
            What it raises ends its subscription, and is raised by ``close``.
        newest_only : bool
            Skip to the newest frame each time (live views); otherwise every frame that the callback is fast
            enough for.

        Raises DeviceError when the stream does not run: nothing would ever be handed out.
        """
        if not self._running:
            raise self.error or StoppedError(self.camera.name, "does not stream.", "Start the stream first.")
        subscription = Subscription(self, callback, newest_only)
        self._subscriptions.append(subscription)
        return subscription

    # The producer --------------------------------------------------------------------------------
    def _produce(self) -> None:
        silent_s = 0.0
        try:
            computed = Computed(self.camera.computed_s)
            while self._running:
                buffer = self._buffer()
                began_s = self._asked_s = time.monotonic()
                try:
                    metadata = self.camera.next_frame_into(
                        self._scratch if buffer is None else buffer, _POLL_S
                    )
                except DeviceTimeoutError as error:
                    silent_s = 0.0 if computed.went_on() else silent_s + time.monotonic() - began_s
                    limit_s = self.camera.longest_wait_s
                    if self.camera.trigger_mode == "free_run" and silent_s > limit_s:
                        raise DeviceTimeoutError(
                            error.device, f"has sent no frame for {silent_s:.1f} s.", error.remedy
                        ) from error
                    continue
                silent_s, self._asked_s = 0.0, None
                with self.changed:
                    self.dropped += metadata.dropped_before
                    if buffer is not None:
                        position = self.acquired + self.dropped
                        self.ring.append(Slot(self.acquired, position, Frame(buffer, metadata)))
                    self.acquired += 1
                    if len(self.ring) > self.n_buffers:
                        self.ring.popleft()
                    self.changed.notify_all()
        except StoppedError:
            pass
        except DeviceError as error:
            self.error = error
        except Exception as error:  # noqa: BLE001 - a driver's mistake: readers must not wait for ever
            self.error = DeviceError(self.camera.name, f"its stream failed: {error!r}.", "Report this.")
            self.error.__cause__ = error
        finally:
            # Hundreds of megabytes: not to be kept by who keeps the stream, or an error with its traceback.
            del self._pool
            self._end()

    def _buffer(self) -> Pixels | None:
        """Return a free buffer, giving up the oldest frames of the ring for it; None when all are held."""
        while (buffer := self._pool.take()) is None:
            with self.changed:
                if len(self.ring) <= 1:
                    return None
                self.ring.popleft()
        return buffer

    def _end(self) -> None:
        with self.changed:
            self._running = False
            self.changed.notify_all()
