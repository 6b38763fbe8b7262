"""``diffuserbench list``: the runs in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from instrument.bench.config_file import load_config
from instrument.cli.app import App, BenchOption, examples
from instrument.files.errors import FileError
from instrument.runs.catalogue import run_paths, summary

app = App()


@app.command(name="list", epilog=examples("diffuserbench list", "diffuserbench list /data/monday"))
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
