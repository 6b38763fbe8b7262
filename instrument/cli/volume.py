"""``diffuserbench reconstruct --volume``: from PSFs at several depths and a photograph to a volume."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import typer

from instrument.cli.app import saying_what_is_left
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.cli.reconstruct_options import DEFAULT_VOLUME_ITERATIONS, Settings
from instrument.errors import BenchError
from instrument.reconstruction_file import Outputs
from instrument.volume_file import write_volume
from instrument.volume_job import volume_job
from recon.gpu.namespace import DEVICES
from recon.solvers.stopping import IterationRecord, StopReason
from recon.volume.channel import PRIORS
from recon.volume.reconstruct import reconstruct_volume


@dataclass(frozen=True, slots=True)
class VolumeOptions:
    """The options that only a volume has, and no picture."""

    background: bool
    scratch: Path | None
    memory_gib: float | None
    device: str


def reconstruct_to_volume(
    psfs: Path, image: Path, outputs: Outputs, options: VolumeOptions, settings: Settings
) -> None:
    """Reconstruct, tell, write; exit code 130 where it was interrupted."""
    device = next((d for d in DEVICES if d == options.device), None)
    if device is None:
        raise BenchError(f"--device {options.device!r} is not known; choose one of {', '.join(DEVICES)}.")
    prior = next((p for p in PRIORS if p == (settings.prior or "tv")), None)
    if prior is None:
        raise BenchError(f"--prior {settings.prior} is not for volumes; choose one of {', '.join(PRIORS)}.")
    outputs.check(0, overwrite=settings.force)
    limit = settings.limit(DEFAULT_VOLUME_ITERATIONS)
    with saying_what_is_left(*outputs.files()):
        job = volume_job(
            psfs,
            image,
            dark=settings.dark,
            crop=settings.crop,
            binning=settings.binning,
            erasures=settings.erasures,
        )
        for name, text in job.notes.items():
            typer.echo(f"{name:<12}{text}")
        if job.simulated:
            typer.echo("SIMULATED   PSFs or image come from the simulated bench")
        outputs.check(len(job.calibration.psfs) * job.measurement.size, overwrite=settings.force)
        with progress_bar() as bar, first_interrupt_cancels() as cancel:
            task = bar.add_task("volume", total=limit, note="")

            def show(record: IterationRecord, _volume: object) -> None:
                bar.update(task, completed=record.iteration, note=f"residual {record.data_residual:.3g}")

            result = reconstruct_volume(
                job.measurement,
                job.calibration,
                prior=prior,
                tau=settings.tau,
                model=settings.model,
                estimate_background=options.background,
                erasures=None if job.valid is None else ~job.valid,
                noise=job.binned_noise(settings.noise),
                scratch=options.scratch,
                memory_gib=options.memory_gib,
                device=device,
                iterations=limit,
                time_s=settings.time_s,
                tolerance=1e-3 if settings.tolerance is None else settings.tolerance,
                callback=show,
                cancel=cancel,
            )
        typer.echo(f"{'Model':<12}{result.model}: {result.reason}")
        typer.echo(f"{'Memory':<12}{result.provenance['memory']}")
        count = max(len(history) for history in result.histories)
        typer.echo(
            f"{'Stopped':<12}after {count} iterations, {result.seconds:.1f} s: {result.stop_reasons[0]}"
        )
        for warning in (*job.warnings, *result.warnings):
            typer.echo(f"Warning: {warning}", err=True)
        write_volume(outputs, result, job)
        typer.echo(f"{'Wrote':<12}{', '.join(map(str, outputs.files()))}")
    if StopReason.CANCELLED in result.stop_reasons:
        typer.echo(f"Interrupted after {count} iterations: this is the volume so far.", err=True)
        raise typer.Exit(130)
