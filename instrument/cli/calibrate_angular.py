"""``diffuserbench calibrate angular``: the sensor's response to light from the side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from calibration_routines import SweepExposures
from calibration_routines.optics.optics_procedures import AngularProcedure
from calibration_routines.psf.sweep_procedure import exposure_lines
from instrument.cli.app import BenchOption, examples, open_and_say
from instrument.cli.numbers import finite
from instrument.cli.sweeping import Told, print_lines

EPILOG = examples(
    "diffuserbench calibrate angular --dry-run",
    "diffuserbench calibrate angular",
    "diffuserbench calibrate angular --largest 20 --step 2 --emission bead",
    "diffuserbench calibrate lateral --z 300 --response runs/..._angular-sweep/angular_response.json",
)


def angular(
    z: Annotated[
        float | None,
        typer.Option(
            "--z",
            metavar="MM",
            callback=finite,
            help="Distance of the source; left out: the farthest that spans the angles.",
        ),
    ] = None,
    largest: Annotated[
        float, typer.Option("--largest", metavar="DEG", callback=finite, help="Largest angle.")
    ] = 45.0,
    step: Annotated[
        float, typer.Option("--step", metavar="DEG", callback=finite, help="Between angles.")
    ] = 3.0,
    emission: Annotated[
        str,
        typer.Option(
            "--emission",
            metavar="pinhole|bead",
            help="Flat source facing the sensor, or fluorescent bead.",
        ),
    ] = "pinhole",
    average: Annotated[int, typer.Option(help="Frames a place.")] = 4,
    dark_frames: Annotated[int, typer.Option(help="Dark frames at two exposures each.")] = 4,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Where the run's folder goes; left out: the bench's."),
    ] = None,
    bench: BenchOption = None,
) -> None:
    """Move the point source sideways and measure the sensor's angular response and its 20 % cut-off angles.

    Writes angular_response.json (for calibrate lateral and volume) and a picture into the run's folder.
    """
    console = Console()
    procedure = AngularProcedure(
        z_um=None if z is None else 1e3 * z,
        largest_deg=largest,
        step_deg=step,
        emission=emission,
        average=average,
        dark_frames=dark_frames,
    )
    with open_and_say(bench) as opened:
        outlook = procedure.outlook(opened, out)
        print_lines(console, outlook.reasons)
        assert outlook.cost is not None  # of a plan
        console.print(
            f"Plan: {outlook.cost.frames} frames, {outlook.cost.seconds:.0f} s of exposure and motion."
        )
        if dry_run:
            console.print("Dry run: nothing moved.")
            return
        with _AngularTold(console) as told:
            done = procedure.carry_out(opened, out, listener=told)
    file, picture = done.files
    print_lines(console, done.verdict)
    console.print(f"Response     {escape(str(file))}", soft_wrap=True)
    console.print(f"Picture      {escape(str(picture))}", soft_wrap=True)


class _AngularTold(Told):
    """Prints the exposures before the source moves."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def exposures(self, found: SweepExposures) -> None:
        """Print them."""
        self.pause()
        print_lines(self._console, exposure_lines(found))
        self.step("moving the source")
