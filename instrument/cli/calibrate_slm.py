"""``diffuserbench calibrate slm``: look-up table and flatness of the SLM from camera frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibration_routines.display.display_procedures import SlmProcedure, refuse_existing
from instrument.cli.app import BenchOption, examples, open_and_say
from instrument.cli.sweeping import Told

EPILOG = examples(
    "diffuserbench calibrate slm --bench display.toml",
    "diffuserbench calibrate slm --bench display.toml --alignment alignment.json",
)


def slm(
    bench: BenchOption = None,
    alignment: Annotated[
        Path | None,
        typer.Option(
            "--alignment", metavar="FILE", help="From align mask: measures flatness too.", show_default=False
        ),
    ] = None,
    levels: Annotated[int, typer.Option("--levels", min=8, max=256, help="Grey levels to measure.")] = 33,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The calibration (.json).")] = Path(
        "slm-calibration.json"
    ),
    force: Annotated[bool, typer.Option("--force", help="Overwrite a file that exists.")] = False,
) -> None:
    """Measure the SLM's phase against its grey levels, and with an alignment its flatness, by the camera.

    Half of the pixels interfere with the other half; neither mask nor optics need to be known for that. Give
    the file to align mask and show (--slm-calibration).
    """
    procedure = SlmProcedure(levels=levels, alignment=alignment, out=out, overwrite=force)
    refuse_existing(out, overwrite=force)
    with open_and_say(bench) as opened:
        procedure.outlook(opened)
        with Told() as told:
            done = procedure.carry_out(opened, listener=told)
    for line in (*done.verdict, f"Wrote {out}"):
        typer.echo(line)
