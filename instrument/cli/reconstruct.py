"""``diffuserbench reconstruct``: from a PSF and a photograph to the scene."""

from __future__ import annotations

import enum
import math
import re
from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import command_app, examples, saying_what_is_left
from instrument.cli.noise_option import parse_noise
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.erasures import Choice
from instrument.errors import BenchError
from instrument.preparation import Crop
from instrument.reconstruction_file import Outputs, write_reconstruction
from instrument.reconstruction_job import (
    DarkChoice,
    Job,
    job_from_calibration,
    job_from_files,
    refocused,
)
from recon import NoiseModel
from recon import reconstruct as solve
from recon.result import Reconstruction
from recon.solvers.stopping import IterationRecord, StopReason
from recon.volume.model import MODELS, ModelName

app = command_app()

DEFAULT_ITERATIONS = 300


class Method(enum.StrEnum):
    """The methods of :func:`recon.reconstruct`."""

    ADMM = "admm"
    ADMM_SENSOR = "admm-sensor"
    ADMM_GPU = "admm-gpu"
    FISTA = "fista"
    WIENER = "wiener"


class PriorName(enum.StrEnum):
    """The priors of :func:`recon.reconstruct`."""

    TV = "tv"
    TV_ISOTROPIC = "tv-isotropic"
    TV_HAAR = "tv-haar"
    L1 = "l1"
    NONNEGATIVE = "nonnegative"
    NONE = "none"


class Rotation(enum.StrEnum):
    """By how much the written picture is turned, degrees counter-clockwise."""

    NONE = "0"
    QUARTER = "90"
    HALF = "180"
    THREE_QUARTERS = "270"


