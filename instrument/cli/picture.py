"""``diffuserbench reconstruct`` without ``--volume``: from a PSF and a photograph to a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import typer

from instrument.cli.app import saying_what_is_left
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.cli.reconstruct_options import DEFAULT_ITERATIONS, Method, PriorName, Settings
from instrument.errors import BenchError
from instrument.reconstruction_file import Outputs, write_reconstruction
from instrument.reconstruction_job import Job, job_from_calibration, job_from_files, refocused
from recon import reconstruct as solve
from recon.result import Reconstruction
from recon.solvers.stopping import IterationRecord, StopReason


@dataclass(frozen=True, slots=True)
class PictureOptions:
    """The options that only a picture has, and no volume."""

    psf: Path | None
    calibration: Path | None
    z_mm: float | None
    method: Method
    rotate_deg: int
    allow_saturated: bool
    mixed_depth: bool


def reconstruct_to_picture(
    image: Path, outputs: Outputs, options: PictureOptions, settings: Settings
) -> None:
    """Reconstruct, tell, write; exit code 130 where it was interrupted."""
    outputs.check(0, overwrite=settings.force)
    with saying_what_is_left(*outputs.files()):
        job = _job(image, options, settings)
        outputs.check(job.measurement.size, overwrite=settings.force)
        for name, text in job.notes.items():
            typer.echo(f"{name:<12}{text}")
        if job.simulated:
            typer.echo("SIMULATED   PSF or image come from the simulated bench")
        for warning in job.warnings:
            typer.echo(f"Warning: {warning}", err=True)
        result = _solve(job, options, settings)
        _tell(result)
        _write(outputs, result, job, options.rotate_deg)
    if result.stop_reason is StopReason.CANCELLED:
        count = len(result.history)
        typer.echo(f"Interrupted after {count} iterations: this is the picture so far.", err=True)
        raise typer.Exit(130)


def _job(image: Path, options: PictureOptions, settings: Settings) -> Job:
    psf, calibration = options.psf, options.calibration
    if (psf is None) == (calibration is None):
        raise BenchError("Give either --psf FILE or --calibration FOLDER (one of them).")
    if calibration is not None:
        job = job_from_calibration(
            calibration,
            image,
            dark=settings.dark,
            crop=settings.crop,
            binning=settings.binning,
            erasures=settings.erasures,
        )
    else:
        assert psf is not None
        job = job_from_files(
            psf,
            image,
            dark=settings.dark,
            crop=settings.crop,
            binning=settings.binning,
            erasures=settings.erasures,
            allow_saturated=options.allow_saturated,
            allow_mixed_depth=options.mixed_depth,
        )
    return job if options.z_mm is None else refocused(job, 1e3 * options.z_mm)


def _solve(job: Job, options: PictureOptions, settings: Settings) -> Reconstruction:
    one_shot = options.method is Method.WIENER
    time_s = settings.time_s
    if one_shot and (settings.iterations, time_s, settings.tolerance) != (None, None, None):
        raise BenchError("wiener is one shot: --iterations, --time and --tolerance do not apply to it.")
    prior = settings.prior or (PriorName.NONE if one_shot else PriorName.TV)
    limit = settings.limit(DEFAULT_ITERATIONS)
    with progress_bar() as bar, first_interrupt_cancels() as cancel:
        # Whichever of count and time is nearer to its end drives the bar.
        task = bar.add_task(str(options.method), total=limit if limit is not None else 1000, note="")

        def show(record: IterationRecord, _picture: object) -> None:
            done = float(record.iteration)
            if time_s is not None:
                total = float(limit if limit is not None else 1000)
                done = max(done if limit is not None else 0.0, total * record.seconds / time_s)
            bar.update(task, completed=done, note=f"change {record.change:.1e}")

        return solve(
            job.measurement,
            job.calibration,
            z_um=None if options.z_mm is None else 1e3 * options.z_mm,
            model=settings.model,
            method=options.method.value,
            prior=prior.value,
            noise=job.binned_noise(settings.noise),
            tau=settings.tau,
            iterations=limit,
            time_s=time_s,
            erasures=None if job.valid is None else ~job.valid,
            tolerance=settings.tolerance,
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
