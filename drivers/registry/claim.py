"""One program at a time for one device: locks that say who holds them and end with the process that does."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import socket
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivers.errors import DeviceError


class DeviceBusyError(DeviceError):
    """Another program, or another part of this one, has the device."""


class Claim:
    """What keeps others from a port or a device until :meth:`release`, or until the process ends, however.

    Programs of one machine that claim the same name exclude each other; it is no protection against
    programs that do not ask.

    Parameters
    ----------
    resource : str
        What is claimed, the same for all who mean it: ``"port /dev/ttyUSB0"``.
    device : str
        The device as error messages name it.

    Raises DeviceBusyError: naming the program, its process and since when it has the device.
    """

    def __init__(self, resource: str, device: str) -> None:
        self.resource = resource
        path = _path(resource)
        self._handle = _open(path)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._handle)
            raise DeviceBusyError(
                device,
                f"{resource} is in use by {_holder(path)}.",
                "Close that program, or wait until it ends.",
            ) from None
        holder = {
            "program": " ".join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])[:200],
            "pid": os.getpid(),
            "since": datetime.now(UTC).isoformat(timespec="seconds"),
            "host": socket.gethostname(),
            "resource": resource,
        }
        os.ftruncate(self._handle, 0)
        os.pwrite(self._handle, json.dumps(holder).encode(), 0)

    def release(self) -> None:
        """Give the device free; releasing twice does nothing."""
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            os.close(handle)


def holder_of(resource: str) -> str | None:
    """Return which other program has a claim, in words; None when none has, or this one."""
    path = _path(resource)
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return None if _is_mine(path) else _holder(path)
    finally:
        os.close(handle)
    return None


def _path(resource: str) -> Path:
    return _folder() / f"{hashlib.sha256(resource.encode()).hexdigest()[:24]}.lock"


def _folder() -> Path:
    """Return the machine's folder of locks, shared by all its users."""
    folder = Path(tempfile.gettempdir()) / "diffuserbench-locks"
    with contextlib.suppress(FileExistsError):
        folder.mkdir()
        folder.chmod(0o1777)
    return folder


def _open(path: Path) -> int:
    # Without O_CREAT first: Linux refuses O_CREAT on another user's file in a folder like this one.
    with contextlib.suppress(FileNotFoundError):
        return os.open(path, os.O_RDWR | os.O_CLOEXEC)
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    with contextlib.suppress(PermissionError):
        os.fchmod(handle, 0o666)  # whatever the umask says: other users must be able to claim it too
    return handle


def _is_mine(path: Path) -> bool:
    try:
        return bool(json.loads(path.read_text())["pid"] == os.getpid())
    except (OSError, ValueError, KeyError):
        return False


def _holder(path: Path) -> str:
    try:
        holder: dict[str, Any] = json.loads(path.read_text())
        mine = " (this program)" if holder["pid"] == os.getpid() else ""
        return f"{holder['program']!r}, process {holder['pid']}{mine}, since {holder['since']}"
    except (OSError, ValueError, KeyError):
        return "another program, which has just begun"
