"""``diffuserbench gui``: the desktop program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples, load_and_say
from instrument.files.errors import BenchError

app = App()

_MODULES = ("PySide6", "shiboken6", "pyqtgraph")


@app.command(
    epilog=examples("diffuserbench gui", "diffuserbench gui bench.toml"),
)
def gui(
    bench: Annotated[
        Path | None,
        typer.Argument(
            metavar="[BENCH.TOML]",
            help="Bench configuration. Default: bench.toml here, else the built-in simulated bench.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Open the desktop program: live view, stage, light, sweeps, reconstructions, holograms.

    Closing the window, Ctrl-C and SIGTERM end it safely: light off, motion stopped, runs closed.
    """
    try:
        config = load_and_say(bench)
    except BenchError as error:
        _show_too(error)
        raise
    try:
        from gui.app import run
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in _MODULES:
            raise
        raise BenchError(
            f'The desktop program needs {error.name}. Install it: pip install "diffuserbench[gui]"'
        ) from None
    except ImportError as error:  # a library of the system that Qt needs, e.g. libEGL.so.1
        raise BenchError(
            f"The desktop program cannot start: {error}. On Debian: sudo apt install libegl1 libgl1 "
            "libxkbcommon0 libfontconfig1 libdbus-1-3 libxcb-cursor0 libxcb-icccm4 libxcb-keysyms1"
        ) from None
    raise typer.Exit(run(config))


def _show_too(error: BenchError) -> None:
    """Show a mistake in a window: started from a menu, there is no terminal where it would be read."""
    try:
        from gui.app import show_mistake
    except ImportError:  # the terminal tells it
        return
    show_mistake(error)