@app.command(
    epilog=examples(
        "diffuserbench reconstruct --psf psf.tif --image raw.tif",
        "diffuserbench reconstruct --psf psf.tif --image raw.tif --dark dark.tif --bin 4 --out hand.tif",
        "diffuserbench reconstruct --psf psf.npy --image raw.npy --method fista --prior l1 --time 30",
        "diffuserbench reconstruct --psf psf.tif --image raw.tif --method wiener --tau 0.01",
        "diffuserbench reconstruct --volume psfs/ --image raw.tif --out volume.tif",
        "diffuserbench reconstruct --calibration demo/calibration --image photo.tif --z-mm 30 --rotate 180",
        "diffuserbench reconstruct --calibration field/ --image photo.tif --model local",
    )
)
def reconstruct(
    image: Annotated[Path, typer.Option("--image", "-i", metavar="FILE", help="The photograph (raw frame).")],
    psf: Annotated[
        Path | None, typer.Option("--psf", "-p", metavar="FILE", help="The PSF image.", show_default=False)
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            "-c",
            metavar="FOLDER",
            help="Instead of --psf: a calibration, or a run with one.",
            show_default=False,
        ),
    ] = None,
    volume: Annotated[
        Path | None,
        typer.Option(
            "--volume",
            metavar="FOLDER|STACK",
            help="A volume: PSFs, one a depth (folder, stack or calibration).",
            show_default=False,
        ),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            "--model",
            metavar="auto|convolution|local|lowrank",
            help="Camera model; local, lowrank: PSFs from several places of the field. auto: by their PSFs.",
        ),
    ] = "auto",
    background: Annotated[
        bool,
        typer.Option(
            "--background/--no-background", help="Of a volume: estimate a smooth background as well."
        ),
    ] = True,
    z_mm: Annotated[
        float | None,
        typer.Option(
            "--z-mm",
            metavar="MM",
            help="Distance of the scene; a PSF is refocused to it.",
            show_default=False,
        ),
    ] = None,
    dark: Annotated[
        str,
        typer.Option(
            "--dark", metavar="FILE|COUNTS|auto", help="Dark frame or offset; auto estimates the offset."
        ),
    ] = "auto",
    crop: Annotated[
        str | None,
        typer.Option(
            "--crop",
            metavar="T,L,H,W|HxW",
            help="Window in pixels, of PSF and image; HxW is centred.",
            show_default=False,
        ),
    ] = None,
    binning: Annotated[
        str,
        typer.Option("--bin", metavar="N|auto", help="Average N x N pixels; auto: to at most 0.5 megapixel."),
    ] = "auto",
    erasures: Annotated[
        str,
        typer.Option(
            "--erasures",
            metavar="none|saturated|FILE|SHARE",
            help="Pixels to leave out: saturated ones, a mask's zeros, or a random share.",
        ),
    ] = "saturated",
    noise: Annotated[
        str | None,
        typer.Option(
            "--noise",
            metavar="COUNTS|READ,GAIN",
            help="Camera noise: one deviation, or read noise in counts and counts per electron. "
            "Default: estimated.",
            show_default=False,
        ),
    ] = None,
    scratch: Annotated[
        Path | None,
        typer.Option(
            "--scratch",
            metavar="FOLDER",
            help="Of a volume: where to keep what does not fit into memory, on a fast disk.",
            show_default=False,
        ),
    ] = None,
    memory_gib: Annotated[
        float | None,
        typer.Option(
            "--memory",
            metavar="GIB",
            help="Of a volume: memory that may be taken. Default: what is free.",
            show_default=False,
        ),
    ] = None,
    method: Annotated[
        Method,
        typer.Option(
            "--method",
            "-m",
            help="admm: best; admm-sensor: dense scenes; admm-gpu: on a GPU; fista: plain; wiener: one shot.",
        ),
    ] = Method.ADMM,
    prior: Annotated[
        PriorName | None,
        typer.Option(
            "--prior", help="What the scene is like. Default: tv; none for wiener.", show_default=False
        ),
    ] = None,
    tau: Annotated[
        float | None,
        typer.Option(
            "--tau",
            metavar="X",
            help="Weight of the prior, relative to the data. Default: from the noise.",
            show_default=False,
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            "--iterations",
            "-n",
            min=1,
            metavar="N",
            help=f"At most N iterations. Default: {DEFAULT_ITERATIONS}, or none with --time.",
            show_default=False,
        ),
    ] = None,
    time_s: Annotated[
        float | None,
        typer.Option("--time", min=0.0, metavar="S", help="At most S seconds.", show_default=False),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            "--tolerance",
            min=0.0,
            metavar="X",
            help="Stop when the relative change falls below X. Default: 2e-3 (fista: 5e-4).",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="float32 TIFF (volumes: or .ome.zarr); .png and .json go beside it.",
        ),
    ] = Path("reconstruction.tif"),
    rotate: Annotated[
        Rotation,
        typer.Option("--rotate", help="Turn the picture counter-clockwise, degrees; 180 if upside down."),
    ] = Rotation.NONE,
    figure: Annotated[
        Path | None,
        typer.Option(
            "--figure", metavar="FILE", help="Also a summary figure (.png, .pdf, .svg).", show_default=False
        ),
    ] = None,
    device: Annotated[
        str,
        typer.Option(
            "--device", metavar="cpu|gpu", help="Of a volume: where to compute (pictures: --method admm-gpu)."
        ),
    ] = "cpu",
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False,
    allow_saturated: Annotated[
        bool,
        typer.Option("--allow-saturated", help="Accept a PSF with much of its light in saturated pixels."),
    ] = False,
    mixed_depth: Annotated[
        bool, typer.Option("--mixed-depth", help="Accept PSF and image of different bit depth.")
    ] = False,
) -> None:
    """Reconstruct the scene from a PSF and a photograph: TIFF, PNG, JPEG, BMP or NumPy files from anywhere.

    Both must come from the same camera with the same region of interest and binning, 8 to 16 bit or float,
    grey or colour. Ctrl-C ends the work and keeps the picture so far; a second Ctrl-C gives it up.
    """
    outputs = Outputs.named(out, figure, volume=volume is not None)
    if volume is not None:
        pictures_only = {
            "--psf": psf is not None,
            "--calibration": calibration is not None,
            "--z-mm": z_mm is not None,
            "--method": method is not Method.ADMM,
            "--rotate": rotate is not Rotation.NONE,
            "--figure": figure is not None,
            "--allow-saturated": allow_saturated,
            "--mixed-depth": mixed_depth,
        }
        if given := [option for option, is_given in pictures_only.items() if is_given]:
            raise BenchError(f"With --volume these do not apply: {', '.join(given)}. Leave them out.")
        from instrument.cli.volume import reconstruct_to_volume

        reconstruct_to_volume(
            volume,
            image,
            outputs,
            model=model,
            prior=None if prior is None else prior.value,
            background=background,
            dark=_dark(dark),
            crop=None if crop is None else Crop.parse(crop),
            binning=_binning(binning),
            erasures=_erasures(erasures),
            noise=parse_noise(noise),
            scratch=scratch,
            memory_gib=memory_gib,
            device=device,
            tau=tau,
            iterations=iterations,
            time_s=time_s,
            tolerance=tolerance,
            force=force,
        )
        return
    for_volumes = {
        "--no-background": not background,
        "--scratch": scratch is not None,
        "--memory": memory_gib is not None,
        "--device": device != "cpu",
    }
    for option, is_given in for_volumes.items():
        if is_given:
            raise BenchError(f"{option} is for volumes: give --volume, or leave it out.")
    chosen_model = next((m for m in MODELS if m == model), None)
    if chosen_model is None:
        raise BenchError(f"--model {model!r} is not known; choose one of {', '.join(MODELS)}.")
    outputs.check(0, overwrite=force)
    with saying_what_is_left(*outputs.files()):
        job = _job(
            psf,
            calibration,
            image,
            _dark(dark),
            None if crop is None else Crop.parse(crop),
            _binning(binning),
            _erasures(erasures),
            allow_saturated=allow_saturated,
            mixed_depth=mixed_depth,
        )
        if z_mm is not None:
            job = refocused(job, 1e3 * z_mm)
        outputs.check(job.measurement.size, overwrite=force)
        for name, text in job.notes.items():
            typer.echo(f"{name:<12}{text}")
        if job.simulated:
            typer.echo("SIMULATED   PSF or image come from the simulated bench")
        for warning in job.warnings:
            typer.echo(f"Warning: {warning}", err=True)
        result = _solve(
            job, chosen_model, method, prior, parse_noise(noise), tau, iterations, time_s, tolerance, z_mm
        )
        _tell(result)
        _write(outputs, result, job, int(rotate))
    if result.stop_reason is StopReason.CANCELLED:
        count = len(result.history)
        typer.echo(f"Interrupted after {count} iterations: this is the picture so far.", err=True)
        raise typer.Exit(130)


