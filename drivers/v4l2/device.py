"""A video device node: calls whose errors are put into words, and its queue of buffers."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from ctypes import addressof
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.common.pixels import Bytes
from drivers.device import DeviceIdentity
from drivers.errors import DeviceError, DeviceLostError
from drivers.registry.buses import video_devices
from drivers.v4l2 import api
from drivers.v4l2.node import Node

_VIRTUAL_DRIVERS = ("vivid", "vimc")


@dataclass(frozen=True, slots=True)
class FilledBuffer:
    """A buffer that the kernel has filled, and what it says about it."""

    index: int
    data: Bytes
    sequence: int
    flags: int
    time_ns: int


class VideoDevice(Node):
    """An open ``/dev/video*``; parameters as of :class:`~drivers.v4l2.node.Node`."""

    def __init__(
        self,
        path: str,
        name: str,
        kernel: api.Kernel,
        on_lost: Callable[[DeviceLostError], None] | None = None,
    ) -> None:
        super().__init__(path, name, kernel, on_lost)
        self._wake_fd = -1
        self._maps: list[Any] = []
        self.buffer_type = api.BUF_TYPE_VIDEO_CAPTURE
        """How the driver is spoken to: with memory planes (of which images here have one), or without."""
        self._requested = False

    def open(self) -> None:
        """Open the node and see that it is a camera that streams.

        Raises DeviceError: missing, not permitted, no camera.
        """
        super().open()
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        try:
            found = self.capability()
            plain = bool(found.device_caps & api.CAP_VIDEO_CAPTURE)
            planes = bool(found.device_caps & api.CAP_VIDEO_CAPTURE_MPLANE)
            self.buffer_type = (
                api.BUF_TYPE_VIDEO_CAPTURE_MPLANE if planes and not plain else api.BUF_TYPE_VIDEO_CAPTURE
            )
            if not (plain or planes) or not found.device_caps & api.CAP_STREAMING:
                raise DeviceError(
                    self.name,
                    f"{self.path} is no camera that streams ({found.card.decode(errors='replace')}).",
                    "Cameras often have a second node for metadata: try the one with the smaller number.",
                )
        except BaseException:
            self.close()
            raise

    def identity(self) -> DeviceIdentity:
        """Return who the kernel says the camera is."""
        found = self.capability()
        driver = found.driver.decode(errors="replace")
        node = str(Path(self.path).resolve())
        usb = next((device for device in video_devices() if device.address == node), None)
        version = found.version
        return DeviceIdentity(
            kind="camera",
            driver="v4l2",
            vendor=(usb and usb.vendor) or driver,
            model=found.card.decode(errors="replace"),
            serial_number=(usb and usb.serial_number) or found.bus_info.decode(errors="replace"),
            firmware=f"{driver} of Linux {version >> 16}.{version >> 8 & 255}.{version & 255}",
            simulated=driver in _VIRTUAL_DRIVERS,
        )

    def close(self) -> None:
        """Close the node; closing twice does nothing."""
        if self._fd is None:
            return
        with contextlib.ExitStack() as each:  # whether or not the one before it failed; stop comes first
            each.callback(os.close, self._wake_fd)
            each.callback(super().close)
            each.callback(self.stop)

    def capability(self) -> api.Capability:
        """Ask what the device is; ``device_caps`` are those of this node."""
        found = api.Capability()
        self.call(api.QUERYCAP, found, "say what it is")
        if not found.capabilities & api.CAP_DEVICE_CAPS:
            found.device_caps = found.capabilities
        return found

    # Buffers ---------------------------------------------------------------------------------------
    def start(self, n_buffers: int) -> int:
        """Queue buffers and start streaming; returns how many buffers the driver gave."""
        request = api.RequestBuffers(count=n_buffers, type=self.buffer_type, memory=api.MEMORY_MMAP)
        self.call(api.REQBUFS, request, "give buffers")
        self._requested = True
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake_fd)
        assert self._fd is not None
        for index in range(request.count):
            buffer = self._buffer(index)
            self.call(api.QUERYBUF, buffer, "describe its buffers")
            where = buffer.plane or buffer
            self._maps.append(self._kernel.map(self._fd, where.length, where.m.offset))
            self.call(api.QBUF, buffer, "take its buffers")
        self.call(api.STREAMON, api.BufferType(self.buffer_type), "start streaming")
        return int(request.count)

    def take(self, timeout_s: float) -> FilledBuffer | None:
        """Wait for a filled buffer; None when the time is over or after :meth:`wake`."""
        waited = False
        while True:
            buffer = self._buffer(0)
            number = self.attempt(api.DQBUF, buffer)
            if number == 0:
                break
            if number != errno.EAGAIN:
                raise self._error(number, "hand out a frame")
            if waited or self._fd is None:
                return None
            waited = True
            if not self._kernel.wait(self._fd, self._wake_fd, timeout_s):
                return None
        plane = buffer.plane
        first, end = (0, buffer.bytesused) if plane is None else (plane.data_offset, plane.bytesused)
        data = np.frombuffer(self._maps[buffer.index], np.uint8, count=end)[first:]
        time_ns = buffer.timestamp.tv_sec * 10**9 + buffer.timestamp.tv_usec * 10**3
        return FilledBuffer(buffer.index, data, buffer.sequence, buffer.flags, time_ns)

    def give_back(self, filled: FilledBuffer) -> None:
        """Queue a buffer again."""
        self.call(api.QBUF, self._buffer(filled.index), "take a buffer back")

    def wake(self) -> None:
        """End a wait in :meth:`take`."""
        if self._fd is not None:
            os.eventfd_write(self._wake_fd, 1)

    def stop(self) -> None:
        """Stop streaming and free the buffers, as far as the device is still there."""
        if not self._requested:
            return
        self._requested = False
        none = api.RequestBuffers(count=0, type=self.buffer_type, memory=api.MEMORY_MMAP)
        with contextlib.suppress(DeviceLostError):
            self.attempt(api.STREAMOFF, api.BufferType(self.buffer_type))
        maps, self._maps = self._maps, []
        for memory in maps:
            with contextlib.suppress(BufferError):  # somebody still looks at it: it goes with the last look
                memory.close()
        with contextlib.suppress(DeviceLostError):
            self.attempt(api.REQBUFS, none)

    def _buffer(self, index: int) -> api.Buffer:
        buffer = api.Buffer(index=index, type=self.buffer_type, memory=api.MEMORY_MMAP)
        if self.buffer_type == api.BUF_TYPE_VIDEO_CAPTURE_MPLANE:
            buffer.plane = api.Plane()
            buffer.m.planes, buffer.length = addressof(buffer.plane), 1
        return buffer
