"""``diffuserbench calibrate dpc``: the diffuser's surface by differential phase contrast."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from calibration_routines.optics.dpc import DpcSetup
from calibration_routines.optics.optics_procedures import DpcProcedure
from instrument.cli.app import BenchOption, examples, open_and_say
from instrument.cli.sweeping import Told, print_lines

EPILOG = examples(
    "diffuserbench new microscope.toml --led-microscope",
    "diffuserbench calibrate dpc --bench microscope.toml --na 0.1 --magnification 4",
)


def dpc(
    na: Annotated[float, typer.Option("--na", help="Numerical aperture of the objective.")],
    magnification: Annotated[float, typer.Option("--magnification", help="From sample to camera.")],
    index: Annotated[float, typer.Option("--index", help="Refractive index of the diffuser.")] = 1.58,
    band: Annotated[
        str, typer.Option("--band", metavar="red|green|blue", help="Which LEDs to light.")
    ] = "green",
    average: Annotated[int, typer.Option(help="Frames a half circle.")] = 8,
    dark_frames: Annotated[int, typer.Option(help="Dark frames.")] = 8,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Where the run's folder goes; left out: the bench's."),
    ] = None,
    bench: BenchOption = None,
) -> None:
    """Measure the diffuser's phase and height in an LED array microscope, with slope and deflection.

    Lights the left, right, top and bottom half circles of the array. Writes dpc.json, the height (NumPy) and
    a picture into the run's folder.
    """
    console = Console()
    procedure = DpcProcedure(DpcSetup(na, magnification, index, band, average, dark_frames))
    with open_and_say(bench) as opened:
        outlook = procedure.outlook(opened, out)
        assert outlook.cost is not None  # of a plan
        print_lines(console, outlook.reasons)
        console.print(f"Plan: {outlook.cost.frames} frames.")
        if dry_run:
            console.print("Dry run: no LED was lit.")
            return
        with Told() as told:
            done = procedure.carry_out(opened, out, listener=told)
    file, picture = done.files
    print_lines(console, done.verdict)
    console.print(f"Result       {escape(str(file))}", soft_wrap=True)
    console.print(f"Picture      {escape(str(picture))}", soft_wrap=True)
