"""``diffuserbench export``: a run's frames, or a reconstruction, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples
from instrument.cli.progress import one_task, progress_bar
from instrument.files.errors import BenchError
from instrument.files.plane_steps import uneven_steps
from instrument.files.volume_zarr import is_zarr_name
from instrument.reconstruction.result_export import export_result
from instrument.reconstruction.stored_result import open_result
from instrument.runs.export import export as export_run
from instrument.runs.run import Run

app = App()


@app.command(
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
            on_frame=lambda done: bar.update(task, completed=done),
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
