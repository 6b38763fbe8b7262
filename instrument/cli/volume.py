"""``diffuserbench reconstruct --volume``: from PSFs at several depths and a photograph to a volume."""

from __future__ import annotations

from pathlib import Path

import typer

from instrument.cli.app import saying_what_is_left
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.erasures import Choice
from instrument.errors import BenchError
from instrument.preparation import Crop
from instrument.reconstruction_file import Outputs
from instrument.reconstruction_job import DarkChoice
from instrument.volume_file import write_volume
from instrument.volume_job import volume_job
from recon.gpu.namespace import DEVICES
from recon.noise import NoiseModel
from recon.solvers.stopping import IterationRecord, StopReason
from recon.volume.channel import PRIORS
from recon.volume.model import MODELS
from recon.volume.reconstruct import reconstruct_volume

DEFAULT_ITERATIONS = 150


def reconstruct_to_volume(
    psfs: Path,
    image: Path,
    outputs: Outputs,
    *,
    model: str,
    prior: str | None,
    background: bool,
    dark: DarkChoice,
    crop: Crop | None,
    binning: int | None,
    erasures: Choice,
    noise: NoiseModel | float | None,
    scratch: Path | None,
    memory_gib: float | None,
    device: str,
    tau: float | None,
    iterations: int | None,
    time_s: float | None,
    tolerance: float | None,
    force: bool,
) -> None:
    """Reconstruct, tell, write; exit code 130 where it was interrupted."""
    chosen_model = next((m for m in MODELS if m == model), None)
    chosen_device = next((d for d in DEVICES if d == device), None)
    if chosen_device is None:
        raise BenchError(f"--device {device!r} is not known; choose one of {', '.join(DEVICES)}.")
    chosen_prior = next((p for p in PRIORS if p == (prior or "tv")), None)
    if chosen_model is None:
        raise BenchError(f"--model {model!r} is not known; choose one of {', '.join(MODELS)}.")
    if chosen_prior is None:
        raise BenchError(f"--prior {prior} is not for volumes; choose one of {', '.join(PRIORS)}.")
    outputs.check(0, overwrite=force)
    limit = iterations if iterations is not None or time_s is not None else DEFAULT_ITERATIONS
    with saying_what_is_left(*outputs.files()):
        job = volume_job(psfs, image, dark=dark, crop=crop, binning=binning, erasures=erasures)
        for name, text in job.notes.items():
            typer.echo(f"{name:<12}{text}")
        if job.simulated:
            typer.echo("SIMULATED   PSFs or image come from the simulated bench")
        outputs.check(len(job.calibration.psfs) * job.measurement.size, overwrite=force)
        with progress_bar() as bar, first_interrupt_cancels() as cancel:
            task = bar.add_task("volume", total=limit, note="")

            def show(record: IterationRecord, _volume: object) -> None:
                bar.update(task, completed=record.iteration, note=f"residual {record.data_residual:.3g}")

            result = reconstruct_volume(
                job.measurement,
                job.calibration,
                prior=chosen_prior,
                tau=tau,
                model=chosen_model,
                estimate_background=background,
                erasures=None if job.valid is None else ~job.valid,
                noise=job.binned_noise(noise),
                scratch=scratch,
                memory_gib=memory_gib,
                device=chosen_device,
                iterations=limit,
                time_s=time_s,
                tolerance=1e-3 if tolerance is None else tolerance,
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
