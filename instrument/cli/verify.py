"""``diffuserbench verify``: read every frame of a run and check it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from instrument.cli.app import App, examples
from instrument.cli.progress import progress_bar
from instrument.runs.run import Run
from instrument.runs.verification import verify as verify_run

app = App()


@app.command(
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
