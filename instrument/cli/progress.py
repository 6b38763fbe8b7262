"""Long commands: a progress bar on stderr with the time left (none where it is no terminal), Ctrl-C, keys."""

from __future__ import annotations

import os
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from instrument.tasks.task import Advance


def progress_bar() -> Progress:
    """Return a bar to be used as a context; tasks may have a field ``note``, shown at the end of the line."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


@contextmanager
def first_interrupt_cancels() -> Iterator[threading.Event]:
    """Give an event that the first Ctrl-C sets; the second raises KeyboardInterrupt as ever."""
    cancel = threading.Event()

    def on_interrupt(_number: int, _frame: FrameType | None) -> None:
        if cancel.is_set():
            raise KeyboardInterrupt
        cancel.set()

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield cancel
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def one_task(
    description: str, total: float | None = None, *, done: int = 0, note: str = ""
) -> Iterator[Advance]:
    """Show the bar of a single task while the block runs; gives what advances it."""
    with progress_bar() as bar:
        task = bar.add_task(description, total=total, completed=done, note=note)

        def advance(done: float, total: float | None = None, *, note: str | None = None) -> None:
            bar.update(task, completed=done, total=total)
            if note is not None:
                bar.update(task, note=note)

        yield advance


@contextmanager
def keys(actions: Mapping[str, Callable[[], None]]) -> Iterator[None]:
    """Call an action when its key is pressed; does nothing where stdin is no terminal.

    The actions are called in a thread of their own. Ctrl-C keeps its meaning.
    """
    if not sys.stdin.isatty():
        yield
        return
    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)
    done = threading.Event()

    def watch() -> None:
        while not done.is_set():
            ready, _, _ = select.select([handle], [], [], 0.1)
            if not ready:
                continue
            # Past Python's buffer, in which further keys would wait unseen by select.
            pressed = os.read(handle, 1).decode("latin-1").lower()
            if not pressed:  # the terminal is gone
                return
            if pressed in actions:
                actions[pressed]()

    thread = threading.Thread(target=watch, name="keys", daemon=True)
    try:
        tty.setcbreak(handle)
        thread.start()
        yield
    finally:
        done.set()
        thread.join()
        termios.tcsetattr(handle, termios.TCSADRAIN, before)
