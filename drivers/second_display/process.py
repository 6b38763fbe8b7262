"""The window in a process of its own, for programs without a running Qt event loop."""

from __future__ import annotations

import contextlib
import json
import logging
import mmap
import os
import queue
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.second_display.outputs import Output, SecondDisplayOptions

_log = logging.getLogger(__name__)
_START_S = 30.0
_ANSWER_S = 10.0
_END_S = 3.0
_ERROR_BYTES = 65536
_SCALING = ("QT_SCALE_FACTOR", "QT_SCREEN_SCALE_FACTORS", "QT_ENABLE_HIGHDPI_SCALING")


class WindowProcess:
    """Starts the process, and speaks with it: one request at a time, from any thread.

    Parameters
    ----------
    device : str
        The device as error messages name it.
    on_lost : callable
        Called, in a thread of this object, when the output is lost or the process ends by itself.
    """

    def __init__(self, device: str, on_lost: Callable[[DeviceError], None]) -> None:
        self._device = device
        self._on_lost = on_lost
        self._lock = threading.Lock()
        self._replies: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._closing = False
        self._number = 0
        self._memory: mmap.mmap | None = None
        self._memory_fd = os.memfd_create("diffuserbench-slm")
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with this object
        ours, theirs = socket.socketpair()
        self._socket = ours
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", __package__ + ".child", str(theirs.fileno()), str(self._memory_fd)],
                pass_fds=(theirs.fileno(), self._memory_fd),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                env={name: value for name, value in os.environ.items() if name not in _SCALING}
                | {"QT_ENABLE_HIGHDPI_SCALING": "0", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                start_new_session=True,  # a Ctrl-C in the terminal is for this process alone
            )
        self._reader = threading.Thread(target=self._read, name=f"window of {device}", daemon=True)
        self._reader.start()

    def outputs(self) -> tuple[Output, ...]:
        """Return all outputs of the desktop."""
        return tuple(Output(**row) for row in self._ask({"do": "list"}, _START_S))

    def open(self, options: SecondDisplayOptions) -> tuple[Output, str]:
        """Cover an output; see ``PatternScreen.open``."""
        request = {"do": "open", "device": self._device, "options": options.model_dump(mode="json")}
        reply = self._ask(request, _START_S)
        output = Output(**reply["output"])
        os.ftruncate(self._memory_fd, output.width * output.height)
        self._memory = mmap.mmap(self._memory_fd, 0)
        return output, reply["inhibited_by"]

    def show(self, levels: npt.NDArray[np.uint8]) -> None:
        """Draw a pattern; see ``PatternScreen.show``."""
        memory = self._memory
        assert memory is not None
        memory[:] = levels.tobytes()
        self._ask({"do": "show"}, _ANSWER_S)

    def close(self) -> None:
        """End the process: asked, then killed. Closing twice does nothing."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._reader is not threading.current_thread():
            self._reader.join()
        with self._lock:
            self._socket.close()
            self._errors.close()
            if self._memory is not None:
                self._memory.close()
                self._memory = None
            if self._memory_fd >= 0:
                os.close(self._memory_fd)
                self._memory_fd = -1

    def _ask(self, request: dict[str, Any], timeout_s: float) -> Any:
        with self._lock:
            self._number += 1
            try:
                self._socket.sendall(json.dumps(request | {"number": self._number}).encode() + b"\n")
                reply = self._reply(self._number, timeout_s)
            except OSError:
                reply = None
            except queue.Empty:
                raise DeviceTimeoutError(
                    self._device,
                    f"its window did not answer within {timeout_s:g} s.",
                    "Is the desktop frozen? Close the SLM and open it again.",
                ) from None
            if reply is None:
                self._replies.put(None)  # for whoever asks next
                raise self._ended()
            if "error" in reply:
                raise DeviceError(self._device, *reply["error"])
            return reply["reply"]

    def _reply(self, number: int, timeout_s: float) -> dict[str, Any] | None:
        """Return the reply to a request, past late ones to those before; None when the process ended."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            reply = self._replies.get(timeout=max(0.0, deadline_s - time.monotonic()))
            if reply is None or reply["number"] == number:
                return reply

    def _read(self) -> None:
        received = b""
        while True:
            try:
                data = self._socket.recv(65536)
            except OSError:
                data = b""
            if not data:
                break
            *lines, received = (received + data).split(b"\n")
            for message in map(json.loads, lines):
                if "lost" in message:
                    self._on_lost(DeviceError(self._device, *message["lost"]))
                else:
                    self._replies.put(message)
        self._replies.put(None)
        if not self._closing:
            self._on_lost(self._ended())

    def _ended(self) -> DeviceError:
        if self._closing:
            return DeviceError(self._device, "its window was closed.")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        # At a place of its own: two threads may come here.
        text = os.pread(self._errors.fileno(), _ERROR_BYTES, 0).decode(errors="replace").strip()
        if text:
            _log.debug("%s: its window's process said:\n%s", self._device, text)
        last = text.splitlines()[-1] if text else f"status {self._process.returncode}"
        if "cannot open shared object file" in text:
            return DeviceError(
                self._device,
                f"Qt cannot be loaded: {last}.",
                "Debian: sudo apt install libegl1 libgl1 libdbus-1-3 libfontconfig1 libglib2.0-0 "
                "libxkbcommon0.",
            )
        if "platform plugin" in text or "connect to display" in text:
            return DeviceError(
                self._device,
                f"Qt cannot open a window here ({text.splitlines()[0].strip()}).",
                "Start it from a desktop session (DISPLAY or WAYLAND_DISPLAY must be set); under X11 "
                "install libxcb-cursor0, libxcb-icccm4 and libxcb-keysyms1.",
            )
        return DeviceError(
            self._device, f"its window's process ended: {last}.", "Close the SLM and open it again."
        )
