"""``diffuserbench align mask``: find the scattering mask, bring it to its place, keep what is left."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import typer

from calibration_routines.display.alignment_session import AlignmentSettings
from calibration_routines.display.display_procedures import AlignmentProcedure, refuse_existing
from instrument.cli.app import App, BenchOption, examples, open_and_say
from instrument.cli.sweeping import Told
from recon.base.declare import option

app = App("Align the holographic display.")


@dataclass(frozen=True, kw_only=True)
class AlignmentFiles:
    """What an alignment reads and writes."""

    out: Path = option(
        Path("alignment.json"),
        help="The alignment (.json); a .png goes beside it.",
        flags=("--out", "-o"),
        group="Files",
    )
    slm_calibration: Path | None = option(None, help="From calibrate slm.", group="Files")
    force: bool = option(False, help="Overwrite files that exist.", group="Files")


@app.callback()
def align() -> None:
    """Align the holographic display."""


@app.command(
    epilog=examples(
        "diffuserbench align mask --bench display.toml",
        "diffuserbench align mask --reach 30 --depth-um 300 --moves 0",
    )
)
def mask(settings: AlignmentSettings, files: AlignmentFiles, bench: BenchOption = None) -> None:
    """Find the mask's pose by spots on the camera, move the stage, and store what is left as an alignment.

    The camera must see the whole field of view. The search moves nothing. Then a small move and back tells
    which way the stage's axes go and how well it comes back (it is homed before); it takes out shift,
    distance, rotation and clear tilts until a move promises less than that. What stays is measured section
    by section. Give the file to hologram --alignment.
    """
    procedure = AlignmentProcedure(
        settings=settings, slm_calibration=files.slm_calibration, out=files.out, overwrite=files.force
    )
    figure = files.out.with_suffix(".png")
    for file in (files.out, figure):
        refuse_existing(file, overwrite=files.force)
    with open_and_say(bench) as opened:
        procedure.outlook(opened)
        with _AlignmentTold() as told:
            done = procedure.carry_out(opened, listener=told)
    for line in (*done.verdict, f"Wrote {files.out}, {figure}"):
        typer.echo(line)


class _AlignmentTold(Told):
    """Says on stderr that the stage is homed, which takes a while and moves it."""

    def step(self, words: str) -> None:
        """Begin a bar of its own."""
        if words.startswith("homing"):
            typer.echo("Homing the stage.", err=True)
        super().step(words)
