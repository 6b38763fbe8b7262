"""A device at the other end of a pseudo-terminal, which answers as a test says: wrongly, or not at all."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

Answer = bytes | float | None
"""Bytes to send, seconds to wait first, or nothing."""


def lines(received: bytes) -> tuple[list[bytes], bytes]:
    """Return the lines received so far, and the rest."""
    *whole, rest = received.split(b"\n")
    return whole, rest


class PtyDevice:
    """Reads messages, by default lines, and sends what ``answer(message)`` returns, in order.

    ``link`` is a path that can be unplugged and plugged in again, as a USB adapter's name in /dev.
    """

    def __init__(
        self,
        folder: Path,
        answer: Callable[[bytes], list[Answer]],
        split: Callable[[bytes], tuple[list[bytes], bytes]] = lines,
    ) -> None:
        self.link = folder / "ttyTEST"
        self.answer = answer
        self.split = split
        self.received: list[bytes] = []
        self._stopping = threading.Event()
        self.plug_in()

    def plug_in(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self._slave_name = os.ttyname(slave)
        os.close(slave)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(self._slave_name)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._master, self._stopping), daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        self._stopping.set()
        self._thread.join()
        os.close(self._master)
        self.link.unlink(missing_ok=True)

    def send(self, data: bytes) -> None:
        os.write(self._master, data)

    def _run(self, master: int, stopping: threading.Event) -> None:
        rest = b""
        while not stopping.is_set():
            ready, _, _ = select.select([master], [], [], 0.02)
            if not ready:
                continue
            try:
                rest += os.read(master, 4096)
            except OSError:  # nobody has the other end open
                time.sleep(0.01)
                continue
            messages, rest = self.split(rest)
            for message in messages:
                self.received.append(message)
                self._reply(master, message)

    def _reply(self, master: int, message: bytes) -> None:
        for item in self.answer(message):
            if isinstance(item, float):
                time.sleep(item)
            elif item is not None:
                with contextlib.suppress(OSError):
                    os.write(master, item)
