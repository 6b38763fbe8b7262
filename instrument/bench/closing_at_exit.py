"""Benches that are still open when the interpreter ends are closed: no light stays on, and the end comes."""

from __future__ import annotations

import atexit
import logging
import threading
import weakref
from typing import Protocol

_log = logging.getLogger(__name__)

EXIT_WAIT_S = 15.0
"""Closing a bench that answers takes a second or two; a move that has to be halted first, a few more."""


class _Closes(Protocol):
    """What is closed."""

    def close(self) -> None:
        """Make safe and close."""


class ClosingAtExit:
    """Closes what is still open at the end of the interpreter, within ``EXIT_WAIT_S`` seconds altogether.

    The closing is done in a thread, so that a driver that hangs does not keep the process from ending. It is
    started with the first bench, because none can be started while the interpreter ends (Python 3.12).
    """

    def __init__(self) -> None:
        self._open: weakref.WeakSet[_Closes] = weakref.WeakSet()
        self._begin, self._done = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def watch(self, bench: _Closes) -> None:
        """Close a bench at the end, unless it is forgotten before."""
        with self._lock:
            self._open.add(bench)
            if self._thread is None:
                self._thread = threading.Thread(target=self._wait, name="closing at exit", daemon=True)
                self._thread.start()
                atexit.register(self._end)

    def forget(self, bench: _Closes) -> None:
        """Do not close a bench at the end: it was closed."""
        with self._lock:
            self._open.discard(bench)

    def _wait(self) -> None:
        self._begin.wait()
        self._close_all()
        self._done.set()

    def _close_all(self) -> None:
        for bench in list(self._open):
            try:
                bench.close()
            except Exception as failure:  # noqa: BLE001 - the next bench is closed whatever this one raised
                _log.error("%s", failure)

    def _end(self) -> None:
        if not self._open:
            return
        if self._thread is None or not self._thread.is_alive():  # a forked child has no threads of its parent
            self._close_all()
            return
        self._begin.set()
        if not self._done.wait(EXIT_WAIT_S):
            _log.error(
                "A device did not answer within %g s while the program ended; the others may not be closed. "
                "See by eye that light and motion are off.",
                EXIT_WAIT_S,
            )
