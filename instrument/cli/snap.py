"""``diffuserbench snap``: take a photograph."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from instrument.bench.bench import Bench
from instrument.bench.photograph import Snapshot
from instrument.cli.app import (
    App,
    BenchOption,
    examples,
    naming_as_is,
    open_and_say,
    saying_what_is_left,
)
from instrument.cli.progress import progress_bar
from instrument.runs.snapshot import Light, check_target, photograph_name, switch_light, write_snapshot

app = App()

DIM = 0.1
"""Of full scale: a lit photograph whose brightest pixel stays below it wastes most of the sensor's range."""


@app.command(
    epilog=examples(
        "diffuserbench snap --out photo.tif",
        "diffuserbench snap --exposure-ms 50 --average 10 --out photo.npy",
        "diffuserbench snap --dark --average 20 --out dark.tif",
        "diffuserbench snap --source --out psf.tif",
        "diffuserbench snap --source --as-is --out psf.tif",
    )
)
def snap(
    bench: BenchOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="Where to write: .tif, .png or .npy. Default: photo-UTCTIME.tif here.",
            show_default=False,
        ),
    ] = None,
    average: Annotated[
        int,
        typer.Option("--average", "-n", min=1, metavar="N", help="Frames to average; the mean is float32."),
    ] = 1,
    exposure_ms: Annotated[
        float | None,
        typer.Option(
            "--exposure-ms", metavar="MS", help="Exposure time, milliseconds, e.g. 12.5.", show_default=False
        ),
    ] = None,
    gain: Annotated[
        float | None,
        typer.Option("--gain", metavar="FACTOR", help="Gain factor, 1 is the base gain.", show_default=False),
    ] = None,
    scene: Annotated[bool, typer.Option("--scene", help="The scene is lit (the default).")] = False,
    source: Annotated[bool, typer.Option("--source", help="The point source is lit: a PSF.")] = False,
    dark: Annotated[bool, typer.Option("--dark", help="Nothing is lit: a dark frame.")] = False,
    as_is: Annotated[
        bool,
        typer.Option(
            "--as-is",
            help="Ask nobody: for scripts. Alone nothing is switched; with --scene, --source or --dark "
            "devices are, and what an operator would switch stays as it is.",
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file if it exists.")] = False,
) -> None:
    """Take a photograph and write it with its metadata (exposure, gain, stage position, light ...).

    The bench is opened for it and made safe again: light off, motion stopped.
    """
    light = _one_light({Light.SCENE: scene, Light.SOURCE: source, Light.DARK: dark}, as_is=as_is)
    target = out or Path(photograph_name())
    check_target(target, average, force=force)
    with saying_what_is_left(target), naming_as_is(), open_and_say(bench, as_is=as_is) as opened:
        if exposure_ms is not None:
            opened.camera.set_exposure_ms(exposure_ms)
        if gain is not None:
            opened.camera.set_gain(gain)
        switch_light(opened, light)
        taken = _photograph(opened, average)
        write_snapshot(opened, target, taken, light, operator_asked=not as_is)
    _report(target, taken, light)


def _one_light(flags: dict[Light, bool], *, as_is: bool) -> Light:
    chosen = [name for name, is_set in flags.items() if is_set]
    if len(chosen) > 1:
        raise typer.BadParameter(f"choose one of --{', --'.join(chosen)}.")
    if chosen:
        return chosen[0]
    return Light.AS_IS if as_is else Light.SCENE


def _photograph(bench: Bench, average: int) -> Snapshot:
    with progress_bar() as bar:
        task = bar.add_task("Frames", total=average, note="")
        return bench.snap(average, on_frame=lambda taken: bar.update(task, completed=taken))


def _report(target: Path, taken: Snapshot, light: Light) -> None:
    height, width = taken.image.shape[:2]
    metadata = taken.metadata
    frames = "1 frame" if taken.average == 1 else f"mean of {taken.average} frames"
    typer.echo(
        f"Wrote {target}: {height} x {width} {taken.image.dtype}, {light.value}, "
        f"{metadata.exposure_ms:g} ms, gain {metadata.gain:g}, {frames}."
    )
    typer.echo(
        f"Counts {float(taken.image.min()):g} to {float(taken.image.max()):g}, "
        f"mean {float(np.mean(taken.image, dtype=np.float64)):.1f}, of {taken.full_scale}."
    )
    if light is not Light.DARK and taken.image.max() < DIM * taken.full_scale:
        typer.echo(
            f"Note: the brightest pixel is below {DIM:.0%} of full scale; lengthen --exposure-ms.",
            err=True,
        )
    if metadata.saturated_fraction > 0:
        typer.echo(
            f"Warning: {metadata.saturated_fraction:.3%} of the pixels are saturated; shorten --exposure-ms.",
            err=True,
        )
