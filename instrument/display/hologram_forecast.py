"""What a hologram will take, time and memory, by its first iterations: as a reconstruction is told."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from instrument.display.hologram import compute_and_judge
from instrument.reconstruction.forecast import SOLVED_S, Carried, Forecast, carried_out
from recon.holography import Display, Hologram, HologramOptions, HologramRecord, HologramStop, Target
from recon.holography.optimise import TOLERANCE
from recon.holography.target import Window
from recon.reconstruction.course import expected_iterations
from recon.solvers.base import IterationRecord
from recon.solvers.memory import MemoryMeter


@dataclass(frozen=True)
class _Trial(Carried):
    """A hologram that was computed and judged, or its first iterations."""

    found: Hologram


def forecast_hologram(
    display: Display,
    targets: Sequence[Target],
    options: HologramOptions,
    *,
    colours: int = 1,
    frames: int = 1,
    part: Window | None = None,
    on_progress: Callable[[float], object] = lambda _: None,
) -> Forecast:
    """Carry out the first iterations of a hologram, or all where that is soon; tell what all take.

    Parameters
    ----------
    display, targets, options, part
        As :func:`~instrument.display.hologram.compute_and_judge` takes them, of the first one.
    colours, frames : int
        How many are computed from a new start, and how many times, each from where the one before ended.
    on_progress : callable, optional
        Told the share that is over.
    """

    def carry(iterations: int, time_s: float, done: float, start: Hologram | None = None) -> _Trial:
        within = time_s if options.time_s is None else min(time_s, options.time_s)
        tried = replace(options, iterations=min(iterations, options.iterations), time_s=within)

        def tell(record: HologramRecord, _slm: object) -> None:
            share = max(record.iteration / tried.iterations, record.seconds / within)
            on_progress(done + (1 - done) * min(share, 1.0) / 2)

        meter, began_s = MemoryMeter(), time.perf_counter()
        initial = None if start is None else start.slm
        found = compute_and_judge(display, targets, tried, initial=initial, callback=tell, part=part).hologram
        took_s, taken = time.perf_counter() - began_s, meter.peak_mib() * 2**20
        counted_out = found.stop_reason is HologramStop.ITERATIONS and tried.iterations < options.iterations
        in_time = found.stop_reason is HologramStop.TIME and within != options.time_s
        return _Trial(took_s, taken, (found.history,), counted_out or in_time, found)

    trial = carried_out(lambda n, time_s, done: carry(n or options.iterations, time_s, done), SOLVED_S)
    each_s = trial.iteration_s
    one = Forecast(
        max(trial.seconds - trial.longest * each_s, 0.0),
        each_s,
        _most(trial, options),
        trial.memory_bytes,
        settles=_settles(trial, options) if trial.cut else trial.longest,
        counted=not trial.cut,
    )
    if colours * frames == 1:
        return one
    later_s = one.seconds
    if frames > 1:  # what limits them is not looked for again
        further = carry(max(trial.longest, 1), SOLVED_S, 0.5, trial.found)
        later_s += further.seconds - further.longest * each_s - one.beside_s
    whole_s = colours * (one.seconds + (frames - 1) * max(later_s, 0.0))
    count = colours * frames
    known = count if one.settles is not None else None
    return replace(
        one,
        beside_s=0.0,
        iteration_s=whole_s / count,
        iterations=count,
        settles=known,
        counted=known is not None,
        each="pattern",
    )


def _most(trial: _Trial, options: HologramOptions) -> int:
    """Return how many iterations there may be, by their number and time."""
    if options.time_s is None or not trial.iteration_s:
        return options.iterations
    return min(options.iterations, max(int(options.time_s / trial.iteration_s), 1))


def _settles(trial: _Trial, options: HologramOptions) -> int | None:
    """Return after how many iterations it ends by the course of the first; None: when it is good enough."""
    if options.psnr_db is not None:
        return None
    tolerance = TOLERANCE if options.tolerance is None else options.tolerance
    course = [
        IterationRecord(now.iteration, now.seconds, change=(last.loss - now.loss) / max(last.loss, 1e-30))
        for last, now in pairwise(trial.found.history)
    ]
    return expected_iterations(course, options, tolerance) if course else None
