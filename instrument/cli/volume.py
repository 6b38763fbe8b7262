"""``diffuserbench reconstruct --volume``: from PSFs at several depths and a photograph to a volume."""

from __future__ import annotations

from pathlib import Path

import typer

from instrument.cli.app import saying_what_is_left
from instrument.cli.picture import tell_choice
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.cli.verdict import tell_verdict
from instrument.files.plane_steps import uneven_steps
from instrument.reconstruction.kept_request import checkpoint_for, settle_checkpoint
from instrument.reconstruction.request import VolumeRequest
from instrument.reconstruction.result_file import Outputs
from instrument.reconstruction.volume_file import write_volume
from recon.solvers.stopping import IterationRecord, StopReason


def reconstruct_to_volume(
    request: VolumeRequest,
    outputs: Outputs,
    *,
    checkpoint: Path | None,
    force: bool,
    explain: bool = False,
) -> None:
    """Reconstruct, tell, write; exit code 130 where it was interrupted. ``explain``: only say what with."""
    if explain:
        tell_choice(request.explain(request.prepare()))
        return
    outputs.check(0, overwrite=force)
    limit = request.settings.limit
    with saying_what_is_left(*outputs.files()):
        job = request.prepare()
        for name, text in job.notes.items():
            typer.echo(f"{name:<12}{text}")
        if job.simulated:
            typer.echo("SIMULATED   PSFs or image come from the simulated bench")
        outputs.check(len(job.calibration.psfs) * job.measurement.size, overwrite=force)
        keeper = checkpoint_for(checkpoint, job, request)
        with progress_bar() as bar, first_interrupt_cancels() as cancel:
            task = bar.add_task("volume", total=limit, note="")

            def show(record: IterationRecord, _volume: object) -> None:
                bar.update(task, completed=record.iteration, note=f"residual {record.data_residual:.3g}")

            result = request.solve(job, watch=show, cancel=cancel, keeper=keeper)
        if result.choice is not None:
            for line in result.choice.brief():
                typer.echo(line)
        else:
            typer.echo(f"{'Model':<12}{result.model}: {result.reason}")
        if memory := result.provenance.get("memory"):
            typer.echo(f"{'Memory':<12}{memory}")
        count = max(len(history) for history in result.histories)
        typer.echo(
            f"{'Stopped':<12}after {count} iterations, {result.seconds:.1f} s: {result.stop_reasons[0]}"
        )
        tell_verdict(result.verdict)
        for warning in (*job.warnings, *result.warnings):
            typer.echo(f"Warning: {warning}", err=True)
        write_volume(outputs, result, job)
        if steps := uneven_steps(result.grid.z_um):
            typer.echo(f"{'Planes':<12}{steps} Each plane's depth is in {outputs.record.name}.")
        typer.echo(f"{'Wrote':<12}{', '.join(map(str, outputs.files()))}")
        for name, text in settle_checkpoint(keeper, result.stop_reasons).items():
            typer.echo(f"{name:<12}{text}")
    if StopReason.CANCELLED in result.stop_reasons:
        typer.echo(f"Interrupted after {count} iterations: this is the volume so far.", err=True)
        raise typer.Exit(130)
