"""What all commands' options and help texts share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

BenchOption = Annotated[
    Path | None,
    typer.Option(
        "--bench",
        "-b",
        metavar="FILE",
        help="Bench configuration. Default: bench.toml in this folder, else the built-in simulated bench.",
        show_default=False,
    ),
]


def command_app(help_text: str = "") -> typer.Typer:
    """Return an empty app in the house style: plain help, no installer, errors left to ``main``."""
    return typer.Typer(
        help=help_text or None,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        no_args_is_help=bool(help_text),
        context_settings={"help_option_names": ["--help", "-h"], "max_content_width": 100},
    )


def examples(*lines: str) -> str:
    """Return the examples that end a command's help, one a line, as typer's ``epilog``."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)
