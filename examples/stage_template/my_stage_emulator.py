"""The controller at the other end of a pseudo-terminal, for the tests: no hardware needed."""

from __future__ import annotations

import os
import select
import threading
import time
import tty

LOW, HIGH, STEPS_PER_S = 0, 50_000, 40_000


class MyStageEmulator:
    """Answers as the real one does; ``silent`` and ``fault`` make it misbehave."""

    def __init__(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave  # kept open, so that the port survives between clients
        self.silent = self.fault = self.homed = False
        self._from = self._to = 20_000.0
        self._began_s = 0.0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    @property
    def place(self) -> int:
        way = self._to - self._from
        reach = min(abs(way), STEPS_PER_S * (time.monotonic() - self._began_s))
        return round(self._from + (reach if way > 0 else -reach))

    def _go(self, target: float) -> None:
        self._from, self._to, self._began_s = float(self.place), target, time.monotonic()

    def _run(self) -> None:
        rest = b""
        while not self._stopping.is_set():
            if select.select([self._master], [], [], 0.02)[0]:
                *lines, rest = (rest + os.read(self._master, 4096)).split(b"\n")
                for line in lines:
                    answer = self._answer(line.split())
                    if answer and not self.silent:
                        os.write(self._master, answer + b"\n")

    def _answer(self, words: list[bytes]) -> bytes:
        match words:
            case [b"V"]:
                return b"MYSTAGE 1.0 SN123"
            case [b"L"]:
                return b"%d %d %d" % (LOW, HIGH, STEPS_PER_S)
            case [b"?"]:
                state = b"FAULT" if self.fault else b"IDLE" if self.place == self._to else b"MOVE"
                return b"%s %d %d" % (state, self.homed, self.place)
            case [b"G", target] if LOW <= int(target) <= HIGH:
                self._go(float(target))
                return b"OK"
            case [b"H"]:
                self._go(float(LOW))
                self.homed = True
                return b"OK"
            case [b"!"]:
                self._go(float(self.place))
                return b""
        return b"ERROR"