def _job(
    psf: Path | None,
    calibration: Path | None,
    image: Path,
    dark: DarkChoice,
    crop: Crop | None,
    binning: int | None,
    erasures: Choice,
    *,
    allow_saturated: bool,
    mixed_depth: bool,
) -> Job:
    if (psf is None) == (calibration is None):
        raise BenchError("Give either --psf FILE or --calibration FOLDER (one of them).")
    if calibration is not None:
        return job_from_calibration(
            calibration, image, dark=dark, crop=crop, binning=binning, erasures=erasures
        )
    assert psf is not None
    return job_from_files(
        psf,
        image,
        dark=dark,
        crop=crop,
        binning=binning,
        erasures=erasures,
        allow_saturated=allow_saturated,
        allow_mixed_depth=mixed_depth,
    )


def _dark(text: str) -> DarkChoice:
    if text == "auto":
        return "auto"
    try:
        counts = float(text)
    except ValueError:
        return Path(text)
    if not math.isfinite(counts):
        raise BenchError(f"--dark {text}: the offset must be a finite number of counts.")
    return counts


def _erasures(text: str) -> Choice:
    if text == "none":
        return "none"
    if text == "saturated":
        return "saturated"
    try:
        return float(text)
    except ValueError:
        return Path(text)


def _binning(text: str) -> int | None:
    if text == "auto":
        return None
    if not re.fullmatch(r"[1-9]\d*", text):
        raise BenchError(f"--bin {text!r} is not understood; write a whole number from 1, or auto.")
    return int(text)


def _solve(
    job: Job,
    model: ModelName,
    method: Method,
    prior: PriorName | None,
    noise: NoiseModel | float | None,
    tau: float | None,
    iterations: int | None,
    time_s: float | None,
    tolerance: float | None,
    z_mm: float | None,
) -> Reconstruction:
    one_shot = method is Method.WIENER
    if one_shot and (iterations, time_s, tolerance) != (None, None, None):
        raise BenchError("wiener is one shot: --iterations, --time and --tolerance do not apply to it.")
    chosen = prior or (PriorName.NONE if one_shot else PriorName.TV)
    limit = iterations if iterations is not None or time_s is not None else DEFAULT_ITERATIONS
    with progress_bar() as bar, first_interrupt_cancels() as cancel:
        # Whichever of count and time is nearer to its end drives the bar.
        task = bar.add_task(str(method), total=limit if limit is not None else 1000, note="")

        def show(record: IterationRecord, _picture: object) -> None:
            done = float(record.iteration)
            if time_s is not None:
                total = float(limit if limit is not None else 1000)
                done = max(done if limit is not None else 0.0, total * record.seconds / time_s)
            bar.update(task, completed=done, note=f"change {record.change:.1e}")

        return solve(
            job.measurement,
            job.calibration,
            z_um=None if z_mm is None else 1e3 * z_mm,
            model=model,
            method=method.value,
            prior=chosen.value,
            noise=job.binned_noise(noise),
            tau=tau,
            iterations=limit,
            time_s=time_s,
            erasures=None if job.valid is None else ~job.valid,
            tolerance=tolerance,
            callback=show,
            cancel=cancel,
        )


def _write(outputs: Outputs, result: Reconstruction, job: Job, rotate_deg: int) -> None:
    write_reconstruction(outputs, result, job, rotate_deg=rotate_deg)
    if outputs.figure is not None:
        from instrument.reconstruction_figure import write_figure  # matplotlib, only where it is wanted

        write_figure(outputs.figure, result, job, rotate_deg=rotate_deg)
    typer.echo(f"{'Wrote':<12}{', '.join(map(str, outputs.files()))}")


def _tell(result: Reconstruction) -> None:
    weight = "" if result.tau is None else f", tau {result.tau:.3g}"
    if "model" in result.provenance:
        typer.echo(f"{'Model':<12}{result.provenance['model']}: {result.provenance['model_reason']}")
    typer.echo(f"{'Method':<12}{result.method}, prior {result.prior}{weight}")
    count = len(result.history)
    if not count:
        typer.echo(f"{'Done':<12}in one step, {result.seconds:.1f} s")
    else:
        each = f"{result.seconds / count * 1e3:.0f} ms each"
        typer.echo(
            f"{'Stopped':<12}after {count} iterations, {result.seconds:.1f} s ({each}): {result.stop_reason}"
        )
    for warning in result.warnings:
        typer.echo(f"Warning: {warning}", err=True)
