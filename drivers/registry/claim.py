"""One program at a time for one device: locks that say who holds them and end with the process that does."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import socket
import stat
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivers.errors import DeviceError

PLACES = ("/run/lock", "/tmp")
"""Where locks may be kept: the first that every user may write to, so that all take the same."""
PLACE_VARIABLE = "DIFFUSERBENCH_LOCKS"
"""Environment variable that names another folder, for containers that share one with their machine."""


class DeviceBusyError(DeviceError):
    """Another program, or another part of this one, has the device."""


class Claim:
    """What keeps others from a port or a device until :meth:`release`, or until the process ends, however.

    Programs of one machine that claim the same name exclude each other, whoever runs them; it is no
    protection against programs that do not ask, nor against those in a container that shares no folder.

    Parameters
    ----------
    resource : str
        What is claimed, the same for all who mean it: ``"port /dev/ttyUSB0"``.
    device : str
        The device as error messages name it.

    Raises DeviceBusyError: naming the program, its process and since when it has the device. Raises
    DeviceError when locks cannot be kept in the machine's folder for them.
    """

    def __init__(self, resource: str, device: str) -> None:
        self.resource = resource
        try:
            path = _path(resource)
            self._handle = _open(path)
            while not (busy := not lock(self._handle)) and not _is_at(self._handle, path):
                os.close(self._handle)  # deleted since it was opened: a lock on it would hold nobody
                self._handle = _open(path)
            if not busy:
                self._sign(path)
        except OSError as error:
            raise DeviceError(
                device,
                f"the locks of devices cannot be kept in {error.filename or path}: {error.strerror}.",
                f"Make that folder one that all users may write to (chmod 1777) and that holds nothing else, "
                f"or name another in {PLACE_VARIABLE} for all of them.",
            ) from error
        if busy:
            os.close(self._handle)
            raise DeviceBusyError(
                device,
                f"{resource} is in use by {_holder(path)}.",
                "Close that program, or wait until it ends.",
            )

    def _sign(self, path: Path) -> None:
        """Write who holds it; what cannot be written is not held."""
        holder = {
            "program": " ".join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])[:200],
            "pid": os.getpid(),
            "since": datetime.now(UTC).isoformat(timespec="seconds"),
            "host": socket.gethostname(),
            "resource": self.resource,
        }
        try:
            os.ftruncate(self._handle, 0)
            os.pwrite(self._handle, json.dumps(holder).encode(), 0)
        except OSError as error:
            self.release()
            error.filename = str(path)
            raise

    def release(self) -> None:
        """Give the device free; releasing twice does nothing."""
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            os.close(handle)


def holder_of(resource: str) -> str | None:
    """Return which other program has a claim, in words; None when none has, or this one."""
    path = _path(resource)
    return _holder(path) if is_locked(path) and not _is_mine(path) else None


def lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed or the process ends; return False when another has it.

    One who only looks (:func:`is_locked`) has it for microseconds, so it is asked for a tenth of a second.
    """
    for _ in range(_TRIES):
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_BETWEEN_S)
        else:
            return True
    return False


_TRIES, _BETWEEN_S = 10, 0.01


def is_locked(path: Path) -> bool:
    """Return whether some process has a file or a folder locked; one that is not there, nobody has."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False  # of file systems that lock files only
    finally:
        os.close(handle)
    return False


def _path(resource: str) -> Path:
    return _folder() / f"{hashlib.sha256(resource.encode()).hexdigest()[:24]}.lock"


def _folder() -> Path:
    """Return the machine's folder of locks, the same for all its users whatever their environment."""
    for_all = (Path(place) for place in PLACES if _is_for_all(Path(place)))
    named = os.environ.get(PLACE_VARIABLE)
    folder = Path(named) if named else next(for_all, Path(PLACES[-1])) / "diffuserbench-locks"
    with contextlib.suppress(FileExistsError):
        folder.mkdir()
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(errno.ENOTDIR, "not a folder", str(folder))
    if found.st_uid == os.getuid() and stat.S_IMODE(found.st_mode) != _FOR_ALL:
        folder.chmod(_FOR_ALL)
    return folder


_FOR_ALL = 0o1777
"""A folder to which all may write, and from which nobody takes another's file away."""


def _is_for_all(folder: Path) -> bool:
    try:
        return stat.S_IMODE(folder.stat().st_mode) & _FOR_ALL == _FOR_ALL
    except OSError:
        return False


_AS_IT_IS = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""Other users may have put there what they like: a link is not followed, a pipe not waited for."""


def _open(path: Path) -> int:
    # Without O_CREAT first: Linux refuses O_CREAT on another user's file in a folder like this one.
    try:
        handle = os.open(path, os.O_RDWR | _AS_IT_IS)
    except FileNotFoundError:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | _AS_IT_IS, 0o666)
        with contextlib.suppress(PermissionError):
            os.fchmod(handle, 0o666)  # whatever the umask says: other users must be able to claim it too
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "that is no file", str(path))
    return handle


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def _is_mine(path: Path) -> bool:
    return _signed(path).get("pid") == os.getpid()


def _signed(path: Path) -> dict[str, Any]:
    """Return what a holder wrote of itself: nothing where that cannot be read, or is none of this."""
    try:
        handle = os.open(path, os.O_RDONLY | _AS_IT_IS)
        try:
            found = json.loads(os.read(handle, _MOST_BYTES))
        finally:
            os.close(handle)
        texts = ("program", "host", "since")
        if isinstance(found["pid"], int) and all(str(found[key]).isprintable() for key in texts):
            return dict(found)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        pass
    return {}


_MOST_BYTES = 4096


def _holder(path: Path) -> str:
    if not (holder := _signed(path)):
        return "another program, which has just begun"
    words = f"{holder['program']!r}, process {holder['pid']}"
    if holder["host"] != socket.gethostname():
        return f"{words} on {holder['host']}, since {holder['since']}"
    mine = " (this program)" if holder["pid"] == os.getpid() else ""
    left = "" if _is_alive(holder["pid"]) else " (which has ended; a process that it started goes on)"
    return f"{words}{mine}{left}, since {holder['since']}"


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # another user's
    return True
