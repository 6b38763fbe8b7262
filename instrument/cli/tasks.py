"""The commands of tasks: what they take is declared, what they tell goes to the terminal."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Event
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from instrument.cli import COMMANDS
from instrument.cli.app import INTERRUPTED, App, examples
from instrument.cli.progress import first_interrupt_cancels, one_task
from instrument.tasks import TASKS
from instrument.tasks.task import Advance, Done, Printed, Task


def __getattr__(name: str) -> App:
    """Give the application of a command: of one task, or of several that are its sub-commands."""
    found = [words for words in TASKS if words.split()[0] == name]
    if not found:
        raise AttributeError(name)
    app = App("" if found == [name] else f"{COMMANDS[name].help.capitalize()}.")
    for words in found:
        task = TASKS[words].load()
        app.command(words.split()[-1], epilog=examples(*task.examples))(_function(task))
    return app


class Terminal(Printed):
    """Prints: results on stdout, what people should look at and progress on stderr."""

    def table(self, headings: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
        """Print it, numbers at the right."""
        shown = Table(title=title or None)
        for heading in headings:
            shown.add_column(heading, justify="right")
        for row in rows:
            shown.add_row(*row)
        Console().print(shown)

    @contextmanager
    def step(self, what: str, total: float | None = None, *, done: int = 0) -> Iterator[Advance]:
        """Show a bar."""
        with one_task(what, total, done=done) as advance:
            yield advance

    @contextmanager
    def interruptible(self) -> Iterator[Event]:
        """Let the first Ctrl-C set the event."""
        with first_interrupt_cancels() as cancel:
            yield cancel


def finish(done: Done) -> None:
    """Say what was written; exit code 130 where it was interrupted, 1 where not all is as it should be."""
    if done.files:
        typer.echo(f"{'Wrote':<12}{', '.join(map(str, done.files))}")
    if done.kept:
        typer.echo(done.kept, err=True)
        raise typer.Exit(INTERRUPTED)
    if not done.good:
        raise typer.Exit(1)


def _function(task: Task) -> Callable[..., None]:
    """Return a task as a command's function."""

    def run(**objects: Any) -> None:
        finish(task.do(Terminal(), **objects))

    run.__annotations__ = task.hints
    run.__doc__, run.__name__, run.__module__ = task.do.__doc__, task.do.__name__, task.do.__module__
    kind = inspect.Parameter.KEYWORD_ONLY
    parameters = [inspect.Parameter(name, kind, annotation=hint) for name, hint in task.hints.items()]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run
