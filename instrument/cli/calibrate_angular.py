"""``diffuserbench calibrate angular``: the sensor's response to light from the side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from calibration_routines.angular import AngularSweep, Emission, farthest_um, measure_angular_response
from calibration_routines.angular_response import CUT_OFF, AngularResponse
from calibration_routines.calibration_figures import response_figure
from calibration_routines.sweep_plan import check_sweep
from instrument.acquire import abilities_of
from instrument.cli.app import BenchOption, examples, open_and_say
from instrument.cli.numbers import finite
from instrument.cli.progress import one_task
from instrument.cli.sweeping import describe_exposures
from instrument.errors import BenchError
from instrument.figures import save_figure
from instrument.plan import estimate

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
    kind: Emission = "bead" if emission == "bead" else "pinhole"
    if kind != emission:
        raise BenchError(f"--emission is pinhole or bead, not {emission!r}.")
    # Mistakes show before the bench opens; the distance may follow from its stage.
    blank = AngularSweep(1.0 if z is None else 1e3 * z, largest, step, kind, average, dark_frames)
    blank.points()
    with open_and_say(bench) as opened:
        z_um = farthest_um(opened, largest) if z is None else 1e3 * z
        sweep = replace(blank, z_um=z_um)
        points = sweep.points()
        cost = estimate(check_sweep(opened, points, out), abilities_of(opened, out))
        console.print(
            f"Plan: {len(points.points_um)} places at z = {z_um / 1e3:.4g} mm, up to +-{largest:g} degrees "
            f"along x and y, {cost.frames} frames, {cost.seconds:.0f} s of exposure and motion. "
            + ("" if z is not None else "The farthest from which the stage spans the angles."),
            soft_wrap=True,
        )
        if dry_run:
            console.print("Dry run: nothing moved.")
            return
        if opened.stage is not None:
            with one_task("Homing the stage"):
                opened.stage.home()
        with one_task("Moving the source") as advance:
            response, file = measure_angular_response(
                opened,
                sweep,
                out,
                on_progress=lambda status: advance(status.done, status.total),
                on_exposures=lambda exposures: describe_exposures(console, exposures),
            )
    picture = file.with_suffix(".png")
    save_figure(response_figure(response), picture)
    _describe(console, response)
    console.print(f"Response     {escape(str(file))}", soft_wrap=True)
    console.print(f"Picture      {escape(str(picture))}", soft_wrap=True)


def _describe(console: Console, response: AngularResponse) -> None:
    for name, curve in (("x", response.along_x), ("y", response.along_y)):
        sides = curve.cut_offs_deg()
        words = []
        for sign, angle in zip("-+", sides, strict=True):
            end = curve.angles_deg[0 if sign == "-" else -1]
            value = curve.response[0 if sign == "-" else -1]
            words.append(
                f"{sign}{angle:.1f} degrees"
                if angle is not None
                else f"not reached on the {sign} side ({value:.0%} at {end:+.1f} degrees)"
            )
        console.print(
            f"Cut-off along {name} ({CUT_OFF:.0%} of the axis): {' and '.join(words)}", soft_wrap=True
        )
    for finding in response.findings:
        console.print(f"Quality: {escape(finding)}", soft_wrap=True)
