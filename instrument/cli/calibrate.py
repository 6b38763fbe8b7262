"""``diffuserbench calibrate``: measure what the reconstruction needs to know about the bench."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from calibration_routines import (
    AxialCalibration,
    AxialSweep,
    SweepExposures,
    axial_plan,
    calibrate_axial,
    check_sweep,
    expose_sweep,
    planes_needed,
)
from instrument.acquire import abilities_of
from instrument.bench import Bench
from instrument.cli import calibrate_slm
from instrument.cli.app import BenchOption, command_app, examples, open_and_say
from instrument.cli.progress import one_task
from instrument.errors import BenchError
from instrument.plan import estimate
from recon.types import Geometry

app = command_app("Measure point spread functions (PSFs), or how an SLM answers.")
_MAX_PLANES = 256


@app.callback()
def calibrate() -> None:
    """Measure what the reconstruction needs to know about the bench."""


app.command(epilog=calibrate_slm.EPILOG)(calibrate_slm.slm)


@app.command(
    epilog=examples(
        "diffuserbench calibrate axial --z-min 100 --z-max 300 --planes 12",
        "diffuserbench calibrate axial --z-min 300          one PSF, 300 mm in front of the diffuser",
    )
)
def axial(
    z_min: Annotated[float, typer.Option("--z-min", metavar="MM", help="Nearest plane, from the diffuser.")],
    z_max: Annotated[
        float | None,
        typer.Option("--z-max", metavar="MM", help="Farthest plane; left out: one PSF at --z-min."),
    ] = None,
    planes: Annotated[
        int | None,
        typer.Option(help="Number of planes, evenly spaced in 1/z; left out: as many as the optics need."),
    ] = None,
    average: Annotated[int, typer.Option(help="Frames a plane.")] = 4,
    dark_frames: Annotated[
        int, typer.Option(help="Dark frames at the shortest and longest exposure each.")
    ] = 4,
    x: Annotated[float, typer.Option(metavar="MM", help="Lateral place of the source.")] = 0.0,
    y: Annotated[float, typer.Option(metavar="MM", help="Lateral place of the source.")] = 0.0,
    target: Annotated[
        float, typer.Option(help="Level of each PSF's 99.9th percentile, as a fraction of full scale.")
    ] = 0.7,
    dct: Annotated[
        int,
        typer.Option(metavar="N", help="Remove the N x N lowest DCT coefficients (stray light); 0: none."),
    ] = 0,
    binning: Annotated[int, typer.Option(help="Software binning, on top of the camera's.")] = 1,
    by_hand: Annotated[
        bool, typer.Option("--by-hand", help="The source was placed by hand at --z-min; nothing moves.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Where the run's folder goes; left out: the bench's data folder."
        ),
    ] = None,
    bench: BenchOption = None,
) -> None:
    """Move the point source along the axis and measure one PSF a plane.

    Finds the exposures without saturating, takes dark frames, sweeps, judges every PSF in words, takes bad
    planes again, and saves the calibration in the run's folder. Ends with the light off.
    """
    console = Console()
    with open_and_say(bench) as opened:
        sweep = AxialSweep(
            z_min_um=1e3 * z_min,
            z_max_um=1e3 * (z_min if z_max is None else z_max),
            planes=_number_of_planes(console, planes, z_min, z_max, opened.geometry),
            x_um=1e3 * x,
            y_um=1e3 * y,
            average=average,
            dark_frames=dark_frames,
            target=target,
            dct_order=dct,
            binning=binning,
            by_hand=by_hand,
        )
        check_sweep(opened, sweep, out)
        if opened.stage is not None and not by_hand:
            with one_task("Homing the stage"):
                opened.stage.home()
        with one_task("Finding exposures"):
            exposures = expose_sweep(opened, sweep)
        describe_exposures(console, exposures)
        describe_plan(console, opened, sweep, exposures, out)
        with one_task("Sweeping") as advance:
            done = calibrate_axial(
                opened,
                sweep,
                out,
                exposures=exposures,
                on_progress=lambda status: advance(status.done, status.total),
            )
    describe_quality(console, done)
    console.print(f"Run          {escape(str(done.runs[0].path))}", soft_wrap=True)
    console.print(f"Calibration  {escape(str(done.path))}", soft_wrap=True)


def describe_exposures(console: Console, exposures: SweepExposures) -> None:
    """Print what auto-exposure found, and where it fell short."""
    for z_um, found in exposures.found:
        last = found.trace[-1]
        console.print(
            f"Exposure at {z_um / 1e3:.4g} mm: {found.exposure_ms:.4g} ms in {len(found.trace)} frames; "
            f"99.9th percentile at {last.level:.0%}, brightest pixel at {last.brightest:.0%} of full scale, "
            f"{last.saturated_pixels} saturated ({found.hot_pixels} hot pixels excepted).",
            soft_wrap=True,
        )
    for warning in exposures.warnings:
        console.print(f"Note: {escape(warning)}", soft_wrap=True)


def describe_plan(
    console: Console, bench: Bench, sweep: AxialSweep, exposures: SweepExposures, folder: Path | None
) -> None:
    """Print what the sweep will do and cost, before it starts."""
    plan = axial_plan(sweep, exposures.exposures_ms)
    cost = estimate(plan, abilities_of(bench, folder))
    depths = ", ".join(f"{z_um / 1e3:.4g}" for z_um in sweep.z_um)
    console.print(f"Planes (mm): {depths}", soft_wrap=True)
    lit = sweep.planes * sweep.average
    console.print(
        f"Plan: {sweep.planes} planes x {sweep.average} frames + {cost.frames - lit} dark frames "
        f"= {cost.frames} frames, {cost.total_bytes / 1e6:.0f} MB at most, "
        f"{cost.seconds:.0f} s of exposure and motion.",
        soft_wrap=True,
    )


def describe_quality(console: Console, done: AxialCalibration) -> None:
    """Print the verdict on every plane, or one line when all are good."""
    lowest = min(done.quality, key=lambda plane: plane.snr)
    if not done.findings:
        count = len(done.quality)
        verdict = [f"signal at least {lowest.snr:.0f} times the noise"]
        if count >= 4:  # fewer planes give no line to hold a centroid against
            verdict.append(
                f"centroids within {max(q.step_px for q in done.quality):.2f} pixels of their line in 1/z"
            )
        if count >= 2:
            verdict.append(f"support within {max(abs(q.scale_error) for q in done.quality):.1%} of 1 + d/z")
        console.print(
            f"Quality: {'all ' if count > 1 else ''}{count} PSF{'s' if count > 1 else ''} good. "
            f"No saturated pixel; {'; '.join(verdict)}.",
            soft_wrap=True,
        )
    for finding in done.findings:
        console.print(f"Quality: {escape(finding)}", soft_wrap=True)


def _number_of_planes(
    console: Console, planes: int | None, z_min_mm: float, z_max_mm: float | None, geometry: Geometry
) -> int:
    if planes is not None or z_max_mm is None or z_max_mm <= z_min_mm or z_min_mm <= 0:
        return planes if planes is not None else 1
    needed = planes_needed(1e3 * z_min_mm, 1e3 * z_max_mm, geometry)
    if needed > _MAX_PLANES:
        raise BenchError(
            f"From {z_min_mm:g} to {z_max_mm:g} mm these optics need {needed} planes, more than "
            f"{_MAX_PLANES}. Narrow the range, or say --planes."
        )
    console.print(
        f"{needed} planes: the edge of the pattern moves by up to 2 pixels from one to the next "
        "(Kuo 2020, Eq. 4.7). Choose another number with --planes.",
        soft_wrap=True,
    )
    return max(needed, 2)
