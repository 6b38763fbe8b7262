"""``diffuserbench calibrate beads``: PSFs over the field from photographs of bead slides, without a stage."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from calibration_routines.optics.beads import (
    BIN_FIRST,
    MANY_PX,
    BeadCalibration,
    BeadSlides,
    calibrate_beads,
    mean_images,
    needed_geometry,
    window_for,
)
from calibration_routines.optics.optics_procedures import BeadProcedure, bead_lines
from instrument.cli.app import BenchOption, examples, open_and_say
from instrument.cli.progress import progress_bar
from instrument.cli.sweeping import Told
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError, FileError
from instrument.files.images import read_image
from recon.blind import BlindSettings
from recon.types import Geometry

Images = np.ndarray[tuple[int, ...], np.dtype[np.float32]]

EPILOG = examples(
    "diffuserbench calibrate beads --z 2.5 --binning 4             photographs 9 slides, then solves",
    "diffuserbench calibrate beads --z 2.5 --binning 4 --dry-run   only says what it would do",
    "diffuserbench calibrate beads --z 2.5 slide-*.tif --pixel-um 11.6 --distance-mm 3.8 --window 221x221",
)


def beads(
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[IMAGE]...", help="Photographs of beads; left out: taken on the bench."),
    ] = None,
    z: Annotated[float, typer.Option("--z", metavar="MM", help="Depth of the slide.")] = 2.5,
    images: Annotated[int, typer.Option("--images", min=2, help="Photographs to take.")] = 9,
    average: Annotated[int, typer.Option(min=1, help="Frames a photograph.")] = 4,
    binning: Annotated[int, typer.Option(min=1, help="Software binning, on top of the camera's.")] = 1,
    psfs: Annotated[str, typer.Option("--psfs", metavar="RxC", help="Rows and columns of PSFs.")] = "5x5",
    rank: Annotated[
        int, typer.Option("--rank", min=1, help="Highest rank tried with beads on the pixel grid.")
    ] = 3,
    degree: Annotated[
        int,
        typer.Option(
            "--degree", min=0, max=2, help="How PSFs vary over the field in the end: 0 not, 1 linearly, 2."
        ),
    ] = 2,
    iterations: Annotated[int, typer.Option("--iterations", "-n", min=1, help="Of each half-step.")] = 60,
    tau: Annotated[float, typer.Option("--tau", help="Sparsity of the beads, relative.")] = 0.01,
    reach: Annotated[
        float, typer.Option("--reach", help="Part of the sensor's field that the PSFs span.")
    ] = 0.8,
    window: Annotated[
        str | None,
        typer.Option(
            "--window",
            metavar="HxW",
            help="Pixels that hold a PSF. Default: from the aperture.",
            show_default=False,
        ),
    ] = None,
    dark: Annotated[
        float | None,
        typer.Option("--dark", help="With files: the dark level, counts. Default: 0.", show_default=False),
    ] = None,
    pixel_um: Annotated[
        float | None, typer.Option("--pixel-um", help="With files: pixel pitch.", show_default=False)
    ] = None,
    distance_mm: Annotated[
        float | None,
        typer.Option("--distance-mm", help="With files: from diffuser to sensor.", show_default=False),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FOLDER", help="The calibration.")] = Path(
        "calibration-beads"
    ),
    force: Annotated[bool, typer.Option("--force", help="Replace a calibration that exists.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only check, and say what would be done; no frame is taken.")
    ] = False,
    bench: BenchOption = None,
) -> None:
    """Recover k x k PSFs from a few photographs of some twenty beads at unknown places: no stage is needed.

    Blind deconvolution under a rank constraint that is raised step by step (Kuo 2020, Eqs. 5.11-5.13).
    Between photographs the slide is moved by any amount: the operator is asked, or the simulated bench does
    it. Brightness and absolute place of the beads stay unknown: every PSF has unit light, their mean is
    centred.
    """
    given = {"--dark": dark, "--pixel-um": pixel_um, "--distance-mm": distance_mm}
    useless = [name for name, value in given.items() if value is not None]
    if useless and not files:
        raise BenchError(
            f"{' and '.join(useless)} go with image files; on the bench dark frames are taken and the "
            "geometry is that of bench.toml. Leave them out, or name the files."
        )
    if out.exists() and not force:
        raise FileError(out, "exists already.", "Choose another name, or replace it with --force.")
    slides = BeadSlides(
        z_um=1e3 * z,
        images=images,
        average=average,
        binning=binning,
        window_px=None if window is None else _size(window, "--window"),
        solver=BlindSettings(
            grid=_size(psfs, "--psfs"),
            ranks=tuple(range(1, rank + 1)),
            iterations=iterations,
            degree=degree,
            tau=tau,
            reach=reach,
        ),
    )
    if not files:
        procedure = BeadProcedure(slides=slides, out=out, overwrite=force)
        with open_and_say(bench) as opened:
            if dry_run:
                _say(procedure.outlook(opened).reasons)
                typer.echo("Dry run: no frame was taken, nothing was solved.")
                return
            simulated = bool(opened.simulated_kinds)
            with Told() as told:
                finished = procedure.carry_out(opened, listener=told)
        _tell(finished.verdict, simulated)
        typer.echo(f"Wrote {finished.calibration}: {psfs} PSFs at z = {z:g} mm")
        return
    taken, geometry, facts = _from_files(files, slides, dark or 0.0, pixel_um, distance_mm)
    slides = replace(slides, images=max(len(files), 2))
    if dry_run:
        _say_plan(slides, geometry, taken.shape, f"{len(files)} files, read and found alike")
        return
    done = _solved(taken, slides, geometry, facts)
    path = save_calibration(done.calibration, out, overwrite=force)
    _tell(bead_lines(done), bool(done.calibration.provenance.get("simulated")))
    typer.echo(f"Wrote {path}: {psfs} PSFs at z = {z:g} mm")


def _tell(lines: Sequence[str], simulated: bool) -> None:
    if simulated:
        typer.echo("SIMULATED: the photographs come from the simulated bench")
    _say(lines)


def _say(lines: Sequence[str]) -> None:
    for line in lines:
        typer.echo(line)


def _from_files(
    files: list[Path], slides: BeadSlides, dark: float, pixel_um: float | None, distance_mm: float | None
) -> tuple[Images, Geometry, dict[str, object]]:
    """Read the photographs; returns them with their geometry and where they come from."""
    if slides.binning > 1:
        raise BenchError("--binning is for photographs taken on the bench: bin the files beforehand.")
    read = [read_image(path) for path in files]
    taken = mean_images([image.pixels for image in read]) - np.float32(dark)
    facts = {"files": [str(path) for path in files], "simulated": any(i.is_simulated for i in read)}
    return taken, Geometry(pixel_pitch_um=pixel_um, diffuser_distance_mm=distance_mm), facts


def _say_plan(slides: BeadSlides, geometry: Geometry, shape: tuple[int, ...], what: str) -> None:
    """Print what would be done with files, with the numbers that follow from the optics."""
    needed_geometry(geometry)
    height, width = window_for(slides, geometry, (shape[1], shape[2]))
    rows, columns = slides.solver.grid
    typer.echo(f"{what}; {shape[1]} x {shape[2]} pixels")
    typer.echo(
        f"{rows} x {columns} PSFs of {height} x {width} pixels at z = {slides.z_um / 1e3:g} mm, over "
        f"{slides.solver.reach:.0%} of the sensor's field"
    )
    if shape[1] * shape[2] > MANY_PX:
        typer.echo(BIN_FIRST)
    typer.echo("Dry run: nothing was solved.")


def _solved(
    taken: Images, slides: BeadSlides, geometry: Geometry, facts: dict[str, object]
) -> BeadCalibration:
    quiet = not sys.stderr.isatty()
    before = ""

    with progress_bar() as bar:
        task = bar.add_task("Blind deconvolution", total=100, note="")

        def progress(what: str, share: float) -> None:
            nonlocal before
            bar.update(task, completed=round(100 * share), note=what)
            if quiet and what != before:  # a log has no bar, but should show that something goes on
                typer.echo(f"{share:4.0%} {what}", err=True)
                before = what

        return calibrate_beads(taken, slides, geometry, provenance=facts, progress=progress)


def _size(text: str, option: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if match is None:
        raise BenchError(f"{option} {text!r} is not understood; write rows x columns, as 5x5.")
    return int(match[1]), int(match[2])
