"""Runs one command: its module, its errors as sentences, its exit status, signals turned into exceptions."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType

import typer

from drivers.errors import DeviceError, LimitError
from instrument.cli.commands import Command
from instrument.files.errors import BenchError, in_words

DEBUG_VARIABLE = "DIFFUSERBENCH_DEBUG"
INTERRUPTED = 130
# What typer raises for wrong options; its public subclass is the stable way to name it.
_UsageError: type[Exception] = typer.BadParameter.__mro__[1]


class Terminated(SystemExit):
    """The process was asked to end (SIGTERM, SIGHUP): raised in the main thread so that contexts close."""


def run_command(name: str, command: Command, arguments: Sequence[str], *, debug: bool = False) -> int:
    """Run a command with its arguments and return the exit status."""
    debug = debug or os.environ.get(DEBUG_VARIABLE, "") not in ("", "0")
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    _end_on_signals()
    try:
        # Not through typer's own main, which would answer Ctrl-C itself before a word is said about it.
        parser = typer.main.get_command(command.load())
        with parser.make_context(f"diffuserbench {name}", list(arguments)) as context:
            parser.invoke(context)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | Terminated):
            _be_silent_about_half_made_objects()
        if debug and not isinstance(error, _UsageError | typer.Abort | typer.Exit | SystemExit):
            raise
        return report(error)
    return 0


def _be_silent_about_half_made_objects() -> None:
    """Keep what an interrupted library says of its own half-made objects out of the user's sight.

    Ctrl-C in the middle of a compilation, say, leaves an object without the attribute that its ``__del__``
    releases. Python prints a traceback for that when the exception is let go, after everything was said.
    """
    if sys.unraisablehook is not sys.__unraisablehook__:
        return  # whoever runs this program watches by itself

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if not issubclass(unraisable.exc_type, AttributeError):
            sys.__unraisablehook__(unraisable)

    sys.unraisablehook = hook


def report(error: BaseException) -> int:
    """Say on stderr what went wrong and return the exit status; what is no known mistake is raised again."""
    if isinstance(error, typer.Exit):
        return error.exit_code
    if isinstance(error, _UsageError):
        error.show()  # type: ignore[attr-defined]
        return 2
    if isinstance(error, SystemExit):
        code = error.code if isinstance(error.code, int) else 1
        _say("stopped by a signal." if isinstance(error, Terminated) else "", error)
        return code
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        _say("interrupted.", error)
        return INTERRUPTED
    if isinstance(error, BenchError):
        _say(str(error), error)
        return error.exit_code
    if isinstance(error, DeviceError):
        _say(str(error), error)
        return 2 if isinstance(error, LimitError) else 1  # a value to put right, not a device that failed
    if sentence := in_words(error):
        _say(sentence, error)
        return 2
    raise error


def _say(text: str, error: BaseException) -> None:
    for line in (text, *getattr(error, "__notes__", ())):
        if line:
            sys.stderr.write(f"{line}\n")


def _end_on_signals() -> None:
    def end(number: int, _frame: FrameType | None) -> None:
        raise Terminated(128 + number)

    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        # A signal that the parent chose to ignore (nohup) stays ignored.
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)
