"""The table of commands.

A new command is one row here and one module that holds a ``typer.Typer`` called ``app``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Command(NamedTuple):
    """A row of the table; ``module`` is imported only when the command is used."""

    group: str
    help: str
    module: str


BENCH = "The bench"
RECONSTRUCTION = "Reconstruction"

COMMANDS: Mapping[str, Command] = {
    "new": Command(BENCH, "write a commented bench.toml (simulated by default)", "instrument.cli.new"),
    "check": Command(BENCH, "open every device of the bench and report on it", "instrument.cli.check"),
    "snap": Command(BENCH, "take a photograph", "instrument.cli.snap"),
    "reconstruct": Command(
        RECONSTRUCTION, "reconstruct the scene from a PSF and a photograph", "instrument.cli.reconstruct"
    ),
}
