"""``diffuserbench calibrate dpc``: the diffuser's surface by differential phase contrast."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from calibration_routines.calibration_figures import surface_figure
from calibration_routines.dpc import DpcSetup, dpc_optics, dpc_plan, measure_diffuser
from instrument.acquire import abilities_of
from instrument.cli.app import BenchOption, examples, open_and_say
from instrument.cli.progress import one_task
from instrument.errors import BenchError
from instrument.figures import save_figure
from instrument.plan import check, estimate

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
    setup = DpcSetup(na, magnification, index, band, average, dark_frames)
    with open_and_say(bench) as opened:
        if opened.led_array is None:
            raise BenchError(f"{opened.label} has no [led_array].")
        optics = dpc_optics(opened, setup)
        plan = dpc_plan(opened.led_array, setup, opened.camera.exposure_ms)
        abilities = abilities_of(opened, out)
        check(plan, abilities)
        lit, frames = len(plan.parts[1].light[0].leds), estimate(plan, abilities).frames
        console.print(
            f"Plan: 4 half circles of {lit} LEDs up to NA {optics.illumination_na:.3g} (the objective's "
            f"{na:g}, and beyond, so that deflected light is not only lost), {frames} frames. "
            f"Pixels are {optics.pitch_um:.3g} um in the sample, at {optics.wavelength_nm:g} nm.",
            soft_wrap=True,
        )
        if dry_run:
            console.print("Dry run: no LED was lit.")
            return
        with one_task("Half circles") as advance:
            surface, file = measure_diffuser(
                opened, setup, out, on_progress=lambda status: advance(status.done, status.total)
            )
    picture = file.with_suffix(".png")
    save_figure(surface_figure(surface), picture)
    figures = surface.figures
    console.print(
        f"Height       {figures['height_rms_um']:.3g} um rms; slope {figures['slope_mean_deg']:.3g} degrees "
        f"on average; deflection half width {figures['deflection_hwhm_deg']:.3g}, largest "
        f"{figures['deflection_largest_deg']:.3g} degrees",
        soft_wrap=True,
    )
    console.print(f"Result       {escape(str(file))}", soft_wrap=True)
    console.print(f"Picture      {escape(str(picture))}", soft_wrap=True)
