"""What drivers, instrument and routines log, brought into the window's log panel."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable


class LogBridge(logging.Handler):
    """Hands on what is logged, in whatever thread, as a level of the log panel and a text.

    Parameters
    ----------
    tell : callable
        Called with both, in the thread that logs.
    """

    def __init__(self, tell: Callable[[str, str], object]) -> None:
        super().__init__(logging.INFO)
        self._tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        """Hand on a record."""
        level = {logging.WARNING: "warning", logging.ERROR: "error", logging.CRITICAL: "error"}.get(
            record.levelno, "info"
        )
        with contextlib.suppress(RuntimeError):  # the window is gone
            self._tell(level, f"{record.name}: {record.getMessage()}")
