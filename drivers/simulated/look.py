"""What a simulated camera is to see, computed beside whoever waits for it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

from recon.arrays import Float32Array

_COMPUTING = ("render", "recon")
"""How names begin of threads that light is shared among: the renderer's own, and the pool for blocks."""


def _computed_s(thread: threading.Thread) -> float:
    """Return the seconds of the processor a thread has taken; 0 where it is over or a system does not say."""
    try:
        said = Path(f"/proc/self/task/{thread.native_id}/stat").read_text()
    except OSError:
        return 0.0
    return sum(map(int, said.rpartition(")")[2].split()[11:13])) / os.sysconf("SC_CLK_TCK")


class Look:
    """Light that is computed in a thread of its own: who ends an exposure does not wait for it.

    Parameters
    ----------
    see : callable
        Returns the light.
    """

    def __init__(self, see: Callable[[], Float32Array]) -> None:
        self._see = see
        self._seen: Float32Array | None = None
        self._error: Exception | None = None
        self._over = threading.Event()
        self._spent_s: dict[threading.Thread, float] = {}
        self._before_s = sum(self._so_far_s().values())
        self.thread = threading.Thread(target=self._run, name="simulated light", daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            self._seen = self._see()
        except Exception as error:  # noqa: BLE001 - raised where the light is wanted
            self._error = error
        finally:
            self._over.set()

    def _so_far_s(self) -> dict[threading.Thread, float]:
        """Return what each thread that ever shared light has computed, ended ones too."""
        for thread in threading.enumerate():
            if thread.name.startswith(_COMPUTING):
                self._spent_s[thread] = max(_computed_s(thread), self._spent_s.get(thread, 0.0))
        return self._spent_s

    def computed_s(self) -> float:
        """Return how long its thread, and others that light is shared among, have computed since it began.

        Seconds of the processor. Light of many beads is shared among threads, which its own waits for; the
        pool for blocks may work for others meanwhile. 0 where it is over, or a system does not say.
        """
        if not self.thread.is_alive():
            return 0.0
        return _computed_s(self.thread) + sum(self._so_far_s().values()) - self._before_s

    def give_up(self) -> None:
        """Let go of who waits; what is being computed is kept by the world."""
        self._over.set()

    def light(self) -> Float32Array | None:
        """Wait for the light, or raise what kept it from being computed; None: it was given up."""
        self._over.wait()
        if self._error is not None:
            raise self._error
        return self._seen
