"""Ctrl-C that cannot get lost, nor break off what is to be done whole."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

HELD_SIGNALS = 2
"""Signals that are held; the next one goes through, for the case that a device hangs."""


@contextlib.contextmanager
def ctrl_c_remembered() -> Iterator[Callable[[], None]]:
    """Remember that Ctrl-C was pressed while the block runs; gives what raises it again, between steps.

    Python raises KeyboardInterrupt wherever the main thread happens to be. Inside a callback from foreign
    code (a kernel being compiled, a library's clean-up) the exception is printed and dropped there, and the
    program goes on as if nothing had been pressed.

    Does nothing outside the main thread, where no signal arrives.
    """
    pressed = threading.Event()
    before: Any = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        pressed.set()
        if callable(before):
            before(number, frame)

    def check() -> None:
        if pressed.is_set():
            raise KeyboardInterrupt

    in_main = threading.current_thread() is threading.main_thread()
    if in_main:
        signal.signal(signal.SIGINT, note)
    try:
        yield check
    finally:
        if in_main and before is not None:
            signal.signal(signal.SIGINT, before)
    check()


class Held:
    """What came while signals were held."""

    def __init__(self) -> None:
        self.before: dict[int, Callable[[int, FrameType | None], Any]] = {}
        self.signals: list[tuple[int, FrameType | None]] = []

    def answer(self, *said: str) -> None:
        """Answer the first signal that was held, as it would have been: with an exception.

        What is to be ``said`` becomes notes of it.
        """
        if not self.signals:
            return
        number, frame = self.signals[0]
        try:
            self.before[number](number, frame)
        except BaseException as interruption:
            for words in said:
                interruption.add_note(words)
            raise


@contextlib.contextmanager
def interrupts_held() -> Iterator[Held]:
    """Hold Ctrl-C, SIGTERM and SIGHUP back until the block has ended; the caller may answer them then.

    For the last steps of an acquisition, which an impatient second Ctrl-C must not skip. Where a device hangs
    in one of them all the same, the third signal goes through.

    Does nothing outside the main thread, where no signal arrives.
    """
    held = Held()

    def hold(number: int, frame: FrameType | None) -> None:
        held.signals.append((number, frame))
        if len(held.signals) > HELD_SIGNALS:
            held.before[number](number, frame)

    in_main = threading.current_thread() is threading.main_thread()
    try:
        for name in ("SIGINT", "SIGTERM", "SIGHUP") if in_main else ():
            number = getattr(signal, name, None)
            # What kills the process or is ignored stays as it is.
            if number is not None and callable(handler := signal.getsignal(number)):
                held.before[number] = handler
                signal.signal(number, hold)
        yield held
    finally:
        # Ctrl-C last: from then on it breaks off what follows, and the others would stay held.
        for number, handler in reversed(held.before.items()):
            signal.signal(number, handler)
