"""Simulated time: real waiting, stretched or skipped."""

from __future__ import annotations

import threading
import time


class Clock:
    """Waits ``time_scale`` real seconds for every simulated second (1: real time, 0: no waiting)."""

    def __init__(self, time_scale: float) -> None:
        self.time_scale = time_scale

    def wait(self, seconds: float, cancelled: threading.Event) -> bool:
        """Wait; returns False as soon as ``cancelled`` is set."""
        return not cancelled.wait(max(seconds, 0.0) * self.time_scale)

    def elapsed_since(self, start: float) -> float:
        """Return the simulated seconds since ``start``, a reading of ``time.monotonic()``.

        Infinite when nothing is waited for.
        """
        if self.time_scale == 0:
            return float("inf")
        return (time.monotonic() - start) / self.time_scale
