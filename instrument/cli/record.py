"""``diffuserbench record``: video at full camera rate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, BenchOption, examples, naming_as_is, open_and_say
from instrument.cli.keys import keys
from instrument.cli.progress import progress_bar
from instrument.files.formatting import duration, size
from instrument.runs.recorder import RecordingStatus
from instrument.runs.recording import prepare_recording
from instrument.runs.run import Run

app = App()


@app.command(
    name="record",
    epilog=examples(
        "diffuserbench record --seconds 10", "diffuserbench record --frames 600 --exposure-ms 5 --source"
    ),
)
def record(
    bench: BenchOption = None,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", "-s", min=0.0, metavar="S", help="How long.", show_default=False),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            "-n",
            min=1,
            metavar="N",
            help="How many frames, lost ones counted.",
            show_default=False,
        ),
    ] = None,
    exposure_ms: Annotated[
        float | None,
        typer.Option("--exposure-ms", metavar="MS", help="Exposure time, milliseconds.", show_default=False),
    ] = None,
    gain: Annotated[
        float | None, typer.Option("--gain", metavar="FACTOR", help="Gain factor.", show_default=False)
    ] = None,
    source: Annotated[bool, typer.Option("--source", help="Light the point source, not the scene.")] = False,
    dark: Annotated[bool, typer.Option("--dark", help="Light nothing.")] = False,
    as_is: Annotated[
        bool,
        typer.Option(
            "--as-is",
            help="Ask nobody: for scripts. Alone nothing is switched; with --source or --dark devices are.",
        ),
    ] = False,
    label: Annotated[str, typer.Option("--label", help="Becomes part of the folder's name.")] = "recording",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FOLDER",
            help="Where the run's folder is made. Default: data_folder of bench.toml.",
            show_default=False,
        ),
    ] = None,
    buffers: Annotated[
        int | None,
        typer.Option(
            "--buffers",
            min=16,
            metavar="N",
            help="Frames that may wait in memory for the disk. Default: what fits into 256 MB.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Record every frame of the camera with its metadata, until a number of frames or seconds, or until q.

    Frames that the camera dropped, or that the disk was too slow for, are counted and keep their numbers: the
    recording has gaps there, never a shifted index.
    """
    if source and dark:
        raise typer.BadParameter("choose one of --source, --dark.")
    with naming_as_is(), open_and_say(bench, as_is=as_is) as opened:
        if exposure_ms is not None:
            opened.camera.set_exposure_ms(exposure_ms)
        if gain is not None:
            opened.camera.set_gain(gain)
        if source or dark or not as_is:
            opened.source_on() if source else opened.source_off()
            opened.scene_off() if source or dark else opened.scene_on()
        recorder = prepare_recording(
            opened, out, label=label, n_frames=frames, seconds=seconds, n_buffers=buffers
        )
        with progress_bar() as bar:
            task = bar.add_task("Frames", total=frames, note="q ends")
            recorder.on_progress = lambda status: bar.update(
                task, completed=status.numbered, note=_note(status)
            )
            with keys({"q": recorder.stop}):
                run = recorder.execute()
    _last_words(run)


def _note(status: RecordingStatus) -> str:
    words = [
        f"{status.frames_per_s:.1f}/s",
        f"{size(status.bytes_per_s)}/s",
        f"{size(status.free_bytes)} free",
        f"buffer {status.waiting}/{status.n_buffers}",
    ]
    words += [f"DROPPED BY CAMERA {status.dropped_by_device}"] if status.dropped_by_device else []
    words += [f"DISK TOO SLOW, LOST {status.not_written}"] if status.not_written else []
    words += [f"SATURATED {status.saturated_fraction:.2%}"] if status.saturated_fraction else []
    return "  ".join(words)


def _last_words(run: Run) -> None:
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
    typer.echo(f"Run: {run.path}")
