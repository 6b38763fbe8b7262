"""``diffuserbench new``: write a commented bench.toml."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.bench.config_file import DEFAULT_NAME, default_text, display_text, led_microscope_text
from instrument.cli.app import App, examples
from instrument.files.atomic import write_text
from instrument.files.errors import BenchError, FileError

app = App()


@app.command(
    epilog=examples(
        "diffuserbench new",
        "diffuserbench new benches/microscope.toml",
        "diffuserbench new --force          overwrite an existing bench.toml",
        "diffuserbench new display.toml --display",
        "diffuserbench new microscope.toml --led-microscope",
    )
)
def new(
    file: Annotated[Path, typer.Argument(help="The file to write.")] = Path(DEFAULT_NAME),
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file if it exists.")] = False,
    display: Annotated[bool, typer.Option("--display", help="A holographic display instead.")] = False,
    led_microscope: Annotated[
        bool, typer.Option("--led-microscope", help="An LED array microscope instead, for calibrate dpc.")
    ] = False,
) -> None:
    """Write a commented bench.toml in which every key is explained: the simulated bench to start from."""
    if file.is_dir():
        raise FileError(file, "is a folder.", f"Name a file in it, e.g. {file / DEFAULT_NAME}")
    if file.exists() and not force:
        raise FileError(file, "exists already and was left as it is.", "Use --force to overwrite it.")
    if display and led_microscope:
        raise BenchError("Give --display or --led-microscope, not both.")
    text, what = default_text(), "bench, with every key explained"
    if display:
        text, what = display_text(), "holographic display"
    if led_microscope:
        text, what = led_microscope_text(), "LED array microscope"
    write_text(file, text)
    typer.echo(f"Wrote {file}: a SIMULATED {what}.")
    typer.echo(f"Next: diffuserbench check{'' if file == Path(DEFAULT_NAME) else f' --bench {file}'}")
