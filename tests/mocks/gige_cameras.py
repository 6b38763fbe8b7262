"""Other people's GigE Vision cameras on the loopback interface, one at a time on this machine.

GigE Vision's control port is fixed: a lock keeps test processes from each other.
"""

from __future__ import annotations

import contextlib
import fcntl
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.aravis.features import load
from drivers.errors import DeviceError

ADDRESS = "127.0.0.1"
_PROGRAM = "arv-fake-gv-camera-0.8"


def aravis_or_skip() -> Any:
    """Return Aravis; skips in words where it is not installed."""
    try:
        return load("camera (aravis)")
    except DeviceError as error:
        pytest.skip(str(error))


@contextlib.contextmanager
def alone_on_the_port() -> Iterator[None]:
    with (Path(tempfile.gettempdir()) / "diffuserbench-gvcp.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


class ArvFakeCamera:
    """Aravis' own fake camera in a process of its own."""

    def __init__(self, lost_per_1000: int = 0) -> None:
        self._arguments = ["-i", ADDRESS, "-s", "GV01", "-r", str(lost_per_1000)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        if shutil.which(_PROGRAM) is None:
            pytest.skip(f"{_PROGRAM} is not installed (Debian: sudo apt install aravis-tools)")
        self._process = subprocess.Popen([_PROGRAM, *self._arguments], stdin=subprocess.DEVNULL)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def __enter__(self) -> ArvFakeCamera:
        self.start()
        time.sleep(0.2)
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


def viva_or_skip() -> Any:
    """Return viva-genicam's fake camera; skips in words where it is not installed."""
    try:
        from viva_genicam.testing import FakeGigeCamera
    except ImportError as error:
        pytest.skip(f"viva-genicam is not installed ({error})")
    return FakeGigeCamera
