"""A camera without triggers and regions of its own: its driver lets its frames through, and cuts them."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import deque
from typing import Any

import numpy as np

from drivers.common.buffered_camera import BufferedCamera, RawFrame
from drivers.common.pixels import Bytes, Pixels


class RunningCamera(BufferedCamera):
    """Hands out, for each software trigger, the first frame whose exposure began after it."""

    _clock = time.CLOCK_MONOTONIC
    """That of the frames' device times."""

    def __init__(self) -> None:
        super().__init__()
        self._triggers: deque[int] = deque()
        self._scratch: Pixels | None = None

    @abstractmethod
    def _decode_whole(self, data: Bytes, out: Pixels) -> bool:
        """Write all pixels of a buffer into an image; False when the bytes are damaged."""

    def _make_ready(self, whole: tuple[int, int]) -> None:
        """Forget triggers, and have memory for images of ``whole`` pixels where they are cut."""
        self._triggers.clear()
        frame: tuple[int, ...] = self.frame_shape
        is_cut = frame[:2] != whole
        self._scratch = np.empty((*whole, *frame[2:]), self.frame_dtype) if is_cut else None

    def _decode(self, data: Bytes, out: Pixels) -> bool:
        if self._scratch is None:
            return self._decode_whole(data, out)
        if not self._decode_whole(data, self._scratch):
            return False
        roi = self._roi
        np.copyto(out, self._scratch[roi.top : roi.top + roi.height, roi.left : roi.left + roi.width])
        return True

    def _fire(self) -> None:
        self._triggers.append(time.clock_gettime_ns(self._clock))

    def _asked_for(self, raw: RawFrame) -> bool:
        if self._trigger_mode != "software":
            return True
        if not self._triggers:
            return False
        # Without the device's clock the arrival stands in for it; the exposure before it is an upper bound.
        ended_ns = raw.device_time_ns or time.clock_gettime_ns(self._clock)
        exposure_ms: Any = raw.facts.get("exposure_ms", self._exposure_ms)
        if ended_ns - round(exposure_ms * 1e6) < self._triggers[0]:
            return False
        self._triggers.popleft()
        return True
