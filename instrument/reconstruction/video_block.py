"""A worker's part: one block of a video, from the recording's frames to pictures on the disk."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from instrument.reconstruction.video_job import VideoJob
from instrument.reconstruction.video_output import VideoPictures
from instrument.reconstruction.video_source import has_light
from instrument.runs.frame_array import FrameArray
from instrument.runs.run import FRAMES
from recon.base.threads import set_threads
from recon.streams.joint import solve_together
from recon.streams.video import Floats, VideoSolver

_kept = threading.local()
"""A thread's last job with its solver, whose arrays are dear to make: ``(folder, plan, job, solver)``."""


@dataclass(frozen=True, slots=True)
class BlockReport:
    """What a worker did: a block's number, how many frames it solved and wrote, and in how long.

    ``unlit`` is how many of its frames hold nothing but noise.
    """

    block: int
    solved: int
    written: int
    seconds: float
    unlit: int = 0


class CancelledError(Exception):
    """The block was left unfinished because somebody wanted the end."""


def solve_block(
    job_folder: str,
    output: str,
    number: int,
    *,
    threads: int | None = None,
    ended: Callable[[], bool] = lambda: False,
) -> BlockReport:
    """Solve a block, write those of its pictures that are not there, and note that it is done.

    Runs anywhere where the recording and the output are under the same paths. Done already, it does nothing.

    Parameters
    ----------
    job_folder, output : str
        The job's folder, and the OME-Zarr folder.
    number : int
        The block.
    threads : int, optional
        FFT and kernel threads of this process.
    ended : callable
        Asked before each frame; True ends the work.

    Raises
    ------
    FileError, OSError
        When a file cannot be read or written.
    CancelledError
    """
    began_s = time.perf_counter()
    if threads is not None:
        set_threads(threads)
    job = VideoJob(Path(job_folder))
    plan = job.plan
    if job.is_done(number):
        return BlockReport(number, 0, 0, time.perf_counter() - began_s)
    pictures = VideoPictures(Path(output), write=True)
    frames = FrameArray(Path(plan.run) / FRAMES)
    block = job.blocks[number]
    together_in = None if len(block) == 1 else plan.over_time
    written = 0
    unlit = 0

    def measured() -> Iterator[Floats]:
        nonlocal unlit
        reduction, deviation = job.reduction, job.problem.noise
        for index in block:
            frame = reduction.apply(frames.read(index))
            unlit += not has_light(frame, deviation)
            yield frame

    if together_in is None:
        job, solver = _solver_for(job)
        solved = _one_by_one(solver, measured())
    else:
        stack = np.stack(list(measured()))
        together = solve_together(
            job.problem, stack, together_in, iterations=plan.cold_iterations, ended=ended
        )
        solved = iter([] if together is None else together)
    for index in block:
        picture = None if ended() else next(solved, None)
        if picture is None:
            raise CancelledError
        if not pictures.is_written(index):
            pictures.write(index, np.ascontiguousarray(np.rot90(picture, plan.rotate_deg // 90)))
            written += 1
    job.mark_done(number, unlit)
    return BlockReport(number, len(block), written, time.perf_counter() - began_s, unlit)


def _one_by_one(solver: VideoSolver, frames: Iterable[Floats]) -> Iterator[Floats]:
    solver.begin()
    for frame in frames:
        yield solver.next(frame)


def _solver_for(job: VideoJob) -> tuple[VideoJob, VideoSolver]:
    kept: tuple[Path, object, VideoJob, VideoSolver] | None = getattr(_kept, "value", None)
    if kept is not None and kept[0] == job.folder and kept[1] == job.plan:
        return kept[2], kept[3]
    _kept.value = None  # its memory is needed
    solver = VideoSolver(
        job.problem,
        cold_iterations=job.plan.cold_iterations,
        warm_iterations=job.plan.warm_iterations,
    )
    _kept.value = (job.folder, job.plan, job, solver)
    return job, solver
