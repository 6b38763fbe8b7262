"""``diffuserbench align mask``: find the scattering mask, bring it to its place, keep what is left."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibration_routines.display.display_procedures import AlignmentProcedure, refuse_existing
from calibration_routines.display.mask_alignment import AlignmentSettings
from instrument.cli.app import App, BenchOption, examples, open_and_say
from instrument.cli.sweeping import Told
from instrument.files.errors import BenchError

app = App("Align the holographic display.")


@app.callback()
def align() -> None:
    """Align the holographic display."""


@app.command(
    epilog=examples(
        "diffuserbench align mask --bench display.toml",
        "diffuserbench align mask --reach 30 --depth-um 300 --moves 0",
    )
)
def mask(
    bench: BenchOption = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FILE", help="The alignment (.json); a .png goes beside it."),
    ] = Path("alignment.json"),
    reach: Annotated[float, typer.Option("--reach", help="Largest shift to look for, mask pixels.")] = 72.0,
    depth_um: Annotated[float, typer.Option("--depth-um", help="Largest distance to look for.")] = 1000.0,
    moves: Annotated[int, typer.Option("--moves", min=0, help="Stage moves at most; 0: nothing moves.")] = 4,
    sections: Annotated[
        str, typer.Option("--sections", metavar="ROWSxCOLUMNS", help="Of the SLM, measured one by one.")
    ] = "3x5",
    max_frames: Annotated[int, typer.Option("--max-frames", min=10)] = 100,
    slm_calibration: Annotated[
        Path | None,
        typer.Option("--slm-calibration", metavar="FILE", help="From calibrate slm.", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False,
) -> None:
    """Find the mask's pose by spots on the camera, move the stage, and store what is left as an alignment.

    The camera must see the whole field of view. The search moves nothing. Then a small move and back tells
    which way the stage's axes go and how well it comes back (it is homed before); it takes out shift,
    distance, rotation and clear tilts until a move promises less than that. What stays is measured section
    by section. Give the file to hologram --alignment.
    """
    settings = AlignmentSettings(
        reach=reach, depth_um=depth_um, moves=moves, max_frames=max_frames, division=_division(sections)
    )
    procedure = AlignmentProcedure(
        settings=settings, slm_calibration=slm_calibration, out=out, overwrite=force
    )
    figure = out.with_suffix(".png")
    for file in (out, figure):
        refuse_existing(file, overwrite=force)
    with open_and_say(bench) as opened:
        procedure.outlook(opened)
        with _AlignmentTold() as told:
            done = procedure.carry_out(opened, listener=told)
    for line in (*done.verdict, f"Wrote {out}, {figure}"):
        typer.echo(line)


class _AlignmentTold(Told):
    """Says on stderr that the stage is homed, which takes a while and moves it."""

    def step(self, words: str) -> None:
        """Begin a bar of its own."""
        if words.startswith("homing"):
            typer.echo("Homing the stage.", err=True)
        super().step(words)


def _division(text: str) -> tuple[int, int]:
    try:
        rows, columns = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise BenchError(f"--sections {text!r}: write ROWSxCOLUMNS, for example 3x5.") from None
    return rows, columns
