"""``diffuserbench hologram``: the SLM phase that shows a picture."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from instrument.cli.app import App, BenchOption, examples, load_and_say
from instrument.cli.progress import first_interrupt_cancels, one_task
from instrument.cli.tasks import Terminal, finish
from instrument.display.alignment import load_alignment
from instrument.display.bench_display import bench_display, slm_size
from instrument.display.hologram import (
    HologramResult,
    compute_and_judge,
    field_words,
    prepare_target,
    read_weights,
    unshowable,
)
from instrument.display.hologram_files import CHANNELS, HologramFiles, light_words, score_words
from instrument.display.hologram_forecast import forecast_hologram
from instrument.files.errors import BenchError, FileError
from instrument.files.images import read_image, read_stack
from instrument.files.pictures import Pixels
from instrument.reconstruction.forecast import Forecast
from instrument.tasks.spots import HologramInputs, make_spots, say_distance, tell_limit
from instrument.tasks.task import Given, saying_what_is_left
from recon.arrays import Array
from recon.holography import (
    Display,
    HologramOptions,
    HologramRecord,
    HologramStop,
    Target,
)
from recon.holography.target import EVERYWHERE, Window

hologram_app = App()


@hologram_app.command(
    epilog=examples(
        "diffuserbench hologram picture.png --out slm.png",
        "diffuserbench hologram picture.png --loss spatial --centre 0.4,0.6 --radius 0.2 --out slm.png",
        "diffuserbench hologram near.png far.png --z-mm 0 --z-mm 40 --out slm.png",
        "diffuserbench hologram picture.png --frames 2 --psnr 30 --out slm.png",
        "diffuserbench hologram frames/ --video --iterations 10 --out video.png",
        "diffuserbench hologram colour.png --color --out slm.png",
        "diffuserbench hologram picture.png --limit",
        "diffuserbench hologram --spots 10x10 --expansion 1 --out spots.png",
    )
)
def hologram(
    given: Given,
    inputs: HologramInputs,
    options: HologramOptions,
    target: Annotated[
        list[Path] | None, typer.Argument(metavar="[TARGET...]", help="The picture, or one per plane.")
    ] = None,
    bench: BenchOption = None,
) -> None:
    """Compute the SLM phase that shows a picture through the bench's scattering mask, or without one.

    --expansion 1 is an ordinary hologram, without a mask. --spots takes the place of a picture: weighted
    Gerchberg-Saxton makes spots as bright as asked for, at any places and depths.

    Writes the pattern, a JSON file with settings and metrics, and a preview of what will be seen with and
    without the eye's low-pass (computed, not photographed). Ctrl-C keeps the pattern so far.
    """
    if inputs.spots is not None and target:
        raise BenchError(f"{target[0]} and --spots exclude each other: give a picture, or --spots.")
    if inputs.spots is None and not target:
        raise BenchError("Give a picture (diffuserbench hologram picture.png), or --spots 10x10.")
    if target and len(target) > 1 and "out" not in given and not target[-1].exists():
        raise BenchError(f"{target[-1]}: there is no such picture. Did you mean --out {target[-1]}?")
    config = load_and_say(bench)
    if inputs.spots is not None:
        given.refuse("--spots", "spots")
    size = slm_size(config, phases=options.mirrors is None, spots=inputs.spots is not None)
    if inputs.spots is not None:
        finish(make_spots(Terminal(), inputs, options, (config, size)))
        return
    assert target is not None
    if inputs.weights is not None:
        options = replace(options, weights=read_weights(inputs.weights))
    pictures = _frames(target, video=inputs.video)
    told = (field_words(p, options.fit, in_colour=inputs.color) for planes in pictures for p in planes)
    if said := next(filter(None, told), ""):
        typer.echo(said, err=True)
    _require_light(target, pictures, options, color=inputs.color)
    depths = inputs.depths(1 if inputs.video else len(target))
    lasers = inputs.wavelengths if inputs.color else (None,)
    displays = [
        options.display_of(bench_display(config, size, expansion=options.expansion, wavelength_nm=nm))
        for nm in lasers
    ]
    for display in displays:
        for z in depths:
            display.require_plane(z)  # before anything is said or made
    say_distance(Terminal(), displays, options)
    if inputs.alignment is not None:
        found = load_alignment(inputs.alignment)
        displays = [found.of(display) for display in displays]
    if inputs.limit:
        given.refuse("--limit", "limit")
        if len(target) > 1:
            raise BenchError("--limit is for one picture in one plane.")
        tell_limit(Terminal(), pictures[0][0], displays[0], options, depths[0])
        return
    frames = len(pictures) if inputs.video else 0
    writer = HologramFiles(inputs.out, config.display.slm_binning, options, displays, video=frames)
    work = _Work(pictures, displays, depths, options, inputs, writer)
    if inputs.explain:
        typer.echo(f"{'Will take':<12}{work.forecast()}")
        return
    writer.check(overwrite=inputs.force)
    with saying_what_is_left(*writer.files()), first_interrupt_cancels() as cancel:
        work.compute(cancel)


@dataclass(frozen=True)
class _Work:
    """Pictures to be shown: of each frame those of its planes, at these depths; a display for each colour."""

    pictures: list[list[Pixels]]
    displays: list[Display]
    depths: list[float]
    options: HologramOptions
    inputs: HologramInputs
    writer: HologramFiles

    def targets(self, frame: int, channel: int) -> tuple[list[Target], Window | None]:
        """Return the targets of a frame's pictures in a colour, and where in the field they are."""
        share, options = self.writer.shares[channel], self.options
        targets = [
            prepare_target(
                _channel(picture, channel if self.inputs.color else None),
                self.displays[channel],
                options,
                z_mm=z,
                share=share,
            )
            for picture, z in zip(self.pictures[frame], self.depths, strict=True)
        ]
        return targets, EVERYWHERE.shrunk(share) if share < 1 and options.mirrors is None else None

    def forecast(self) -> Forecast:
        """Carry out the first iterations of the first pattern, and say what all take."""
        targets, part = self.targets(0, 0)
        with one_task("the first iterations", 1.0) as advance:
            return forecast_hologram(
                self.displays[0],
                targets,
                self.options,
                colours=len(self.displays),
                frames=len(self.pictures),
                part=part,
                on_progress=advance,
            )

    def compute(self, cancel: threading.Event) -> None:
        """Compute, tell and write all; raises Exit where it was interrupted, with what there is by then."""
        initial: list[Any] = [None] * len(self.displays)
        for number in range(len(self.pictures)):
            for channel, display in enumerate(self.displays):
                targets, part = self.targets(number, channel)
                label = self.writer.label(number, channel)
                result = _compute(display, targets, self.options, (initial[channel], part), cancel, label)
                initial[channel] = result.hologram.slm if self.inputs.video else None
                self.writer.write(number, channel, result)
                _print(label, result, self.options)
                if result.hologram.stop_reason is HologramStop.CANCELLED:
                    typer.echo("Interrupted: this is the pattern so far.", err=True)
                    raise typer.Exit(130)


