"""Long commands: a progress bar on stderr with the time left (silent where it is no terminal), and Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
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


Advance = Callable[[float, float], None]
"""Takes how much is done, and how much there is to do."""


@contextmanager
def one_task(description: str) -> Iterator[Advance]:
    """Show the bar of a single task while the block runs; gives what advances it."""
    with progress_bar() as bar:
        task = bar.add_task(description, total=None, note="")

        def advance(done: float, total: float) -> None:
            bar.update(task, completed=done, total=total)

        yield advance
