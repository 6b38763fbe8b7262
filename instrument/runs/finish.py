"""The one way out of every acquisition, and Ctrl-C that cannot get lost nor break it off."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

from instrument.bench.bench import Bench
from instrument.bench.safety import StepsFailedError, note_failures, try_all
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import LOG, RunError
from instrument.runs.writer import RunWriter

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

    def answer(self) -> None:
        """Answer the first signal that was held, as it would have been: with an exception."""
        if self.signals:
            number, frame = self.signals[0]
            self.before[number](number, frame)


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

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)
            # What kills the process or is ignored stays as it is.
            if number is not None and callable(handler := signal.getsignal(number)):
                held.before[number] = handler
                signal.signal(number, hold)
    try:
        yield held
    finally:
        for number, handler in held.before.items():
            signal.signal(number, handler)


def end_run(bench: Bench, writer: RunWriter, reason: FinishReason, error: BaseException | None) -> Run:
    """Make the bench safe (light off, motion stopped), then finish the run: both tried whatever happens.

    ``writer``: closed afterwards. ``error``: what ended the acquisition. It gets notes on what failed here
    and on where the run is, and stays the error that matters, also when Ctrl-C is pressed meanwhile.

    Raises StepsFailedError or RunError when something failed here and there is no ``error`` to note it on:
    the bench could not be made safe, or the run's end not be written. Raises KeyboardInterrupt or SystemExit
    when it was asked for meanwhile and there is no ``error``; everything was done before.

    Returns
    -------
    Run
        For reading.
    """
    with interrupts_held() as held:
        run = _end(bench, writer, reason, error)
    if error is None:
        try:
            held.answer()
        except BaseException as interruption:
            interruption.add_note(_where(writer))
            raise
    return run


def _end(bench: Bench, writer: RunWriter, reason: FinishReason, error: BaseException | None) -> Run:
    text = "" if error is None else str(error) or type(error).__name__
    ended: list[Run] = []
    try:
        try_all(
            [
                ("bench made safe", bench.stop),
                ("run finished", lambda: ended.append(writer.finish(reason, text))),
            ]
        )
    except StepsFailedError as failure:
        first, *others = (problem for _, problem in failure.failures)
        if error is None:
            for other in others:
                note_failures(first, other)
            first.add_note(_where(writer))
            raise first from None
        for problem in (first, *others):
            note_failures(error, problem)
    if error is not None:
        error.add_note(_where(writer))
    if ended:
        return ended[0]
    try:
        return Run.open(writer.path)
    except RunError:
        if error is None:
            raise
        raise error from None  # nothing hides it


def _where(writer: RunWriter) -> str:
    if not (writer.path / LOG).exists():
        return f"What was acquired was in {writer.path}, which is gone or moved."
    return f"What was acquired is in {writer.path}"
