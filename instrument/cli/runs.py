"""What is on disk: ``list``, ``verify`` and ``export`` of runs, and of reconstructions."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from instrument.bench.config_file import load_config
from instrument.cli.app import App, BenchOption, examples
from instrument.cli.progress import one_task, progress_bar
from instrument.files.errors import BenchError, FileError
from instrument.files.volume_zarr import is_zarr_name, uneven_steps
from instrument.reconstruction.result_export import export_result
from instrument.reconstruction.stored_result import open_result
from instrument.runs.catalogue import run_paths, summary
from instrument.runs.export import export as export_run
from instrument.runs.run import Run
from instrument.runs.verification import verify as verify_run

list_app, verify_app, export_app = App(), App(), App()


@list_app.command(name="list", epilog=examples("diffuserbench list", "diffuserbench list /data/monday"))
def list_runs(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="FOLDER", help="Default: data_folder of bench.toml.", show_default=False),
    ] = None,
    bench: BenchOption = None,
) -> None:
    """List the runs in a folder, the newest last: what became of each, its frames, its label."""
    if folder is not None and not folder.is_dir():
        raise FileError(folder, "is no folder.", "Name the folder that holds the runs.")
    folder = folder or load_config(bench).data_folder
    if not folder.is_dir():
        typer.echo(f"{folder}: no such folder, so no runs yet.")
        return
    paths = run_paths(folder)
    if not paths:
        typer.echo(f"{folder}: no runs.")
        return
    table = Table(title=str(folder), title_justify="left", box=None)
    for heading in ("run", "became", "frames", "kind", "bench"):
        table.add_column(heading, overflow="fold", justify="right" if heading == "frames" else "left")
    for path in paths:
        found = summary(path)
        if found.condition is None:
            table.add_row(path.name, "UNREADABLE", "", "", found.problem)
            continue
        kind = "recording" if found.is_recording else "plan"
        mark = "SIMULATED" if found.is_simulated else ""
        table.add_row(path.name, found.condition, f"{found.stored} of {found.frames}", kind, mark)
    Console(width=None if Console().is_terminal else 160).print(table, markup=False)


@verify_app.command(
    epilog=examples(
        "diffuserbench verify runs/2026-11-21_14-03-22_axial-sweep", "diffuserbench verify runs/*"
    )
)
def verify(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="The runs' folders.")],
) -> None:
    """Read every frame and its metadata and hold them against the log's checksums. Changes nothing.

    Exit status 1 when anything is not as it was written. A run that ended early is sound, only not complete.
    """
    sound = True
    for path in runs:
        run = Run.open(path)
        with progress_bar() as bar:
            bar.add_task(path.name, total=len(run.records), note="")
            found = verify_run(run, partial(_advance, bar))
        for frame in found.damaged:
            typer.echo(f"{path}: frame {frame.index}: {frame.problem}", err=True)
        for problem in found.problems:
            typer.echo(f"{path}: {problem}", err=True)
        sound = sound and found.is_sound
        verdict = "sound" if found.is_sound else "DAMAGED"
        typer.echo(f"{path}: {verdict}, {run.condition}, {found.frames} of {run.n_frames} frames read back.")
    if not sound:
        typer.echo("diffuserbench resume takes damaged frames of a plan again.", err=True)
        raise typer.Exit(1)


def _advance(bar: Progress, done: int, _total: int) -> None:
    bar.update(bar.task_ids[0], completed=done)


@export_app.command(
    epilog=examples(
        "diffuserbench export RUN psfs.ome.tif --label psf",
        "diffuserbench export RUN video.mp4",
        "diffuserbench export RUN frames/ --frames 0:100",
        "diffuserbench export volume.tif volume.ome.zarr",
    )
)
def export(
    run: Annotated[
        Path, typer.Argument(metavar="RUN|RESULT", help="The run's folder; or a reconstruction's file.")
    ],
    target: Annotated[
        Path,
        typer.Argument(
            metavar="TARGET",
            help="File ending in .ome.tif, .tif, .h5, .npy or .mp4, or a folder for PNG files. "
            "A picture: .tif, .npy, .png; a volume: .tif, .npy, .ome.zarr.",
        ),
    ],
    label: Annotated[
        str | None, typer.Option("--label", help="Only steps of this label.", show_default=False)
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            "--frames", metavar="A:B", help="Only frames A to B - 1; A:B:C every C-th.", show_default=False
        ),
    ] = None,
    frames_per_s: Annotated[
        float | None,
        typer.Option("--fps", min=0.1, help="Frames a second of an MP4.", show_default=False),
    ] = None,
) -> None:
    """Write a run's stored frames, or a reconstruction, for other programs; what is there stays as it is.

    Frames that are not there (gaps of a recording, steps not done) are left out, and said.
    """
    if _is_result(run):
        if (label, frames, frames_per_s) != (None, None, None):
            raise BenchError("--label, --frames and --fps are for runs; leave them out for a reconstruction.")
        _export_result(run, target)
        return
    found = Run.open(run)
    wanted = set(range(found.n_frames)[_slice(frames)])
    if label is not None:
        wanted &= {step.index for step in found.steps(label)}
    indices = [index for index in sorted(found.records) if index in wanted]
    with progress_bar() as bar:
        task = bar.add_task("Frames", total=len(indices), note="")
        export_run(
            found,
            target,
            indices,
            frames_per_s=frames_per_s,
            on_progress=lambda done, _: bar.update(task, completed=done),
        )
    typer.echo(f"Wrote {len(indices)} frames: {target}")
    if absent := len(wanted) - len(indices):
        typer.echo(f"Warning: {absent} frames that are not in the run were left out.", err=True)


def _is_result(path: Path) -> bool:
    """Whether a path is a picture's or volume's: a file, or a Zarr folder, which no run is."""
    return path.is_file() or is_zarr_name(path)


def _export_result(path: Path, target: Path) -> None:
    result = open_result(path)
    try:
        with one_task("Planes") as advance:
            export_result(result, target, advance=advance)
        steps = "" if result.planes_um is None else uneven_steps(result.planes_um[0])
    finally:
        result.close()
    typer.echo(f"Wrote {target}")
    if steps and target.suffix.lower() != ".npy":
        typer.echo(f"{'Planes':<12}{steps}")


def _slice(text: str | None) -> slice:
    if text is None:
        return slice(None)
    try:
        numbers = [int(part) if part else None for part in text.split(":")]
        if len(numbers) == 1 and numbers[0] is not None:
            return slice(numbers[0], numbers[0] + 1)
        return slice(*numbers)
    except (ValueError, TypeError):
        raise typer.BadParameter(f"--frames {text!r}: give A:B, e.g. 0:100, or one number.") from None
