"""An open node of a video driver: calls whose errors are put into words."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable, Iterator
from ctypes import Structure
from pathlib import Path
from typing import Any

from drivers.errors import DeviceError, DeviceLostError, DeviceNotOpenError
from drivers.registry.claim import DeviceBusyError
from drivers.v4l2 import api

_GONE = (errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN)


class Node:
    """A node: a camera's ``/dev/video*``, or a ``/dev/v4l-subdev*`` that has a sensor's or a lens's controls.

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

    @property
    def is_open(self) -> bool:
        """Whether the node is open."""
        return self._fd is not None

    def open(self) -> None:
        """Open the node.

        Raises DeviceError: missing, not permitted, in use.
        """
        try:
            self._fd = self._kernel.open(self.path)
        except OSError as error:
            raise self._open_error(error) from error

    def close(self) -> None:
        """Close the node; closing twice does nothing."""
        fd, self._fd = self._fd, None
        if fd is not None:
            with contextlib.suppress(
                OSError
            ):  # what a driver says at the end: the node is closed all the same
                self._kernel.close(fd)

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
            pattern = "v4l-subdev*" if "subdev" in self.path else "video*"
            there = sorted(str(node) for node in Path("/dev").glob(pattern))
            return DeviceError(
                self.name,
                f"there is no {self.path}.",
                f"Nodes of its kind here: {', '.join(there) or 'none'}. Is the camera plugged in?",
            )
        return DeviceError(
            self.name, f"{self.path} cannot be opened: {error.strerror}.", "dmesg may say more."
        )
