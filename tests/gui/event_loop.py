"""Let the window's events go on for a time, with the interpreter free for the other threads meanwhile.

``QTest.qWait`` keeps the interpreter's lock while it sleeps (PySide6 6.11: another thread got 99 turns a
second beside it, 12,000 beside an event loop), so that cameras and jobs stand still in what waits by it.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from PySide6.QtCore import QEventLoop, QTimer


def let_work(wait_ms: int) -> None:
    """Let the window work for a time in milliseconds."""
    loop = QEventLoop()
    QTimer.singleShot(wait_ms, loop.quit)
    loop.exec()


def wait_until(done: Callable[[], object], timeout_s: float = 300.0) -> None:
    """Let the window work until something is so; ``TimeoutError`` where it is not in time."""
    end_s = time.monotonic() + timeout_s
    while not done():
        if time.monotonic() > end_s:
            raise TimeoutError(f"waited {timeout_s:g} s in vain")
        let_work(10)
