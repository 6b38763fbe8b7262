"""Long commands: a progress bar on stderr with the time left (none where it is no terminal), Ctrl-C, keys.

A step that cannot say how far it is goes by what it took last time, or takes elsewhere
(:mod:`instrument.files.kept_times`). What is compiled is said beside the bar.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from types import FrameType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from instrument.files import kept_times
from instrument.files.errors import duration
from instrument.tasks.task import Advance
from recon.base.compiling import being_compiled

_WIDE = 120  # characters of a terminal that has room for a long bar


def _whole() -> Column:
    """Return what a column is whose text is shown whole: in a narrow terminal the note gives way."""
    return Column(no_wrap=True)


class _Count(MofNCompleteColumn):
    """How much is done of how much; nothing where nobody can say."""

    def render(self, task: Task) -> Text:
        return Text() if task.total is None else super().render(task)


class _Left(TimeRemainingColumn):
    """The time left: by what is done; else by what such a step took last time, or takes elsewhere."""

    def render(self, task: Task) -> Text:
        expected: kept_times.Expected | None = task.fields.get("expected")
        if task.total is not None and (task.completed or expected is None):
            if task.time_remaining is None and task.completed and task.elapsed:  # the first step of several
                left_s = task.elapsed * (task.total / task.completed - 1)
                return Text(f"left about {duration(left_s)}")
            return Text("left ") + super().render(task)
        if expected is None or task.elapsed is None:
            return Text()
        if task.elapsed > expected.seconds:
            return Text(f"longer than {expected.by}, {duration(expected.seconds)}")
        return Text(f"about {duration(expected.seconds - task.elapsed)} left, as {expected.by}")


class _Note(ProgressColumn):
    """The task's note, or what is being compiled."""

    def __init__(self) -> None:
        super().__init__(Column(no_wrap=True, overflow="ellipsis", ratio=1))

    def render(self, task: Task) -> Text:
        now = being_compiled()
        return Text(f"compiling {now} (once)" if now else task.fields["note"])


def progress_bar() -> Progress:
    """Return a bar to be used as a context.

    Tasks have a field ``note``, shown at the end of the line, and may have ``expected``: how long they will
    take where they do not say how far they are.
    """
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}", table_column=_whole()),
        BarColumn(40 if console.width >= _WIDE else 12),
        _Count(table_column=_whole()),
        TimeElapsedColumn(table_column=_whole()),
        _Left(table_column=_whole()),
        _Note(),
        console=console,
        transient=True,
        expand=True,
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
    """Show the bar of a single task while the block runs; gives what advances it.

    Without a total, and until the first of it is done, it takes as long as last time.
    """
    whole = description if total is None else f"{description} of {total:g}"
    with progress_bar() as bar, nullcontext() if done else kept_times.kept(whole):
        expected = kept_times.expected(whole) or kept_times.expected(description, total or 1.0)
        task = bar.add_task(description, total=total, completed=done, note=note, expected=expected)

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
