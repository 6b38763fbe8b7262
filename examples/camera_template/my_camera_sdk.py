"""What stands for the maker's library: the calls that most of them have, a moving picture, faults on request.

With the real one, import that in ``my_camera.py`` instead, and keep this file for the tests.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

HEIGHT, WIDTH = 120, 160


class SdkError(Exception):
    """A call failed."""


class UnpluggedError(SdkError):
    """The camera is gone."""


@dataclass
class Buffer:
    """A filled buffer: its bytes are the library's until it is queued again."""

    data: npt.NDArray[np.uint8]
    number: int
    time_ns: int
    """When the exposure ended, by the camera's clock."""
    complete: bool


plugged = ["MC100-0042"]
"""Serial numbers of what is connected."""
damage = [0]
"""How many of the next frames arrive in part only."""


def cameras() -> list[str]:
    """Return the serial numbers of the connected cameras."""
    return list(plugged)


class Camera:
    """One camera, open until ``close``; registers are read and written by their names."""

    def __init__(self, serial_number: str) -> None:
        if serial_number not in plugged:
            raise SdkError("no such camera")
        self.serial_number, self.model, self.firmware = serial_number, "MC100", "2.1"
        self._registers = {
            **{"exposure_us": 10_000, "gain_db10": 0, "offset": 16, "bits": 8, "trigger": 0},
            **{"x": 0, "y": 0, "width": WIDTH, "height": HEIGHT},
        }
        self._free: deque[npt.NDArray[np.uint8]] = deque()
        self._full: deque[Buffer] = deque()
        self._changed = threading.Condition()
        self._fired = threading.Semaphore(0)
        self._aborted = False
        self._running: tuple[threading.Event, threading.Thread] | None = None

    def read(self, register: str) -> int:
        self._check()
        return self._registers[register]

    def write(self, register: str, value: int) -> None:
        self._check()
        at = self._registers | {register: value}
        if at["x"] + at["width"] > WIDTH or at["y"] + at["height"] > HEIGHT:
            raise SdkError(f"{register} {value}: the region sticks out of the sensor")
        # As cameras do: an exposure is a whole number of lines, whatever was asked for.
        self._registers[register] = value // 10 * 10 if register == "exposure_us" else value

    def start(self, n_buffers: int) -> None:
        self._check()
        n_bytes = self._registers["width"] * self._registers["height"] * (1 + (self._registers["bits"] > 8))
        self._free = deque(np.empty(n_bytes, np.uint8) for _ in range(n_buffers))
        self._full.clear()
        self._aborted, self._fired = False, threading.Semaphore(0)
        ended = threading.Event()
        exposing = threading.Thread(target=self._expose, args=(ended,), daemon=True)
        self._running = ended, exposing
        exposing.start()

    def wait(self, timeout_ms: int) -> Buffer | None:
        """Wait for a full buffer; None after the time, or after ``abort``."""
        with self._changed:
            self._changed.wait_for(lambda: self._full or self._aborted, timeout_ms / 1e3)
            self._check()
            return self._full.popleft() if self._full and not self._aborted else None

    def queue(self, buffer: Buffer) -> None:
        self._free.append(buffer.data)

    def abort(self) -> None:
        with self._changed:
            self._aborted = True
            self._changed.notify_all()

    def fire(self) -> None:
        self._fired.release()

    def stop(self) -> None:
        if self._running is not None:
            ended, exposing = self._running
            ended.set()
            exposing.join()  # else its last frame would be in the next sequence
            self._running = None

    def close(self) -> None:
        self.stop()

    def _check(self) -> None:
        if self.serial_number not in plugged:
            raise UnpluggedError("the camera does not answer")

    def _expose(self, ended: threading.Event) -> None:
        number = 0
        while not ended.wait(max(0.005, self._registers["exposure_us"] / 1e6)):
            if self._registers["trigger"] and not self._fired.acquire(timeout=0.05):
                continue
            with self._changed:
                if self._free and not ended.is_set():
                    buffer = self._free.popleft()
                    self._fill(buffer, number)
                    damage[0] -= (damaged := damage[0] > 0)
                    self._full.append(Buffer(buffer, number, time.monotonic_ns(), not damaged))
                    self._changed.notify_all()
            number += 1  # also where no buffer was free: the number tells that one was lost

    def _fill(self, buffer: npt.NDArray[np.uint8], number: int) -> None:
        at = self._registers
        full_scale = (1 << at["bits"]) - 1
        y, x = np.mgrid[at["y"] : at["y"] + at["height"], at["x"] : at["x"] + at["width"]]
        blob = np.exp(-((y - HEIGHT / 2) ** 2 + (x - (number * 3) % WIDTH) ** 2) / 200)
        light = blob * at["exposure_us"] / 20_000 * 10 ** (at["gain_db10"] / 200)
        counts = np.minimum(at["offset"] + light * full_scale, full_scale)
        buffer[:] = counts.astype("u1" if at["bits"] == 8 else "<u2").reshape(-1).view(np.uint8)
