"""``diffuserbench reconstruct RUN --patterned SHEET``: one picture of a scene lit by patterns in turn."""

from __future__ import annotations

import typer

from instrument.cli.app import saying_what_is_left
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.reconstruction.patterned import PatternedRequest, prepare_patterned, solve_patterned
from instrument.reconstruction.result_file import Outputs, write_reconstruction
from recon.reconstruction.solve import ITERATIONS
from recon.solvers.stopping import IterationRecord, StopReason


def reconstruct_to_patterned(
    request: PatternedRequest, outputs: Outputs, *, rotate_deg: int, force: bool
) -> None:
    """Reconstruct the patterns, then the picture; tell, write; exit code 130 where it was interrupted."""
    outputs.check(0, overwrite=force)
    with saying_what_is_left(*outputs.files()):
        with progress_bar() as bar:
            sheet = bar.add_task("patterns", total=None, note="")
            prepared = prepare_patterned(
                request, lambda done, total: bar.update(sheet, completed=done, total=total)
            )
        job = prepared.job
        outputs.check(job.measurement.size, overwrite=force)
        for name, text in job.notes.items():
            typer.echo(f"{name:<12}{text}")
        if job.simulated:
            typer.echo("SIMULATED   calibration or frames come from the simulated bench")
        for warning in job.warnings:
            typer.echo(f"Warning: {warning}", err=True)
        with progress_bar() as bar, first_interrupt_cancels() as cancel:
            task = bar.add_task("picture", total=request.iterations or ITERATIONS, note="")

            def show(record: IterationRecord) -> None:
                bar.update(task, completed=record.iteration, note=f"change {record.change:.1e}")

            result = solve_patterned(prepared, watch=show, cancel=cancel)
        count = len(result.history)
        typer.echo(f"{'Stopped':<12}after {count} iterations, {result.seconds:.1f} s: {result.stop_reason}")
        write_reconstruction(outputs, result, job, rotate_deg=rotate_deg)
        typer.echo(f"{'Wrote':<12}{', '.join(map(str, outputs.files()))}")
    if result.stop_reason is StopReason.CANCELLED:
        typer.echo(
            f"Interrupted after {len(result.history)} iterations: this is the picture so far.", err=True
        )
        raise typer.Exit(130)
