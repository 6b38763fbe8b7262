"""``diffuserbench reconstruct RUN --video``: every frame of a recording, to OME-Zarr and MP4."""

from __future__ import annotations

import time

import typer

from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.files.formatting import duration
from instrument.reconstruction.video import (
    PreparedVideo,
    VideoRequest,
    finish_video,
    prepare_video,
    solve_video,
)
from instrument.reconstruction.video_work import BlockReport, require_crew


def reconstruct_to_video(
    request: VideoRequest, *, workers: int | None, scheduler: str | None, force: bool
) -> None:
    """Prepare or take up again, solve with a progress bar, finish; exit code 130 where interrupted."""
    require_crew(workers=workers, scheduler=scheduler)  # before anything is written
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
    complete = _solve(prepared, workers, scheduler)
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


def _solve(prepared: PreparedVideo, workers: int | None, scheduler: str | None) -> bool:
    total = len(prepared.job.plan.frames)
    before = _frames_done(prepared)
    began_s = time.monotonic()
    with progress_bar() as bar, first_interrupt_cancels() as cancel:
        task = bar.add_task("frames", total=total, completed=before, note="")
        done = before

        def advance(report: BlockReport) -> None:
            nonlocal done
            done += len(prepared.job.blocks[report.block])
            rate = (done - before) / max(time.monotonic() - began_s, 1e-9)
            bar.update(task, completed=done, note=f"{rate:.1f} frames/s")

        return solve_video(prepared, advance, cancel, workers=workers, scheduler=scheduler)


def _frames_done(prepared: PreparedVideo) -> int:
    blocks = prepared.job.blocks
    return sum(len(blocks[number]) for number in prepared.job.done())
