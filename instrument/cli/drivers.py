"""``diffuserbench drivers``: which drivers are installed."""

from __future__ import annotations

import typer

from drivers.registry.registry import KINDS, driver_names, registration_mistakes
from instrument.cli.app import App, examples

app = App()


@app.command(epilog=examples("diffuserbench drivers"))
def drivers() -> None:
    """List the installed drivers for each kind of device: the names to put behind driver = in bench.toml.

    No device is touched. Their keys are in docs/reference/bench-toml.md, or in the documentation of the
    package that brings them.
    """
    width = max(map(len, KINDS)) + 2
    for kind in KINDS:
        typer.echo(f"{kind:<{width}}{', '.join(driver_names(kind)) or 'none'}")
    for sentence in registration_mistakes():
        typer.echo(sentence, err=True)
