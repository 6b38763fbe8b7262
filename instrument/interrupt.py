"""Ctrl-C that cannot get lost."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self


class CtrlC:
    """While its context lasts, remembers that Ctrl-C was pressed.

    Python raises KeyboardInterrupt wherever the main thread happens to be. Inside a callback from foreign
    code (a kernel being compiled, a library's clean-up) the exception is printed and dropped there, and the
    program goes on as if nothing had been pressed. ``check``, called between steps, raises it again.

    Does nothing outside the main thread, where no signal arrives.
    """

    def __init__(self) -> None:
        self.pressed = False
        self._previous: Any = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._previous = signal.getsignal(signal.SIGINT)
            signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)
        if exc is None:
            self.check()

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was pressed."""
        if self.pressed:
            raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.pressed = True
        if callable(self._previous):
            self._previous(number, frame)
