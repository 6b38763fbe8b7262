"""What a simulated camera is to see, computed beside whoever waits for it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt


def _threads() -> set[Path]:
    """Return this program's threads as the system lists them; none on other systems than Linux."""
    try:
        return set(Path("/proc/self/task").iterdir())
    except OSError:
        return set()


def _computed_s(thread: Path) -> float:
    try:
        said = (thread / "stat").read_text()
    except OSError:  # over
        return 0.0
    return sum(map(int, said.rpartition(")")[2].split()[11:13])) / os.sysconf("SC_CLK_TCK")


class Look:
    """Light that is computed in a thread of its own: who ends an exposure does not wait for it.

    Parameters
    ----------
    see : callable
        Returns the light.
    """

    def __init__(self, see: Callable[[], npt.NDArray[np.float32]]) -> None:
        self._see = see
        self._seen: npt.NDArray[np.float32] | None = None
        self._error: Exception | None = None
        self._over = threading.Event()
        self._others = _threads()
        self.thread = threading.Thread(target=self._run, name="simulated light", daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            self._seen = self._see()
        except Exception as error:  # noqa: BLE001 - raised where the light is wanted
            self._error = error
        finally:
            self._over.set()

    def computed_s(self) -> float:
        """Return how long its thread and those that began since have computed, seconds of the processor.

        Light of many beads is shared among threads, which its own then waits for. 0 where it is over, and
        where a system does not say.
        """
        if not self.thread.is_alive():
            return 0.0
        return sum(_computed_s(thread) for thread in _threads() - self._others)

    def give_up(self) -> None:
        """Let go of who waits; what is being computed is kept by the world."""
        self._over.set()

    def light(self) -> npt.NDArray[np.float32] | None:
        """Wait for the light, or raise what kept it from being computed; None: it was given up."""
        self._over.wait()
        if self._error is not None:
            raise self._error
        return self._seen
