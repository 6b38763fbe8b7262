"""The reference page of every options class, and the manual page.

``python -m instrument.cli.reference > docs/reference/options.md``
``python -m instrument.cli.reference --man > docs/diffuserbench.1``
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import typer

from instrument.cli import COMMANDS, EXAMPLES
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


_MAN = """\
.TH DIFFUSERBENCH 1 "" diffuserbench "User Commands"
.SH NAME
diffuserbench \\- runs a bench for computational optics: cameras behind a diffuser, holograms
.SH SYNOPSIS
.B diffuserbench
.RB [ \\-\\-debug ]
.I COMMAND
.RI [ OPTIONS ]
.SH DESCRIPTION
Without hardware it runs on the built-in simulated bench.
\\fBdiffuserbench\\fR \\fICOMMAND\\fR \\fB\\-\\-help\\fR says everything about one command.
.SH COMMANDS
{commands}
.SH EXAMPLES
.nf
{examples}
.fi
.SH FILES
.TP
.B bench.toml
The bench, in the working folder; \\fBdiffuserbench new\\fR writes one with every key explained.
.SH ENVIRONMENT
.TP
.B DIFFUSERBENCH_DEBUG
1: tracebacks of errors, as \\-\\-debug.
.SH EXIT STATUS
0 done, 1 a device or a check failed, 2 a mistake in what was asked, 130 interrupted.
.SH SEE ALSO
The documentation starts at docs/README.md of the source.
"""


def manual() -> str:
    """Return the manual page, roff, of the commands; their options are in each one's ``--help``."""

    def plain(text: str) -> str:
        return text.replace("-", "\\-")

    commands: list[str] = []
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        commands.append(f".SS {group}")
        of_it = ((name, command) for name, command in COMMANDS.items() if command.group == group)
        commands += [f".TP\n.B {plain(name)}\n{plain(command.help)}" for name, command in of_it]
    examples = "\n".join(plain(line) for line in EXAMPLES.splitlines()[1:])
    return _MAN.format(commands="\n".join(commands), examples=examples)


if __name__ == "__main__":
    sys.stdout.write(manual() if "--man" in sys.argv else page())
