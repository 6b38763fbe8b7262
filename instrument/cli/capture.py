"""``diffuserbench snap`` and ``diffuserbench record``: a photograph; video at full camera rate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from instrument.bench.bench import Bench
from instrument.bench.lit import LightState, spoilt, switch_light
from instrument.bench.photograph import Snapshot
from instrument.bench.photograph_file import check_photograph_file, photograph_name, write_snapshot
from instrument.cli.app import (
    App,
    BenchOption,
    RunFolder,
    examples,
    naming_as_is,
    open_and_say,
)
from instrument.cli.progress import keys, one_task
from instrument.files.errors import BenchError, duration, percent, size
from instrument.files.figures import Panel, check_figure, pictures_figure, save_figure
from instrument.files.seen import as_seen
from instrument.runs.recorder import RecordingOptions, RecordingStatus, prepare_recording
from instrument.runs.run import Run
from instrument.tasks.task import saying_what_is_left
from recon.base.declare import option

if TYPE_CHECKING:
    from matplotlib.figure import Figure

snap_app, record_app = App(), App()

DIM = 0.1
"""Of full scale: a lit photograph whose brightest pixel stays below it wastes most of the sensor's range."""
_UNSTEADY = 0.02  # scatter of frames' mean counts that is said
_LIGHT, _CAMERA, _FILES = "Light", "Camera", "Files"


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Camera and light, of a photograph as of a recording."""

    exposure_ms: float | None = option(
        None, help="Exposure time, e.g. 12.5.", unit="ms", default_words="as bench.toml has it", group=_CAMERA
    )
    gain: float | None = option(
        None,
        help="Gain factor, 1 is the base gain.",
        default_words="as bench.toml has it",
        metavar="FACTOR",
        group=_CAMERA,
    )
    scene: bool = option(False, help="The scene is lit (the default).", group=_LIGHT)
    source: bool = option(False, help="The point source is lit: a PSF.", group=_LIGHT)
    dark: bool = option(False, help="Nothing is lit: a dark frame.", group=_LIGHT)
    as_is: bool = option(
        False,
        help="Ask nobody: for scripts. Alone nothing is switched; with --scene, --source or --dark devices "
        "are, and what an operator would switch stays as it is.",
        group=_LIGHT,
    )

    def light(self) -> LightState:
        """Return the light asked for.

        Raises typer.BadParameter when more than one is.
        """
        flags = {LightState.SCENE: self.scene, LightState.SOURCE: self.source, LightState.DARK: self.dark}
        chosen = [name for name, is_set in flags.items() if is_set]
        if len(chosen) > 1:
            raise typer.BadParameter(f"choose one of --{', --'.join(chosen)}.")
        if chosen:
            return chosen[0]
        return LightState.AS_IS if self.as_is else LightState.SCENE

    def set_camera(self, bench: Bench) -> None:
        """Give the camera what was asked for."""
        if self.exposure_ms is not None:
            bench.camera.set_exposure_ms(self.exposure_ms)
        if self.gain is not None:
            bench.camera.set_gain(self.gain)


@dataclass(frozen=True, kw_only=True)
class SnapOptions(CaptureOptions):
    """A photograph."""

    exposure_ms: float | None = option(
        None,
        help="Exposure time, e.g. 12.5.",
        unit="ms",
        default_words="as bench.toml has it, else found, so that nothing saturates",
        group=_CAMERA,
    )
    average: int = option(
        1,
        help="Frames to average; the mean is float32.",
        least=1,
        flags=("--average", "-n"),
        group=_CAMERA,
    )
    out: Path | None = option(
        None,
        help="Where to write: .tif, .png or .npy.",
        default_words="photo-UTCTIME.tif here",
        flags=("--out", "-o"),
        group=_FILES,
    )
    figure: Path | None = option(None, help="Also a page to look at (.png, .pdf, .svg).", group=_FILES)
    force: bool = option(False, help="Overwrite files that exist.", group=_FILES)


@snap_app.command(
    epilog=examples(
        "diffuserbench snap --out photo.tif",
        "diffuserbench snap --exposure-ms 50 --average 10 --out photo.npy",
        "diffuserbench snap --dark --average 20 --out dark.tif",
        "diffuserbench snap --source --out psf.tif",
        "diffuserbench snap --source --as-is --out psf.tif",
    )
)
def snap(options: SnapOptions, bench: BenchOption = None) -> None:
    """Take a photograph and write it with its metadata (exposure, gain, stage position, light ...).

    The exposure is found where neither --exposure-ms nor bench.toml gives one. For a dark frame nothing is
    found: give it the photograph's.
    The bench is opened for it and made safe again: light off, motion stopped.
    """
    light = options.light()
    target = options.out or Path(photograph_name())
    check_photograph_file(target, options.average, force=options.force)
    if options.figure is not None:
        check_figure(options.figure, overwrite=options.force)
        if options.figure.resolve() == target.resolve():
            raise BenchError(f"--figure {options.figure}: the photograph itself has that name; give another.")
    with saying_what_is_left(target), naming_as_is(), open_and_say(bench, as_is=options.as_is) as opened:
        options.set_camera(opened)
        switch_light(opened, light)
        if options.exposure_ms is None:
            _expose(opened, light)
        with one_task("Frames", options.average if options.average > 1 else None) as advance:
            taken = opened.snap(options.average, on_progress=advance)
        write_snapshot(opened, target, taken, light, operator_asked=not options.as_is)
        simulated = bool(opened.simulated_kinds)
    _report(target, taken, light)
    if options.figure is not None:
        with one_task("Drawing"):
            drawn = save_figure(_page(target, taken, light, simulated=simulated), options.figure)
        typer.echo(f"Wrote {drawn}")


def _expose(bench: Bench, light: LightState) -> None:
    """Find the exposure where bench.toml has none, and say how; the light is as it is to be.

    A dark frame's is another frame's, which is not known here: what the camera has is said.
    """
    from calibration_routines.psf.exposure import auto_expose, hot_pixels

    if getattr(bench.config.devices["camera"].settings, "exposure_ms", None) is not None:
        return
    if light is LightState.DARK:
        typer.echo(
            "Note: no exposure is given, here or in bench.toml: this dark frame has the "
            f"{bench.camera.exposure_ms:g} ms that the camera came with. It serves photographs of the same "
            "exposure only: give theirs, --exposure-ms.",
            err=True,
        )
        return
    hot = None
    can_switch = {LightState.SCENE: bench.can_switch_scene, LightState.SOURCE: bench.can_switch_source}
    if can_switch.get(light, False):
        switch_light(bench, LightState.DARK)
        with one_task("Looking for hot pixels"):
            dark = bench.camera.snap()
            hot = hot_pixels(dark.image, dark.full_scale)
        switch_light(bench, light)
    whose = "source" if light is LightState.SOURCE else "scene"  # wave optics of a scene take longest
    with one_task(f"Finding the {whose}'s exposure"):
        found = auto_expose(bench.camera, hot=hot)
    typer.echo(found.message)


def _page(target: Path, taken: Snapshot, light: LightState, *, simulated: bool) -> Figure:
    metadata, image = taken.metadata, taken.image
    facts = [
        ("light", light.value),
        ("exposure", f"{metadata.exposure_ms:.4g} ms, gain {metadata.gain:g}"),
        ("frames", f"{taken.average}"),
        ("counts", f"{float(image.min()):g} to {float(image.max()):g} of {taken.full_scale}"),
        ("saturated", f"{percent(metadata.saturated_fraction)} of the pixels"),
    ]
    size = f"{image.shape[0]} x {image.shape[1]} {image.dtype}, as it is seen: sRGB, contrast by percentiles"
    panel = Panel("", as_seen(image, raw=True) / 255, size, white=1.0)
    return pictures_figure(target.name, [panel], facts, simulated=simulated)


def _report(target: Path, taken: Snapshot, light: LightState) -> None:
    height, width = taken.image.shape[:2]
    metadata = taken.metadata
    frames = "1 frame" if taken.average == 1 else f"mean of {taken.average} frames"
    typer.echo(
        f"Wrote {target}: {height} x {width} {taken.image.dtype}, {light.value}, "
        f"{metadata.exposure_ms:g} ms, gain {metadata.gain:g}, {frames}."
    )
    saturated = metadata.saturated_fraction
    too_many = spoilt(saturated, taken.image.size, light)
    few = f"; {percent(saturated)} of the pixels are saturated" if saturated and not too_many else ""
    typer.echo(
        f"Counts {float(taken.image.min()):g} to {float(taken.image.max()):g}, "
        f"mean {float(np.mean(taken.image, dtype=np.float64)):.1f}, of {taken.full_scale}{few}."
    )
    if taken.unsteadiness > _UNSTEADY:
        typer.echo(
            f"Note: the frames' mean counts scatter by {taken.unsteadiness:.1%}: the light flickers, or "
            "other light comes and goes.",
            err=True,
        )
    if light is not LightState.DARK and taken.image.max() < DIM * taken.full_scale:
        typer.echo(
            f"Note: the brightest pixel is below {DIM:.0%} of full scale; lengthen --exposure-ms.",
            err=True,
        )
    if too_many:
        words = f"{percent(saturated)} of the pixels are saturated{_none_may(light)}; shorten --exposure-ms."
        typer.echo(f"Warning: {words}", err=True)


def _none_may(light: LightState) -> str:
    return ", of a PSF none may be" if light is LightState.SOURCE else ""


@record_app.command(
    epilog=examples(
        "diffuserbench record --seconds 10", "diffuserbench record --frames 600 --exposure-ms 5 --source"
    ),
)
def record(
    capture: CaptureOptions, options: RecordingOptions, files: RunFolder, bench: BenchOption = None
) -> None:
    """Record every frame of the camera with its metadata, until a number of frames or seconds, or until q.

    Frames that the camera dropped, or that the disk was too slow for, are counted and keep their numbers: the
    recording has gaps there, never a shifted index.
    """
    light = capture.light()
    files.check()
    with naming_as_is(), open_and_say(bench, as_is=capture.as_is) as opened:
        capture.set_camera(opened)
        switch_light(opened, light)
        recorder = prepare_recording(opened, files.out, options)
        seconds = options.seconds if options.n_frames is None else None
        what = "Frames" if seconds is None else "Seconds"
        with one_task(what, options.n_frames if seconds is None else seconds, note="q ends") as advance:
            recorder.on_progress = lambda status: advance(
                status.numbered if seconds is None else min(status.seconds, seconds), note=_note(status)
            )
            with keys({"q": recorder.stop}):
                run = recorder.execute()
    _last_words(run, light)
    files.draw(run)


def _note(status: RecordingStatus) -> str:
    words = [
        f"{status.frames_per_s:.1f}/s",
        f"{size(status.bytes_per_s)}/s",
        f"{size(status.free_bytes)} free",
        f"buffer {status.waiting}/{status.n_buffers}",
    ]
    words += [f"DROPPED BY CAMERA {status.dropped_by_device}"] if status.dropped_by_device else []
    words += [f"DISK TOO SLOW, LOST {status.not_written}"] if status.not_written else []
    words += [f"SATURATED {percent(status.saturated_fraction)}"] if status.saturated_fraction else []
    return "  ".join(words)


def _last_words(run: Run, light: LightState) -> None:
    mark = " SIMULATED" if run.is_simulated else ""
    by_device = sum(gap.by_device for gap in run.gaps)
    not_written = sum(gap.not_written for gap in run.gaps)
    period_s = run.frame_period_s
    took = f" in {duration(period_s * run.n_frames)}, {1 / period_s:.2f} frames/s" if period_s else ""
    typer.echo(f"{run.condition}: {len(run.records)} of {run.n_frames} frames{took}{mark}")
    if by_device:
        counted = next((e["drops_counted_by"] for e in run.events if "drops_counted_by" in e), "")
        typer.echo(f"Warning: the camera dropped {by_device} frames (by {counted}).", err=True)
    if not_written:
        typer.echo(f"Warning: the disk was too slow for {not_written} frames.", err=True)
    if saturated := [f for r in run.records.values() if (f := r.metadata.saturated_fraction) > 0]:
        most = percent(max(saturated))
        words = f"{len(saturated)} of {len(run.records)} frames have saturated pixels, up to {most} of them"
        n_pixels = math.prod(run.array.frame_shape)
        if spoilt(max(saturated), n_pixels, light):
            typer.echo(f"Warning: {words}{_none_may(light)}; shorten --exposure-ms.", err=True)
        else:
            typer.echo(f"{words}.")
    typer.echo(f"Run: {run.path}")
