"""What the sweeps of ``calibrate`` share: the flow from request to calibration, and its words."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TaskID

from calibration_routines import (
    Sweep,
    SweepCalibration,
    SweepEvent,
    SweepExposures,
    check_sweep,
    sweep_plan,
)
from calibration_routines.procedure import Listener
from calibration_routines.psf.sweep_plan import DARK, depths_um, reference_point
from calibration_routines.psf.sweep_procedure import (
    event_lines,
    event_note,
    exposure_lines,
    quality_lines,
    take_sweep,
)
from calibration_routines.psf.sweep_request import SweepRequest
from instrument.bench.bench import Bench
from instrument.cli.progress import progress_bar
from instrument.files.formatting import count
from instrument.plan import Plan, estimate
from instrument.runs.acquire import abilities_of
from instrument.runs.runner import RunStatus

_MUCH_BYTES = 10e9  # of a sweep, above which the plan says how to need less


class Told(Listener):
    """Shows a bar for each step of a procedure; a context, which takes away the last one."""

    def __init__(self) -> None:
        self._open = ExitStack()
        self._bar: tuple[Progress, TaskID] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.pause()

    def step(self, words: str) -> None:
        """Begin a bar of its own."""
        self.pause()
        bar = self._open.enter_context(progress_bar())
        self._bar = bar, bar.add_task(words[:1].upper() + words[1:], total=None, note="")

    def pause(self) -> None:
        """Take the bar away, for lines to be printed."""
        self._open.close()
        self._bar = None

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        """Advance the bar."""
        if self._bar is not None:
            bar, task = self._bar
            scale = 100 if total == 1 else 1  # a fraction is shown in parts of a hundred
            bar.update(task, completed=round(scale * done), total=scale * total)
            if at_most:
                bar.update(task, note="at most")

    def frame(self, status: RunStatus) -> None:
        """Advance the bar."""
        self.share(status.done, status.total)

    def event(self, event: SweepEvent) -> None:
        """Show the newest PSF's figures beside the bar, and print what is wrong above it."""
        if self._bar is not None:
            bar, task = self._bar
            bar.update(task, note=event_note(event))
            print_lines(bar.console, event_lines(event))


class _SweepTold(Told):
    """Prints what was found before the sweep begins."""

    def __init__(self, console: Console, bench: Bench, sweep: Sweep, folder: Path | None) -> None:
        super().__init__()
        self._about = console, bench, sweep, folder

    def exposures(self, found: SweepExposures) -> None:
        """Print them, and the plan with them."""
        self.pause()
        console, bench, sweep, folder = self._about
        print_lines(console, exposure_lines(found))
        describe_plan(console, bench, sweep, sweep_plan(sweep, found.exposures_ms), folder)


def say_and_take(
    console: Console, bench: Bench, request: SweepRequest, folder: Path | None, *, dry_run: bool = False
) -> None:
    """Say what a sweep will do and why, then do it and say how good it is. A dry run ends before it moves."""
    planned = request.plan(bench)
    sweep = planned.sweep
    print_lines(console, planned.reasons)
    plan = check_sweep(bench, sweep, folder)
    if dry_run:
        describe_plan(console, bench, sweep, plan, folder)
        console.print(
            f"Dry run: nothing moved. Seconds are for the camera's present {bench.camera.exposure_ms:g} ms; "
            "the exposures are found at the start."
            + (
                " Dark frames are for two exposures; one suffices if all points get the same."
                if len(sweep.points_um) > 1
                else ""
            )
        )
        return
    with _SweepTold(console, bench, sweep, folder) as told:
        done = take_sweep(bench, sweep, folder, listener=told)
    describe_result(console, done)


def print_lines(console: Console, lines: Sequence[str]) -> None:
    """Print sentences, one a line, as they are."""
    for line in lines:
        console.print(escape(line), soft_wrap=True)


def describe_plan(console: Console, bench: Bench, sweep: Sweep, plan: Plan, folder: Path | None) -> None:
    """Print what the sweep will do and cost, before it starts."""
    cost = estimate(plan, abilities_of(bench, folder))
    depths = depths_um(sweep)
    if sweep.kind == "axial":
        console.print(f"Planes (mm): {_numbers(depths)}", soft_wrap=True)
        what = count(len(depths), "plane")
    else:
        planes = f"at {len(depths)} depths (mm): {_numbers(depths)}" if len(depths) > 1 else "at one depth"
        console.print(f"Points: {len(sweep.points_um)} {planes}", soft_wrap=True)
        what = count(len(sweep.points_um), "point")
    lit = len(sweep.points_um) * sweep.average
    dark = sum(step.label == DARK for step in plan.steps())
    revisits = ""
    if reference_point(sweep) is not None:
        visits = (cost.frames - lit - dark) // sweep.average
        revisits = f" + {count(visits, 'visit')} to a reference x {sweep.average}"
    console.print(
        f"Plan: {what} x {count(sweep.average, 'frame')}{revisits} + {count(dark, 'dark frame')} "
        f"= {count(cost.frames, 'frame')}, {cost.total_bytes / 1e6:.0f} MB at most, "
        f"{cost.seconds:.0f} s of exposure and motion.",
        soft_wrap=True,
    )
    if cost.total_bytes > _MUCH_BYTES:
        console.print(
            f"Note: {cost.total_bytes / 1e9:.0f} GB are much. Fewer frames a PSF (--average), a larger "
            "--spacing or fewer --planes make it less, and so does binning in [camera].",
            soft_wrap=True,
        )


def describe_result(console: Console, done: SweepCalibration) -> None:
    """Print how good a sweep is and where its calibration lies."""
    print_lines(console, quality_lines(done))
    console.print(f"Run          {escape(str(done.runs[0].path))}", soft_wrap=True)
    console.print(f"Calibration  {escape(str(done.path))}", soft_wrap=True)


def _numbers(depths: Sequence[float]) -> str:
    return ", ".join(f"{z_um / 1e3:.4g}" for z_um in depths)
