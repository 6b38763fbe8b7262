"""``diffuserbench reconstruct`` without ``--volume``: from a PSF and a photograph to a picture."""

from __future__ import annotations

from pathlib import Path

import typer

from instrument.cli.app import saying_what_is_left
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.cli.verdict import tell_verdict
from instrument.files.checkpoint import CheckpointFolder
from instrument.reconstruction.job import Job
from instrument.reconstruction.kept_request import checkpoint_for, settle_checkpoint
from instrument.reconstruction.request import PictureRequest
from instrument.reconstruction.result_file import Outputs, write_reconstruction
from recon.reconstruction.choice import Choice
from recon.reconstruction.result import Reconstruction
from recon.solvers.stopping import IterationRecord, StopReason


def reconstruct_to_picture(
    request: PictureRequest,
    outputs: Outputs,
    *,
    rotate_deg: int,
    checkpoint: Path | None,
    force: bool,
    explain: bool = False,
) -> None:
    """Reconstruct, tell, write; exit code 130 where it was interrupted. ``explain``: only say what with."""
    if explain:
        tell_choice(request.explain(request.prepare()))
        return
    outputs.check(0, overwrite=force)
    with saying_what_is_left(*outputs.files()):
        job = request.prepare()
        outputs.check(job.measurement.size, overwrite=force)
        for name, text in job.notes.items():
            typer.echo(f"{name:<12}{text}")
        if job.simulated:
            typer.echo("SIMULATED   PSF or image come from the simulated bench")
        for warning in job.warnings:
            typer.echo(f"Warning: {warning}", err=True)
        keeper = checkpoint_for(checkpoint, job, request)
        result = _solve(job, request, keeper)
        _tell(result)
        _write(outputs, result, job, rotate_deg)
        for name, text in settle_checkpoint(keeper, [result.stop_reason]).items():
            typer.echo(f"{name:<12}{text}")
    if result.stop_reason is StopReason.CANCELLED:
        count = len(result.history)
        typer.echo(f"Interrupted after {count} iterations: this is the picture so far.", err=True)
        raise typer.Exit(130)


def tell_choice(choice: Choice) -> None:
    """Print what was chosen and why, and what one step up and down would cost."""
    for line in choice.lines():
        typer.echo(line)
    typer.echo(
        f"{'Chosen in':<12}{choice.seconds:.1f} s; --choose NAME=VALUE overrules any of it, --tolerance and "
        "--iterations the end. Times and errors of a step are rough estimates"
    )


def _solve(job: Job, request: PictureRequest, keeper: CheckpointFolder | None) -> Reconstruction:
    with progress_bar() as bar, first_interrupt_cancels() as cancel:
        total = request.settings.limit or 1000
        task = bar.add_task(request.method, total=total, note="")

        def show(record: IterationRecord, _picture: object) -> None:
            done = round(total * request.share(record))
            bar.update(task, completed=done, note=f"change {record.change:.1e}")

        return request.solve(job, watch=show, cancel=cancel, keeper=keeper)


def _write(outputs: Outputs, result: Reconstruction, job: Job, rotate_deg: int) -> None:
    write_reconstruction(outputs, result, job, rotate_deg=rotate_deg)
    if outputs.figure is not None:
        from instrument.reconstruction.result_figure import (
            write_figure,  # matplotlib, only where it is wanted
        )

        write_figure(outputs.figure, result, job, rotate_deg=rotate_deg)
    typer.echo(f"{'Wrote':<12}{', '.join(map(str, outputs.files()))}")


def _tell(result: Reconstruction) -> None:
    weight = "" if result.tau is None else f", tau {result.tau:.3g}"
    if result.choice is not None:
        for line in result.choice.brief():
            typer.echo(line)
    else:
        typer.echo(f"{'Model':<12}{result.model}: {result.reason}")
    typer.echo(f"{'Method':<12}{result.solver}, prior {result.prior}{weight}")
    count = len(result.history)
    if not count:
        typer.echo(f"{'Done':<12}in one step, {result.seconds:.1f} s")
    else:
        each = f"{result.seconds / count * 1e3:.0f} ms each"
        typer.echo(
            f"{'Stopped':<12}after {count} iterations, {result.seconds:.1f} s ({each}): {result.stop_reason}"
        )
    tell_verdict(result.verdict)
    for warning in result.warnings:
        typer.echo(f"Warning: {warning}", err=True)
