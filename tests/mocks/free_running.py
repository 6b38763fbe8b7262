"""A camera that exposes all the time, frame after frame, whether or not somebody looks."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import replace

import numpy as np

from drivers.errors import DeviceError, DeviceTimeoutError, StoppedError
from drivers.frame import Frame, FrameMetadata
from tests.mocks.devices import MockCamera, MockOptions, MockWorld


class FreeRunningCamera(MockCamera):
    """Frame ``i`` is full of ``i``.

    ``drop`` is the set of frames that the device loses; ``deep_ring`` a size of the driver's ring that nobody
    asked for, so that only the stream's own ring overflows.
    """

    def __init__(self, period_s: float = 0.002) -> None:
        super().__init__(MockOptions(), MockWorld(MockWorld.Options()))
        self._open = True
        self.exposure_ms = period_s * 1e3
        self.drop: set[int] = set()
        self.n_frames: int | None = None
        self.fail_at: int | None = None
        self.deep_ring: int | None = None
        self.exposing = 0
        self._ring: deque[Frame] = deque()
        self._arrived = threading.Condition()
        self._thread: threading.Thread | None = None
        self._running = False
        self._failure: DeviceError | None = None
        self._lost = 0

    def start_sequence(self, n_buffers: int = 8) -> None:
        self._ring = deque(maxlen=self.deep_ring or n_buffers)
        self._running = True
        self._thread = threading.Thread(target=self._expose, daemon=True)
        self._thread.start()

    @property
    def is_streaming(self) -> bool:  # type: ignore[override]
        return self._running

    def next_frame(self, timeout_s: float) -> Frame:
        with self._arrived:
            self._arrived.wait_for(lambda: self._ring or not self._running or self._failure, timeout_s)
            if self._ring:
                frame = self._ring.popleft()
                return Frame(frame.image, replace(frame.metadata, host_time_ns=time.monotonic_ns()))
            if self._failure is not None:
                raise self._failure
            if not self._running:
                raise StoppedError(self.name, "stopped.")
            raise DeviceTimeoutError(self.name, "no frame.")

    def stop_sequence(self) -> None:
        with self._arrived:
            self._running = False
            self._arrived.notify_all()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _expose(self) -> None:
        number = 0
        while self._running and number != self.n_frames:
            if number == self.fail_at:
                with self._arrived:
                    self._failure = DeviceError(self.name, "was unplugged.")
                    self._arrived.notify_all()
                return
            self.exposing = number
            time.sleep(self.exposure_ms / 1e3)
            image = np.full(self.image_shape, number, np.uint16)
            self._deliver(Frame(image, self.snap_metadata(number)))
            number += 1

    def _deliver(self, frame: Frame) -> None:
        with self._arrived:
            if frame.metadata.frame_id in self.drop:
                self._lost += 1
                return
            frame, self._lost = _with_lost(frame, self._lost), 0
            if len(self._ring) == self._ring.maxlen:
                oldest = self._ring.popleft()
                lost = 1 + oldest.metadata.dropped_before
                if self._ring:
                    self._ring[0] = _with_lost(self._ring[0], lost)
                else:
                    frame = _with_lost(frame, lost)
            self._ring.append(frame)
            self._arrived.notify_all()

    def snap_metadata(self, number: int) -> FrameMetadata:
        return replace(super().snap().metadata, frame_id=number, dropped_before=0)


def _with_lost(frame: Frame, lost: int) -> Frame:
    dropped = frame.metadata.dropped_before + lost
    return Frame(frame.image, replace(frame.metadata, dropped_before=dropped))
