"""A recording reconstructed frame by frame."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from instrument.files.errors import FileError, count, duration, os_reason
from instrument.reconstruction.options import InputOptions, OutputOptions, SourceOptions, VideoOptions
from instrument.reconstruction.video import (
    PreparedVideo,
    VideoRequest,
    finish_video,
    prepare_video,
    solve_video,
)
from instrument.reconstruction.video_forecast import forecast_video, trial_of
from instrument.reconstruction.video_work import BlockReport, require_crew
from instrument.tasks.task import Desk, Done, Only, task
from recon.base.declare import option
from recon.reconstruction.options import ReconstructionOptions

VIDEO = Path("video.ome.zarr")
"""Where a video goes when nothing else is said."""

LITTLE = 0.05
"""Share of a film's time that its model's choice may take without a word."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What is reconstructed."""

    run: Path = option(help="The recording's folder.", metavar="RUN", positional=True, group="Input")


@task(subject="video", out=VIDEO)
def video(
    desk: Desk,
    recording: Recording,
    source: Annotated[SourceOptions, Only("calibration", "psf")],
    output: Annotated[OutputOptions, Only("out", "rotate_deg", "explain", "force")],
    video: VideoOptions,
    inputs: InputOptions,
    options: ReconstructionOptions,
) -> Done:
    """Reconstruct every frame of a recording; one that was interrupted is taken up again."""
    request = VideoRequest(
        run=recording.run,
        out=output.out or VIDEO,
        psf=source.psf,
        calibration=source.calibration,
        inputs=inputs,
        options=options,
        video=video,
        rotate_deg=int(output.rotate_deg),
    )
    do = explain_video if output.explain else make_video
    return do(desk, request, force=output.force)


def explain_video(desk: Desk, request: VideoRequest, *, force: bool) -> Done:
    """Only say what with, and what time and memory what is left of it will take."""
    video = request.video
    require_crew(workers=video.workers, scheduler=video.scheduler, owner=video.scheduler_owner)
    with ExitStack() as kept:
        with desk.step("choosing"):
            trial = kept.enter_context(trial_of(request, force=force))
        _tell(desk, trial.prepared)
        if done := len(trial.prepared.job.plan.frames) - trial.frames_left:
            desk.fact("Resumed", f"{done} frames are done already")
        with desk.interruptible() as cancel, desk.step("the first frames", 100) as advance:
            told = forecast_video(trial, cancel, lambda share: advance(round(100 * share)))
    if told is None:
        return Done(kept="Interrupted: nothing is known of the time.")
    desk.fact("Will take", str(told))
    return Done()


def make_video(desk: Desk, request: VideoRequest, *, force: bool) -> Done:
    """Prepare or take up again, solve, finish."""
    video = request.video
    # Before anything is written:
    require_crew(workers=video.workers, scheduler=video.scheduler, owner=video.scheduler_owner)
    started_s = time.monotonic()
    prepared = prepare_video(request, force=force)
    preparing_s = time.monotonic() - started_s
    _tell(desk, prepared)
    if prepared.resumed:
        desk.fact("Resumed", f"{_frames_done(prepared)} frames are done already")
    began_s, before = time.monotonic(), _frames_done(prepared)
    with _told_what_is_kept(prepared):
        complete = _solve(desk, prepared)
    seconds, done = time.monotonic() - began_s, _frames_done(prepared)
    if done > before:
        rate = (done - before) / seconds
        desk.fact("Done", f"{done - before} frames in {duration(seconds)}: {rate:.1f} frames/s")
        if complete and not prepared.resumed and (cost := choice_in_words(prepared, preparing_s, seconds)):
            desk.fact("Choosing", cost)
    if not complete:
        total = len(prepared.job.plan.frames)
        kept = f"Interrupted: {done} of {total} frames are in {request.out}. "
        return Done(kept=f"{kept}The same command goes on with the rest.")
    if unlit := prepared.job.unlit():
        share = f"{unlit} of {len(prepared.job.plan.frames)} frames"
        desk.warn(f"Warning: {share} hold nothing but noise: was the scene lit?")
    with _told_what_is_kept(prepared), desk.step("film", len(prepared.job.plan.frames)) as advance:
        return Done(tuple(finish_video(prepared, advance)))


def choice_in_words(prepared: PreparedVideo, preparing_s: float, solving_s: float) -> str:
    """Say what a film paid for its model's being chosen; empty where that is little or nothing was chosen."""
    share = preparing_s / (preparing_s + solving_s)
    model = prepared.notes["Model"].partition(":")[0]
    if prepared.request.options.model != "auto" or model == "convolution" or share < LITTLE:
        return ""
    return (
        f"reading, and choosing a model by some frames, took {duration(preparing_s)}, {share:.0%} of it all: "
        f"what a short film pays, a longer one no more. --model {model} leaves it out."
    )


def _tell(desk: Desk, prepared: PreparedVideo) -> None:
    for name, text in prepared.notes.items():
        desk.fact(name, text)
    plan = prepared.job.plan
    if plan.settings["simulated"]:
        desk.say("SIMULATED   recording or PSF come from the simulated bench")
    how = (
        f"{plan.cold_iterations} iterations for the first of a block, {plan.warm_iterations} for the others"
        if plan.over_time is None
        else f"{plan.cold_iterations} iterations, prior over time {plan.over_time}"
    )
    blocks = f"{count(len(prepared.job.blocks), 'block')} of {plan.block}"
    desk.fact("Video", f"{len(plan.frames)} frames in {blocks}: {how}")
    for warning in prepared.warnings:
        desk.warn(f"Warning: {warning}")


def _solve(desk: Desk, prepared: PreparedVideo) -> bool:
    total = len(prepared.job.plan.frames)
    before = _frames_done(prepared)
    began_s = time.monotonic()
    with desk.interruptible() as cancel, desk.step("frames", total, done=before) as advance:
        done = before

        def on_progress(report: BlockReport) -> None:
            nonlocal done
            done += len(prepared.job.blocks[report.block])
            rate = (done - before) / max(time.monotonic() - began_s, 1e-9)
            advance(done, note=f"{rate:.1f} frames/s")

        return solve_video(prepared, on_progress, cancel)


@contextlib.contextmanager
def _told_what_is_kept(prepared: PreparedVideo) -> Iterator[None]:
    """Say with what the system refused (a full disk), or a signal that ends it, how much of it there is."""

    def there() -> str:
        done, total = _frames_done(prepared), len(prepared.job.plan.frames)
        return f"{done} of {total} frames are in {prepared.request.out}:"

    remedy = "the same command goes on with the rest."
    try:
        yield
    except OSError as error:
        raise FileError(
            error.filename or prepared.request.out, f"{os_reason(error)} {there()}", remedy
        ) from error
    except (KeyboardInterrupt, SystemExit) as ended:
        ended.add_note(f"{there()} {remedy}")
        raise


def _frames_done(prepared: PreparedVideo) -> int:
    blocks = prepared.job.blocks
    return sum(len(blocks[number]) for number in prepared.job.done())
