"""A reconstruction or a video on the terminal: what goes in, progress, result, its verdict, Ctrl-C."""

from __future__ import annotations

import time

import typer

from instrument.cli.progress import first_interrupt_cancels, one_task
from instrument.files.errors import duration
from instrument.files.volumes import uneven_steps
from instrument.reconstruction.checkpointing import checkpoint_for, settle_checkpoint
from instrument.reconstruction.job import Job
from instrument.reconstruction.options import OutputOptions
from instrument.reconstruction.patterned import PatternedRequest, prepare_patterned, solve_patterned
from instrument.reconstruction.request import PictureRequest, VolumeRequest
from instrument.reconstruction.result_file import Outputs, write_reconstruction, write_volume
from instrument.reconstruction.video import (
    PreparedVideo,
    VideoRequest,
    finish_video,
    prepare_video,
    solve_video,
)
from instrument.reconstruction.video_work import BlockReport, require_crew
from instrument.tasks.task import saying_what_is_left
from recon.reconstruction.choice import Choice
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import ITERATIONS
from recon.solvers.base import IterationRecord, StopReason
from recon.verdict.judge import Verdict


def reconstruct_photograph(
    request: PictureRequest | VolumeRequest, outputs: Outputs, output: OutputOptions
) -> None:
    """Reconstruct, tell, write; exit code 130 where it was interrupted. ``explain``: only say what with."""
    if output.explain:
        _print_choice(request.explain(request.prepare()))
        return
    outputs.check(0, overwrite=output.force)
    is_volume = isinstance(request, VolumeRequest)
    with saying_what_is_left(*outputs.files()):
        job = request.prepare()
        planes = len(job.calibration.psfs) if is_volume else 1
        outputs.check(planes * job.measurement.size, overwrite=output.force)
        _print_job(job, f"{'PSFs' if is_volume else 'PSF'} or image come from the simulated bench")
        keeper = checkpoint_for(output.checkpoint, job, request)
        what = "volume" if is_volume else "picture"
        with one_task(what, 100) as advance, first_interrupt_cancels() as cancel:

            def stage(share: float, what: str) -> None:
                advance(round(100 * share), note=what)

            result = request.solve(job, cancel=cancel, keeper=keeper, on_stage=stage)
        _print(result)
        if is_volume:
            write_volume(outputs, result, job)
            if steps := uneven_steps(result.grid.z_um):
                typer.echo(f"{'Planes':<12}{steps} Each plane's depth is in {outputs.record.name}.")
        else:
            _write_picture(outputs, result, job, int(output.rotate_deg))
        typer.echo(f"{'Wrote':<12}{', '.join(map(str, outputs.written(result)))}")
        for name, text in settle_checkpoint(keeper, result.stop_reasons).items():
            typer.echo(f"{name:<12}{text}")
    _end(result, what)


def reconstruct_patterns(request: PatternedRequest, outputs: Outputs, output: OutputOptions) -> None:
    """Reconstruct the patterns, then the picture; tell, write; exit code 130 where it was interrupted."""
    outputs.check(0, overwrite=output.force)
    with saying_what_is_left(*outputs.files()):
        with one_task("patterns") as advance:
            prepared = prepare_patterned(request, advance)
        job = prepared.job
        outputs.check(job.measurement.size, overwrite=output.force)
        _print_job(job, "calibration or frames come from the simulated bench")
        with (
            one_task("picture", request.options.iterations or ITERATIONS) as advance,
            first_interrupt_cancels() as cancel,
        ):

            def show(record: IterationRecord) -> None:
                advance(record.iteration, note=f"change {record.change:.1e}")

            result = solve_patterned(prepared, watch=show, cancel=cancel)
        _print_end(result)
        write_reconstruction(outputs, result, job, rotate_deg=int(output.rotate_deg))
        typer.echo(f"{'Wrote':<12}{', '.join(map(str, outputs.written(result)))}")
    _end(result, "picture")


def _print_choice(choice: Choice) -> None:
    """Print what was chosen and why, and what one step up and down would cost."""
    for line in choice.lines():
        typer.echo(line)
    typer.echo(
        f"{'Chosen in':<12}{choice.seconds:.1f} s; --choose NAME=VALUE overrules any of it, --tolerance and "
        "--iterations the end"
    )


def _print_verdict(verdict: Verdict | None) -> None:
    """Print the verdict, one sentence a line; nothing where none was asked for."""
    for index, sentence in enumerate(verdict.sentences if verdict is not None else ()):
        typer.echo(f"{'Verdict' if not index else '':<12}{sentence}")


def _print_job(job: Job, simulated: str) -> None:
    for name, text in job.notes.items():
        typer.echo(f"{name:<12}{text}")
    if job.simulated:
        typer.echo(f"SIMULATED   {simulated}")
    for warning in job.warnings:
        typer.echo(f"Warning: {warning}", err=True)


