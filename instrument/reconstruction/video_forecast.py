"""What a film will take, time and memory, by the first frames of some of its blocks, which are carried out.

As many blocks at a time as the film will have, on threads or on the workers that were asked for; each of them
has a second one, as a worker is slower at its first. What is written for it lies beside the film, and is
removed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import cycle, islice, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from instrument.files.errors import BenchError, count
from instrument.files.ome_zarr import stem_of
from instrument.reconstruction.forecast import TRIED, Forecast
from instrument.reconstruction.video import (
    PreparedVideo,
    VideoRequest,
    done_before,
    finish_video,
    prepare_video,
    require_request,
    solve_video,
    write_shown,
)
from instrument.reconstruction.video_job import VideoPlan
from instrument.reconstruction.video_work import BlockReport, at_once
from recon.solvers.memory import MemoryMeter

FRAMES = 4
"""Of each block that is tried: one that begins cold, and three that go on."""
SHOWN = 40
"""Pictures of an MP4 that tell what one takes: VP9 keeps 25 before it writes."""
ATTEMPTS = 2
"""That a trial has in which workers are lost."""


@dataclass(frozen=True)
class PreparedTrial:
    """A film prepared to be tried: nothing of it lies where the film will."""

    prepared: PreparedVideo
    seconds: float
    """That preparing took."""
    meter: MemoryMeter
    left: tuple[tuple[int, ...], ...]
    """The frames of each block that is still to be solved: all, unless it was begun before."""

    @property
    def frames_left(self) -> int:
        """How many they are."""
        return sum(map(len, self.left))


@contextmanager
def trial_of(request: VideoRequest, *, force: bool = False) -> Iterator[PreparedTrial]:
    """Give a film prepared in a folder of its own beside it, which is removed in the end.

    ``force``: what was begun before does not count.

    Raises FileError, BenchError or InputError as :func:`~instrument.reconstruction.video.prepare_video`,
    but for a film that is there.
    """
    require_request(request)
    meter, began_s = MemoryMeter(), time.perf_counter()
    with TemporaryDirectory(prefix=f".{stem_of(request.out)}.trial-", dir=request.out.parent) as folder:
        prepared = prepare_video(replace(request, out=Path(folder) / request.out.name))
        done = set() if force else done_before(request, prepared.job.plan)
        left = tuple(block for number, block in enumerate(prepared.job.blocks) if number not in done)
        yield PreparedTrial(prepared, time.perf_counter() - began_s, meter, left)


def forecast_video(
    trial: PreparedTrial,
    cancel: threading.Event | None = None,
    on_progress: Callable[[float], object] = lambda _: None,
) -> Forecast | None:
    """Carry out the first frames of some blocks, and say what all that is left takes; None when cancelled.

    ``on_progress`` is told the share that is over. Errors as of
    :func:`~instrument.reconstruction.video.solve_video`; BenchError where workers are lost again and again.
    """
    prepared, cancel = trial.prepared, cancel or threading.Event()
    job, video = prepared.job, prepared.request.video
    plan, left, frames = job.plan, trial.left, trial.frames_left
    together = plan.over_time is not None
    workers = at_once(max(len(left), 1), video, together=together)
    tried = _tried(left or job.blocks[:1], workers, together=together)
    asked = replace(plan, frames=tried)
    if together:
        asked = replace(asked, cold_iterations=min(plan.cold_iterations, TRIED))
    run = _undisturbed(trial, asked, cancel, on_progress)
    if run is None:
        return None
    times = plan.cold_iterations / asked.cold_iterations
    pace = _together(run.reports, times) if together else _one_by_one(run.reports)
    once_s, film_s = _finished(prepared, tried, len(plan.frames))
    film_s *= len(plan.frames)  # of all of it, whatever was done before
    frames_s = _longest(map(len, left), workers, pace) + film_s if left else 0.0
    beside_s = trial.seconds + once_s + (run.beside_s if left else film_s)
    elsewhere = video.workers is not None or video.scheduler is not None
    own = max(report.peak_bytes for report in run.reports)
    return Forecast(
        beside_s,
        frames_s / max(frames, 1),
        frames,
        own if elsewhere else trial.meter.peak_mib() * 2**20,
        settles=frames,
        counted=True,
        each="frame",
        where=f" in each of {count(workers, 'worker')}" if elsewhere else "",
    )


def _tried(blocks: Sequence[Sequence[int]], workers: int, *, together: bool) -> tuple[int, ...]:
    """Return the frames that are carried out: two blocks a worker, whole where their frames hang together."""
    if together:
        return tuple(index for block in blocks[: 2 * workers] for index in block)
    spread = np.linspace(0, len(blocks) - 1, 2 * workers).round().astype(int)
    return tuple(index for number in np.unique(spread) for index in blocks[number][:FRAMES])


@dataclass(frozen=True)
class _Solved:
    """Blocks that were solved, in this order, and what it took."""

    reports: list[BlockReport]
    seconds: float
    lost: int = 0
    """Workers whose blocks were begun anew: it took longer than it does."""

    @property
    def beside_s(self) -> float:
        """What nobody was at work: a cluster that begins and ends."""
        busy: dict[str, float] = {}
        for report in self.reports:
            busy[report.worker] = busy.get(report.worker, 0.0) + report.seconds
        return max(self.seconds - max(busy.values(), default=0.0), 0.0)


def _undisturbed(
    trial: PreparedTrial, plan: VideoPlan, cancel: threading.Event, on_progress: Callable[[float], object]
) -> _Solved | None:
    """Solve a shorter plan until no worker is lost in it; None when cancelled. Raises BenchError."""
    for _ in range(ATTEMPTS):
        run = _solved(trial, plan, cancel, on_progress)
        if cancel.is_set():
            return None
        if not run.lost:
            return run
    raise BenchError(
        "Workers were lost each time that the first frames were tried: what the film takes cannot be told. "
        "Take fewer workers, or try again when the machine is less busy."
    )


def _solved(
    trial: PreparedTrial, plan: VideoPlan, cancel: threading.Event, on_progress: Callable[[float], object]
) -> _Solved:
    """Solve the blocks of a shorter plan."""
    job, reports, lost = trial.prepared.job, list[BlockReport](), list[int]()
    job.go_on_without(plan, sorted(job.done()))
    began_s = time.perf_counter()

    def note(report: BlockReport) -> None:
        reports.append(report)
        on_progress(sum(one.solved for one in reports) / len(plan.frames))

    solve_video(trial.prepared, note, cancel, lost.append)
    return _Solved(reports, time.perf_counter() - began_s, sum(lost))


def _finished(prepared: PreparedVideo, frames: Sequence[int], n_frames: int) -> tuple[float, float]:
    """Finish what was solved; return what that takes of any film, and of each of its ``n_frames``.

    An encoder looks at many frames before it writes the first: pictures are shown again until they suffice.
    """
    request, each_s = prepared.request, 0.0
    began_s = time.perf_counter()
    if request.video.film:
        shown = min(n_frames, SHOWN)
        write_shown(prepared, frames[:1])
        one_s = time.perf_counter() - began_s
        write_shown(prepared, list(islice(cycle(frames), shown)))
        each_s = max(time.perf_counter() - began_s - 2 * one_s, 0.0) / max(shown - 1, 1)
        began_s = time.perf_counter() - one_s
    without = replace(request, video=replace(request.video, film=False))
    finish_video(replace(prepared, request=without))
    return time.perf_counter() - began_s, each_s


Pace = Callable[[int, bool], float]
"""Seconds that a block of so many frames takes, the first of its worker or not."""


def _one_by_one(reports: list[BlockReport]) -> Pace:
    """Return how long blocks take whose frames go on from one another."""
    seen: set[str] = set()
    first, later = list[BlockReport](), list[BlockReport]()
    for report in reports:
        (later if report.worker in seen else first).append(report)
        seen.add(report.worker)
    first_s = float(np.mean([report.frame_s[0] for report in first]))
    used = later or first  # the first frames of a worker are slow ones
    cold_s = float(np.mean([report.frame_s[0] for report in used]))
    steps = [b - a for report in used for a, b in pairwise(report.frame_s)]
    warm_s = float(np.median(steps)) if steps else 0.0  # a block's third frame takes longer than the rest
    end_s = float(np.mean([report.seconds - report.frame_s[-1] for report in reports]))
    return lambda frames, is_first: (first_s if is_first else cold_s) + (frames - 1) * warm_s + end_s


def _together(reports: list[BlockReport], times: float) -> Pace:
    """Return how long blocks take whose frames are solved together, in so many times the iterations."""
    frame_s = float(np.mean([report.seconds / report.solved for report in reports]))
    return lambda frames, _is_first: times * frame_s * frames


def _longest(sizes: Iterator[int], workers: int, pace: Pace) -> float:
    """Return when the last block ends where each is taken by the worker that is free first."""
    ends = [0.0] * workers
    for size in sizes:
        free = int(np.argmin(ends))
        ends[free] += pace(size, ends[free] == 0)
    return max(ends)
