"""``diffuserbench hologram``: the SLM phase that shows a picture through the scattering mask."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from instrument.bench.display_setup import bench_display, slm_size
from instrument.cli.app import App, BenchOption, examples, load_and_say, saying_what_is_left
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.display.hologram_file import HologramFiles
from instrument.display.hologram_job import (
    HologramResult,
    compute_and_judge,
    prepare_target,
    read_weights,
)
from instrument.files.alignment_file import load_alignment
from instrument.files.errors import BenchError
from instrument.files.images import Pixels, read_image, read_stack
from recon.base.declare import option
from recon.holography import Display, HologramOptions, HologramRecord, HologramStop, Target

app = App()


@dataclass(frozen=True, kw_only=True)
class HologramInputs:
    """What is shown, for which display, and where the pattern goes."""

    z_mm: tuple[float, ...] = option(
        (),
        help="Depth of each target behind the focal plane; once a target.",
        default_words="0",
        unit="mm",
        group="Files",
    )
    video: bool = option(
        False, help="TARGET is a folder or stack; each frame starts from the last.", group="Files"
    )
    color: bool = option(False, help="Field-sequential colour: one pattern a channel.", group="Files")
    wavelengths: tuple[float, float, float] = option(
        (638.0, 520.0, 450.0), help="With --color, nm.", above=0, metavar="R G B", group="Files"
    )
    weights: Path | None = option(None, help="A weight image instead of the fovea.", group="What counts")
    alignment: Path | None = option(None, help="From align mask.", group="Display")
    out: Path = option(
        Path("slm.png"),
        help="8-bit phase, 256 levels a turn (--complex: .npy); .json and a preview.",
        flags=("--out", "-o"),
        group="Files",
    )
    force: bool = option(False, help="Overwrite files that exist.", group="Files")

    def depths(self, count: int) -> list[float]:
        """Return the depth of each of ``count`` targets; BenchError where they do not fit."""
        depths = list(self.z_mm) or [0.0] * count
        if len(depths) != count or (count > 1 and not self.z_mm):
            raise BenchError(f"Give --z-mm once for each of the {count} targets (found {len(self.z_mm)}).")
        return depths


@app.command(
    epilog=examples(
        "diffuserbench hologram picture.png --out slm.png",
        "diffuserbench hologram picture.png --loss spatial --centre 0.4,0.6 --radius 0.2 --out slm.png",
        "diffuserbench hologram near.png far.png --z-mm 0 --z-mm 40 --out slm.png",
        "diffuserbench hologram picture.png --frames 2 --psnr 30 --out slm.png",
        "diffuserbench hologram frames/ --video --iterations 10 --out video.png",
        "diffuserbench hologram colour.png --color --out slm.png",
    )
)
def hologram(
    target: Annotated[list[Path], typer.Argument(metavar="TARGET...", help="The picture, or one per plane.")],
    inputs: HologramInputs,
    options: HologramOptions,
    bench: BenchOption = None,
) -> None:
    """Compute the SLM phase that shows a picture through the bench's scattering mask.

    Writes the pattern, a JSON file with settings and metrics, and a preview of what will be seen with and
    without the eye's low-pass (computed, not photographed). Ctrl-C keeps the pattern so far.
    """
    config = load_and_say(bench)
    size = slm_size(config)
    if inputs.weights is not None:
        options = replace(options, weights=read_weights(inputs.weights))
    pictures = _pictures(target, video=inputs.video)
    depths = inputs.depths(1 if inputs.video else len(target))
    lasers = inputs.wavelengths if inputs.color else (None,)
    displays = [
        options.display_of(bench_display(config, size, expansion=options.expansion, wavelength_nm=nm))
        for nm in lasers
    ]
    if inputs.alignment is not None:
        found = load_alignment(inputs.alignment)
        displays = [found.of(display) for display in displays]
    frames = len(pictures) if inputs.video else 0
    writer = HologramFiles(inputs.out, config.display.slm_binning, options, displays, video=frames)
    writer.check(overwrite=inputs.force)
    with saying_what_is_left(*writer.files()), first_interrupt_cancels() as cancel:
        initial: list[Any] = [None] * len(displays)
        for number, planes in enumerate(pictures):
            for channel, display in enumerate(displays):
                targets = [
                    prepare_target(
                        _channel(picture, channel if inputs.color else None), display, options, z_mm=z
                    )
                    for picture, z in zip(planes, depths, strict=True)
                ]
                label = writer.label(number, channel)
                result = _compute(display, targets, options, initial[channel], cancel, label)
                initial[channel] = result.hologram.slm if inputs.video else None
                writer.write(number, channel, result)
                _tell(label, result, options)
                if result.hologram.stop_reason is HologramStop.CANCELLED:
                    typer.echo("Interrupted: this is the pattern so far.", err=True)
                    raise typer.Exit(130)


def _compute(
    display: Display, targets: list[Target], options: HologramOptions, initial: Any, cancel: Any, label: str
) -> HologramResult:
    with progress_bar() as bar:
        task = bar.add_task(label, total=options.iterations, note="")

        def show(record: HologramRecord, _slm: object) -> None:
            done = float(record.iteration)
            if options.time_s is not None:
                done = max(done, options.iterations * record.seconds / options.time_s)
            bar.update(task, completed=done, note=f"{record.psnr_db:.2f} dB")

        return compute_and_judge(display, targets, options, initial=initial, callback=show, cancel=cancel)


def _pictures(target: list[Path], *, video: bool) -> list[list[Pixels]]:
    """Return, for each video frame (or once), the pictures of its planes."""
    if not video:
        return [[read_image(path).pixels for path in target]]
    if len(target) != 1:
        raise BenchError("--video takes one folder or stack of pictures.")
    return [[frame] for frame in read_stack(target[0]).pixels]


def _channel(picture: Pixels, channel: int | None) -> npt.NDArray[Any]:
    if channel is None:
        return picture
    if picture.ndim != 3:
        raise BenchError("--color needs a colour picture; this one is grey.")
    return np.ascontiguousarray(picture[..., channel])


def _tell(label: str, result: HologramResult, options: HologramOptions) -> None:
    """Say how good the hologram is, for which grid, envelope and frame count."""
    history = result.hologram.history
    typer.echo(
        f"{label}: {history[-1].iteration} iterations, {result.hologram.seconds:.1f} s: "
        f"{result.hologram.stop_reason}"
    )
    for plane, score in enumerate(result.scores):
        name = f"  plane {plane + 1}: " if len(result.scores) > 1 else "  seen: "
        typer.echo(
            f"{name}{score.psnr_db:.2f} dB, SSIM {score.ssim:.3f}; "
            f"middle quarter {score.crop_psnr_db:.2f} dB, SSIM {score.crop_ssim:.3f}"
        )
    typer.echo(
        f"  (computed on the alias-free grid, envelope {options.envelope}, {options.frames} frame(s), "
        "through the eye's low-pass)"
    )
