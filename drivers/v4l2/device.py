"""A video device node: calls whose errors are put into words, and its queue of buffers."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable, Iterator
from ctypes import Structure, addressof
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.common.pixels import Bytes
from drivers.device import DeviceIdentity
from drivers.errors import DeviceError, DeviceLostError, DeviceNotOpenError
from drivers.registry.buses import video_devices
from drivers.registry.claim import DeviceBusyError
from drivers.v4l2 import api

_VIRTUAL_DRIVERS = ("vivid", "vimc")
_GONE = (errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN)


@dataclass(frozen=True, slots=True)
class FilledBuffer:
    """A buffer that the kernel has filled, and what it says about it."""

    index: int
    data: Bytes
    sequence: int
    flags: int
    time_ns: int


class VideoDevice:
    """An open ``/dev/video*``.

    Parameters
    ----------
    path : str
    name : str
        The device as error messages name it.
    kernel : Kernel
    on_lost : callable, optional
        Called with the error when the device turns out to be gone.
    """

    def __init__(
        self,
        path: str,
        name: str,
        kernel: api.Kernel,
        on_lost: Callable[[DeviceLostError], None] | None = None,
    ) -> None:
        self.path = path
        self.name = name
        self._kernel = kernel
        self._on_lost = on_lost
        self._fd: int | None = None
        self._wake_fd = -1
        self._maps: list[Any] = []
        self.buffer_type = api.BUF_TYPE_VIDEO_CAPTURE
        """How the driver is spoken to: with memory planes (of which images here have one), or without."""
        self._requested = False

    @property
    def is_open(self) -> bool:
        """Whether the node is open."""
        return self._fd is not None

    def open(self) -> None:
        """Open the node and see that it is a camera that streams.

        Raises DeviceError: missing, not permitted, no camera.
        """
        try:
            self._fd = self._kernel.open(self.path)
        except OSError as error:
            raise self._open_error(error) from error
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
        self.stop()
        fd, self._fd = self._fd, None
        self._kernel.close(fd)
        os.close(self._wake_fd)

    def capability(self) -> api.Capability:
        """Ask what the device is; ``device_caps`` are those of this node."""
        found = api.Capability()
        self.call(api.QUERYCAP, found, "say what it is")
        if not found.capabilities & api.CAP_DEVICE_CAPS:
            found.device_caps = found.capabilities
        return found

    # Calls -----------------------------------------------------------------------------------------
    def call(self, request: int, argument: Structure, doing: str) -> None:
        """Call the driver; ``doing`` completes "it did not ..." in the error."""
        number = self.attempt(request, argument)
        if number:
            raise self._error(number, doing)

    def attempt(self, request: int, argument: Structure) -> int:
        """Call the driver; returns 0 or the error's number (a device that is gone raises)."""
        if self._fd is None:
            raise DeviceNotOpenError(self.name)
        try:
            self._kernel.ioctl(self._fd, request, argument)
        except OSError as error:
            if error.errno in _GONE:
                raise self._gone() from error
            return error.errno or errno.EIO
        return 0

    def enumerate(self, request: int, kind: type[Structure], **given: int) -> Iterator[Any]:
        """Yield what an enumeration gives for index 0, 1, ... until it says that there is no more."""
        for index in range(1000):
            item = kind(index=index, **given)
            if self.attempt(request, item):
                return
            yield item

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

    # Errors ----------------------------------------------------------------------------------------
    def _gone(self) -> DeviceLostError:
        error = DeviceLostError(
            self.name, f"{self.path} is gone: unplugged or switched off.", "Plug it in and open it again."
        )
        if self._on_lost is not None:
            self._on_lost(error)
        return error

    def _error(self, number: int, doing: str) -> DeviceError:
        if number == errno.EBUSY:
            return DeviceBusyError(
                self.name,
                f"{self.path} is in use by another program.",
                f"Close it (fuser -v {self.path} names it).",
            )
        if number == errno.EIO:
            remedy = "The camera or its connection failed: check the cable, another port, and dmesg."
        elif number == errno.ENOSPC:
            remedy = "USB has no bandwidth left: try another port, or fewer frames a second."
        else:
            remedy = "dmesg may say more."
        return DeviceError(self.name, f"did not {doing}: {os.strerror(number)}.", remedy)

    def _open_error(self, error: OSError) -> DeviceError:
        if error.errno in (errno.EACCES, errno.EPERM):
            return DeviceError(
                self.name,
                f"{self.path} may not be opened by this user.",
                "Add the user to the group 'video': sudo usermod -aG video $USER, then log in again.",
            )
        if error.errno == errno.EBUSY:
            return self._error(errno.EBUSY, "open")
        if error.errno in (errno.ENOENT, *_GONE):
            there = sorted(str(node) for node in Path("/dev").glob("video*"))
            return DeviceError(
                self.name,
                f"there is no {self.path}.",
                f"Video devices here: {', '.join(there) or 'none'}. Is the camera plugged in?",
            )
        return DeviceError(
            self.name, f"{self.path} cannot be opened: {error.strerror}.", "dmesg may say more."
        )
