"""The V4L2 camera: its frames."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace

import numpy as np

from drivers.common.buffered_camera import RawFrame
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels
from drivers.device import DriverOptions, FoundDevice, SharedPart
from drivers.errors import DeviceError
from drivers.registry.buses import video_devices
from drivers.v4l2 import api
from drivers.v4l2.device import FilledBuffer, VideoDevice, lasting_path
from drivers.v4l2.formats import decode
from drivers.v4l2.image_settings import V4l2ImageSettings

_SEQUENCE_MODULUS = 1 << 32


class V4l2Camera(V4l2ImageSettings):
    """Any video device of the kernel that streams; lost frames are counted by its sequence numbers."""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self.frames_to_skip = self.options.frames_to_skip
        self._triggers: deque[int] = deque()
        self._scratch: Pixels | None = None

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the video devices that stream images; others may be streaming from them meanwhile."""
        found = []
        for device in video_devices():
            node = VideoDevice(device.address, f"camera (v4l2 {device.address})", cls.kernel)
            try:
                node.open()
            except DeviceError:
                continue  # metadata, a decoder, not permitted: still listed, as its bus has it
            node.close()
            found.append(
                replace(
                    device,
                    driver="v4l2",
                    kind="camera",
                    options={"device": lasting_path(device.address)},
                    note="pixel_pitch_um = (micrometres, from the data sheet of its sensor)",
                )
            )
        return tuple(found)

    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        self._triggers.clear()
        whole = (self._made.height, self._made.width)
        frame = self.frame_shape
        self._scratch = None
        if frame[:2] != whole:
            self._scratch = np.empty((*whole, *frame[2:]), self.frame_dtype)
        self._device.start(n_buffers)
        return None if self._trigger_mode == "software" else FrameNumberCounter(_SEQUENCE_MODULUS)

    def _take(self, timeout_s: float) -> RawFrame | None:
        filled = self._device.take(timeout_s)
        if filled is None:
            return None
        return RawFrame(
            data=filled.data,
            number=filled.sequence,
            device_time_ns=self._exposed_ns(filled),
            complete=not filled.flags & api.BUF_FLAG_ERROR,
            buffer=filled,
        )

    def _exposed_ns(self, filled: FilledBuffer) -> int | None:
        """Return the end of the exposure on the kernel's monotonic clock; None when it stamps by another."""
        if filled.flags & api.BUF_FLAG_TIMESTAMP_MASK != api.BUF_FLAG_TIMESTAMP_MONOTONIC:
            return None
        at_start = filled.flags & api.BUF_FLAG_TSTAMP_SRC_MASK == api.BUF_FLAG_TSTAMP_SRC_SOE
        return filled.time_ns + (round(self._exposure_ms * 1e6) if at_start else 0)

    def _give_back(self, raw: RawFrame) -> None:
        assert isinstance(raw.buffer, FilledBuffer)
        self._device.give_back(raw.buffer)

    def _wake(self) -> None:
        self._device.wake()

    def _end(self) -> None:
        self._device.stop()

    def _decode(self, data: Bytes, out: Pixels) -> bool:
        if self._scratch is None:
            return decode(data, self._format, self._made.bytesperline, out)
        if not decode(data, self._format, self._made.bytesperline, self._scratch):
            return False
        roi = self._roi
        np.copyto(out, self._scratch[roi.top : roi.top + roi.height, roi.left : roi.left + roi.width])
        return True

    # Triggers by software: the camera runs on, frames are let through ------------------------------
    def _fire(self) -> None:
        self._triggers.append(time.monotonic_ns())

    def _asked_for(self, raw: RawFrame) -> bool:
        if self._trigger_mode != "software":
            return True
        if not self._triggers:
            return False
        ended_ns = raw.device_time_ns if raw.device_time_ns is not None else time.monotonic_ns()
        # Without the kernel's clock the arrival stands in for it; the exposure before it is an upper bound.
        if ended_ns - round(self._exposure_ms * 1e6) < self._triggers[0]:
            return False
        self._triggers.popleft()
        return True
