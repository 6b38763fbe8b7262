"""The reference page of every options class.

``python -m instrument.cli.reference > docs/reference/options.md``
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import typer

from instrument.cli import COMMANDS
from instrument.cli.app import App
from recon.base.option_text import table

_INTRODUCTION = """\
# Options

Every option is declared once, as a field of one of these classes: its flag on the command line, the
window's form, "Copy as Python", the record beside a result and this page say the same. In Python numbers are
in the unit that the name ends in; the command line takes the unit that its metavar names. Choices that can
be added to are listed as far as they are installed.

This page is written by `python -m instrument.cli.reference > docs/reference/options.md`.
"""


def page() -> str:
    """Return the page: a table a class, in the order of the commands that take them."""
    takers: dict[type, list[str]] = {}
    for words, callback in _commands():
        for cls in getattr(callback, "options_classes", ()):
            takers.setdefault(cls, []).append(words)
    parts = [_INTRODUCTION]
    for cls, commands in takers.items():
        summary = (cls.__doc__ or "").strip().splitlines()[0]
        taken = ", ".join(f"`diffuserbench {words}`" for words in commands)
        parts.append(
            f"## {cls.__name__}\n\n{summary}\n\n`{cls.__module__}`; taken by {taken}.\n\n{table(cls)}"
        )
    return "\n".join(parts)


def _commands() -> Iterator[tuple[str, object]]:
    for name, entry in COMMANDS.items():
        app: App = entry.load()
        parsed = typer.main.get_command(app)
        inner = getattr(parsed, "commands", None)
        if inner is None:
            yield name, parsed.callback
        else:
            yield from ((f"{name} {word}", command.callback) for word, command in inner.items())


if __name__ == "__main__":
    sys.stdout.write(page())
