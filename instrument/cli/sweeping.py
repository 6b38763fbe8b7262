"""What the sweeps of ``calibrate`` share: the flow from plan to calibration, and its words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from calibration_routines import (
    SourceVisit,
    Sweep,
    SweepCalibration,
    SweepEvent,
    SweepExposures,
    calibrate_sweep,
    check_sweep,
    expose_sweep,
    sweep_plan,
)
from calibration_routines.psf_quality import place_of
from calibration_routines.sweep_plan import DARK, depths_um, reference_point
from instrument.acquire import abilities_of
from instrument.bench import Bench
from instrument.cli.progress import one_task, progress_bar
from instrument.cli.words import count
from instrument.plan import Plan, estimate

_MOST_LINES = 12  # findings printed; all of them are in calibration.json


def take_sweep(
    console: Console,
    bench: Bench,
    sweep: Sweep,
    folder: Path | None,
    *,
    reasons: Sequence[str] = (),
    dry_run: bool = False,
) -> None:
    """Say what a sweep will do and why, then do it and say how good it is. A dry run ends before it moves."""
    for reason in reasons:
        console.print(escape(reason), soft_wrap=True)
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
    if bench.stage is not None and not sweep.by_hand:
        with one_task("Homing the stage"):
            bench.stage.home()
    with one_task("Finding exposures"):
        try:
            exposures = expose_sweep(bench, sweep)
        except (KeyboardInterrupt, SystemExit) as interruption:
            interruption.add_note("The sweep had not begun: no frame was kept, start it again.")
            raise
    describe_exposures(console, exposures)
    describe_plan(console, bench, sweep, sweep_plan(sweep, exposures.exposures_ms), folder)
    with progress_bar() as bar:
        frames = bar.add_task("Sweeping", total=None, note="")
        psfs = bar.add_task("Analysing", total=None, note="", visible=False)

        def report(event: SweepEvent) -> None:
            bar.update(frames, note=event_note(event))
            say_event(bar.console, event)

        done = calibrate_sweep(
            bench,
            sweep,
            folder,
            exposures=exposures,
            on_progress=lambda status: bar.update(frames, completed=status.done, total=status.total),
            on_analysis=lambda count, total: bar.update(psfs, completed=count, total=total, visible=True),
            on_event=report,
        )
    describe_result(console, done)


def event_note(event: SweepEvent) -> str:
    """Return the newest PSF's or visit's figures for the end of a progress bar."""
    if isinstance(event, SourceVisit):
        return f"source {event.brightness:.1%}, {event.shift_px:.2f} px off"
    quality = event.quality
    words = [f"PSF {event.number}/{event.total}: signal {quality.snr:.0f} x noise"]
    words += [f"SATURATED {quality.saturated_pixels}"] if quality.saturated_pixels else []
    words += [f"{quality.step_px:.1f} px off"] if quality.step_px else []
    return ", ".join(words)


def say_event(console: Console, event: SweepEvent) -> None:
    """Print what is wrong with a PSF or the source as soon as it is known, and whether it is taken again."""
    if isinstance(event, SourceVisit):
        for finding in event.findings:
            console.print(f"Source: {escape(finding)}", soft_wrap=True)
        return
    again = " Taking it again now." if event.retaking else ""
    taken = "" if event.take == 1 else f", take {event.take}"
    for finding in event.quality.findings:
        place = f"PSF {event.number} of {event.total} ({place_of(event.quality)}{taken})"
        console.print(f"{escape(place)}: {escape(finding)}{again}", soft_wrap=True)
    if event.take > 1 and not event.quality.findings:
        console.print(f"PSF {event.number} of {event.total}: good now.", soft_wrap=True)


def describe_exposures(console: Console, exposures: SweepExposures) -> None:
    """Print what auto-exposure found, and where it fell short."""
    for z_um, found in exposures.found:
        last = found.trace[-1]
        console.print(
            f"Exposure at {z_um / 1e3:.4g} mm: {found.exposure_ms:.4g} ms in "
            f"{count(len(found.trace), 'frame')}; 99.9th percentile at {last.level:.0%}, "
            f"brightest pixel at {last.brightest:.0%} of full scale, "
            f"{last.saturated_pixels} saturated ({found.hot_pixels} hot pixels excepted).",
            soft_wrap=True,
        )
    for warning in exposures.warnings:
        console.print(f"Note: {escape(warning)}", soft_wrap=True)


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


def describe_result(console: Console, done: SweepCalibration) -> None:
    """Print how good a sweep is and where its calibration lies."""
    describe_quality(console, done)
    console.print(f"Run          {escape(str(done.runs[0].path))}", soft_wrap=True)
    console.print(f"Calibration  {escape(str(done.path))}", soft_wrap=True)


def describe_quality(console: Console, done: SweepCalibration) -> None:
    """Print the verdict on every PSF, or one line when all are good; stage and source in a line each."""
    if not done.findings:
        console.print(f"Quality: {_verdict(done)}", soft_wrap=True)
    for finding in done.findings[:_MOST_LINES]:
        console.print(f"Quality: {escape(finding)}", soft_wrap=True)
    if len(done.findings) > _MOST_LINES:
        console.print(
            f"Quality: and {len(done.findings) - _MOST_LINES} findings more, in calibration.json.",
            soft_wrap=True,
        )
    for stage in done.stages:
        gain = "" if stage.gain_error is None else f"{stage.gain_error:+.2%} off d/z, "
        console.print(
            f"Stage at z = {stage.z_um / 1e3:.4g} mm: {stage.points} shifts measured, {gain}"
            f"turned by {stage.rotation_mrad:+.1f} mrad; single points are off by "
            f"{stage.residual_median_px:.3f} (median) and {stage.residual_95_px:.3f} (95 %) pixels.",
            soft_wrap=True,
        )
    if done.drift is not None and not done.drift.findings:
        console.print(
            f"Source: {len(done.drift.brightness)} visits to the reference; brightness within "
            f"{max(abs(b - 1) for b in done.drift.brightness):.1%} (taken out of the PSFs), place within "
            f"{max(done.drift.shift_px):.2f} pixels.",
            soft_wrap=True,
        )


def _verdict(done: SweepCalibration) -> str:
    quality = done.quality
    count = len(quality)
    words = [f"signal at least {min(q.snr for q in quality):.0f} times the noise"]
    planes = [q for q in quality if q.similarity is None]
    if len(planes) >= 4:  # fewer planes give no line to hold a centroid against
        words.append(f"centroids within {max(q.step_px for q in planes):.2f} pixels of their line in 1/z")
    if len(planes) >= 2:
        words.append(f"support within {max(abs(q.scale_error) for q in planes):.1%} of 1 + d/z")
    across = [q.similarity for q in quality if q.similarity is not None]
    if across:
        words.append(f"similar to the central PSF by at least {min(across):.2f}")
        cut = sum(q.clipped > 0 for q in quality)
        words += [f"{cut} patterns reach the sensor's edge"] if cut else []
    plural = "s" if count > 1 else ""
    return f"{'all ' if count > 1 else ''}{count} PSF{plural} good. No saturated pixel; {'; '.join(words)}."


def _numbers(depths: Sequence[float]) -> str:
    return ", ".join(f"{z_um / 1e3:.4g}" for z_um in depths)
