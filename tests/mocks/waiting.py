"""Waiting for what another thread, a process or a device does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


def until(condition: Callable[[], object], timeout_s: float = 30.0, *, every_s: float = 0.005) -> bool:
    """Wait for a condition; returns whether it came true in time. It is asked each ``every_s`` seconds."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(every_s)
    return True


def in_background(act: Callable[[], object]) -> tuple[threading.Thread, list[BaseException | None]]:
    """Act in a thread; the list gets what it raised, or None, when it has ended."""
    outcome: list[BaseException | None] = []

    def run() -> None:
        try:
            act()
            outcome.append(None)
        except BaseException as error:  # noqa: BLE001 - handed to the test
            outcome.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, outcome