def _print(result: Reconstruction) -> None:
    weight = "" if result.tau is None else f", tau {result.tau:.3g}"
    if result.choice is not None:
        for line in result.choice.lines(steps=False):
            typer.echo(line)
    else:
        typer.echo(f"{'Model':<12}{result.model}: {result.reason}")
    if result.refinement is not None:
        typer.echo(f"{'Refined PSF':<12}{result.refinement}")
    typer.echo(f"{'Method':<12}{result.solver}, prior {result.prior}{weight}")
    if chosen := result.provenance.get("weight"):
        typer.echo(f"{'Weight':<12}{chosen}")
    if memory := result.provenance.get("memory"):
        typer.echo(f"{'Memory':<12}{memory}")
    _print_end(result)
    _print_verdict(result.verdict)
    if (found := result.uncertainty) is not None:
        for index, sentence in enumerate(found.sentences):
            typer.echo(f"{'Uncertainty' if not index else 'Points':<12}{sentence}")
    for warning in result.warnings:
        typer.echo(f"Warning: {warning}", err=True)


def _print_end(result: Reconstruction) -> None:
    count = _iterations(result)
    if not count:
        typer.echo(f"{'Done':<12}in one step, {result.seconds:.1f} s")
        return
    each = f"{result.seconds / count * 1e3:.0f} ms each"
    typer.echo(
        f"{'Stopped':<12}after {count} iterations, {result.seconds:.1f} s ({each}): {result.stop_reasons[0]}"
    )


def _iterations(result: Reconstruction) -> int:
    return max(len(history) for history in result.histories)


def _write_picture(outputs: Outputs, result: Reconstruction, job: Job, rotate_deg: int) -> None:
    write_reconstruction(outputs, result, job, rotate_deg=rotate_deg)
    if outputs.figure is not None:
        from instrument.reconstruction.result_figures import (
            write_figure,  # matplotlib, only where it is wanted
        )

        write_figure(outputs.figure, result, job, rotate_deg=rotate_deg)


def _end(result: Reconstruction, what: str) -> None:
    if StopReason.CANCELLED in result.stop_reasons:
        typer.echo(
            f"Interrupted after {_iterations(result)} iterations: this is the {what} so far.", err=True
        )
        raise typer.Exit(130)


def reconstruct_to_video(request: VideoRequest, *, force: bool) -> None:
    """Prepare or take up again, solve with a progress bar, finish; exit code 130 where interrupted."""
    video = request.video
    # Before anything is written:
    require_crew(workers=video.workers, scheduler=video.scheduler, owner=video.scheduler_owner)
    prepared = prepare_video(request, force=force)
    for name, text in prepared.notes.items():
        typer.echo(f"{name:<12}{text}")
    plan = prepared.job.plan
    if plan.settings["simulated"]:
        typer.echo("SIMULATED   recording or PSF come from the simulated bench")
    how = (
        f"{plan.cold_iterations} iterations for the first of a block, {plan.warm_iterations} for the others"
        if plan.over_time is None
        else f"{plan.cold_iterations} iterations, prior over time {plan.over_time}"
    )
    blocks = f"{len(prepared.job.blocks)} blocks of {plan.block}"
    typer.echo(f"{'Video':<12}{len(plan.frames)} frames in {blocks}: {how}")
    for warning in prepared.warnings:
        typer.echo(f"Warning: {warning}", err=True)
    if prepared.resumed:
        typer.echo(f"{'Resumed':<12}{_frames_done(prepared)} frames are done already")
    began_s, before = time.monotonic(), _frames_done(prepared)
    complete = _solve(prepared)
    seconds, done = time.monotonic() - began_s, _frames_done(prepared)
    if done > before:
        typer.echo(
            f"{'Done':<12}{done - before} frames in {duration(seconds)}: "
            f"{(done - before) / seconds:.1f} frames/s"
        )
    if not complete:
        typer.echo(
            f"Interrupted: {done} of {len(plan.frames)} frames are in {request.out}. "
            "The same command goes on with the rest.",
            err=True,
        )
        raise typer.Exit(130)
    if unlit := prepared.job.unlit():
        typer.echo(
            f"Warning: {unlit} of {len(plan.frames)} frames hold nothing but noise: was the scene lit?",
            err=True,
        )
    typer.echo(f"{'Wrote':<12}{', '.join(map(str, finish_video(prepared)))}")


def _solve(prepared: PreparedVideo) -> bool:
    total = len(prepared.job.plan.frames)
    before = _frames_done(prepared)
    began_s = time.monotonic()
    with one_task("frames", total, done=before) as advance, first_interrupt_cancels() as cancel:
        done = before

        def on_progress(report: BlockReport) -> None:
            nonlocal done
            done += len(prepared.job.blocks[report.block])
            rate = (done - before) / max(time.monotonic() - began_s, 1e-9)
            advance(done, note=f"{rate:.1f} frames/s")

        return solve_video(prepared, on_progress, cancel)


def _frames_done(prepared: PreparedVideo) -> int:
    blocks = prepared.job.blocks
    return sum(len(blocks[number]) for number in prepared.job.done())
