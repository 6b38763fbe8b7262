"""The window's own process: what ``process`` starts where no Qt program runs.

``python -m drivers.second_display.child SOCKET MEMORY`` with two inherited file descriptors: a socket that
takes and gives JSON lines, and the memory that holds the pattern. It ends when the socket does, or when the
process that started it is gone.
"""

from __future__ import annotations

import json
import mmap
import os
import signal
import socket
import sys
from dataclasses import asdict
from typing import Any

from PySide6.QtCore import QSocketNotifier, QTimer
from PySide6.QtGui import QGuiApplication

from drivers.errors import DeviceError
from drivers.second_display.outputs import SecondDisplayOptions
from drivers.second_display.window import PatternScreen, outputs

_WATCH_MS = 500


class _Child:
    def __init__(self, app: QGuiApplication, connection: socket.socket, memory: int) -> None:
        self._app = app
        self._connection = connection
        self._memory_fd = memory
        self._memory: mmap.mmap | None = None
        self._received = b""
        self._screen: PatternScreen | None = None
        self._parent = os.getppid()
        self._notifier = QSocketNotifier(connection.fileno(), QSocketNotifier.Type.Read)
        self._notifier.activated.connect(self._read)
        self._timer = QTimer()
        self._timer.timeout.connect(self._watch)
        self._timer.start(_WATCH_MS)

    def _watch(self) -> None:
        # Beside the socket's end: a process forked from the parent may keep the parent's end open.
        if os.getppid() != self._parent:
            self._end()

    def _end(self) -> None:
        if self._screen is not None:
            self._screen.close()
        self._app.quit()

    def _read(self) -> None:
        try:
            data = self._connection.recv(65536)
        except OSError:
            data = b""
        if not data:
            self._notifier.setEnabled(False)
            self._end()
            return
        *lines, self._received = (self._received + data).split(b"\n")
        for line in lines:
            self._answer(json.loads(line))

    def _answer(self, request: dict[str, Any]) -> None:
        try:
            answer = {"reply": self._carry_out(request)}
        except DeviceError as error:
            answer = {"error": [error.problem, error.remedy]}
        self._send({"number": request["number"], **answer})

    def _carry_out(self, request: dict[str, Any]) -> Any:
        if request["do"] == "list":
            return [asdict(output) for output in outputs()]
        if request["do"] == "open":
            options = SecondDisplayOptions.model_validate(request["options"])
            self._screen = PatternScreen(request["device"], self._say_lost)
            output, inhibited_by = self._screen.open(options)
            return {"output": asdict(output), "inhibited_by": inhibited_by}
        assert self._screen is not None
        if self._memory is None:
            self._memory = mmap.mmap(self._memory_fd, 0, prot=mmap.PROT_READ)
        self._screen.show(memoryview(self._memory))
        return None

    def _say_lost(self, error: DeviceError) -> None:
        self._send({"lost": [error.problem, error.remedy]})

    def _send(self, message: dict[str, Any]) -> None:
        try:
            self._connection.sendall(json.dumps(message).encode() + b"\n")
        except OSError:  # the parent is gone; reading tells so next
            self._app.quit()


def main() -> int:
    """Serve until the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's: it blanks the SLM in its order
    connection, memory = socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2])
    app = QGuiApplication(["diffuserbench SLM"])
    app.setQuitOnLastWindowClosed(False)
    child = _Child(app, connection, memory)
    status = app.exec()
    del child
    return status


if __name__ == "__main__":
    sys.exit(main())