def _compute(
    display: Display,
    targets: list[Target],
    options: HologramOptions,
    start: tuple[Any, Window | None],
    cancel: Any,
    label: str,
) -> HologramResult:
    """Compute and judge; ``start`` is a warm start, and where in the field the picture is."""
    initial, part = start
    with one_task(label, options.iterations) as advance:

        def show(record: HologramRecord, _slm: object) -> None:
            done = float(record.iteration)
            if options.time_s is not None:
                done = max(done, options.iterations * record.seconds / options.time_s)
            advance(done, note=f"{record.psnr_db:.2f} dB")

        return compute_and_judge(
            display, targets, options, initial=initial, callback=show, cancel=cancel, part=part
        )


def _frames(target: list[Path], *, video: bool) -> list[list[Pixels]]:
    """Return, for each video frame (or once), the pictures of its planes."""
    if not video:
        images = [read_image(path) for path in target]
        for image in images:
            for note in image.notes:
                typer.echo(f"{image.path.name}: {note}.", err=True)
        return [[image.pixels for image in images]]
    if len(target) != 1:
        raise BenchError("--video takes one folder or stack of pictures.")
    return [[frame] for frame in read_stack(target[0]).pixels]


def _require_light(
    target: list[Path], pictures: list[list[Pixels]], options: HologramOptions, *, color: bool
) -> None:
    """Refuse a picture, frame or colour that no hologram can show, before any is computed."""
    channels: tuple[tuple[int | None, str], ...] = ((None, ""),)
    if color:
        channels = tuple((number, f"its {name} ") for number, name in enumerate(CHANNELS))
    for frame, planes in enumerate(pictures):
        for path, picture in zip(target, planes, strict=True):
            for number, name in channels:
                if words := unshowable(_channel(picture, number), options):
                    which = f"frame {frame + 1} " if len(pictures) > 1 else ""
                    raise FileError(path, f"{which}{name}{words}")


def _channel(picture: Pixels, channel: int | None) -> Array:
    if channel is None:
        return picture
    if picture.ndim != 3:
        raise BenchError("--color needs a colour picture; this one is grey.")
    return np.ascontiguousarray(picture[..., channel])


def _print(label: str, result: HologramResult, options: HologramOptions) -> None:
    """Say how good the hologram is, for which grid, envelope and frame count."""
    history = result.hologram.history
    typer.echo(
        f"{label}: {history[-1].iteration} iterations, {result.hologram.seconds:.1f} s: "
        f"{result.hologram.stop_reason}"
    )
    for plane, score in enumerate(result.scores):
        name = f"  plane {plane + 1}: " if len(result.scores) > 1 else "  seen: "
        typer.echo(f"{name}{score_words(score)}")
    typer.echo(
        f"  (computed on the alias-free grid, envelope {options.envelope}, {options.frames} frame(s), "
        "through the eye's low-pass)"
    )
    typer.echo(f"  light: {light_words(result, options)}")
    for words in result.limited_by:
        typer.echo(f"  limited by {words}")
