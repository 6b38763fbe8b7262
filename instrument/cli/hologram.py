"""``diffuserbench hologram``: the SLM phase that shows a picture through the scattering mask."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import numpy.typing as npt
import typer

from instrument.bench.display_setup import bench_display, slm_size
from instrument.cli.app import App, BenchOption, examples, load_and_say, saying_what_is_left
from instrument.cli.hologram_output import tell
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
from recon.holography import LOSSES, Display, HologramOptions, HologramRecord, HologramStop, Target
from recon.holography.lowpass import Grid
from recon.holography.options import Envelope, Fit, Method

app = App()

RGB_NM = (638.0, 520.0, 450.0)


_DEFAULT = HologramOptions()


def _words(words: Sequence[str]) -> str:
    return f"<{'|'.join(words)}>"


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
    bench: BenchOption = None,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="FILE", help="8-bit phase, 256 levels a turn; .json and a preview."
        ),
    ] = Path("slm.png"),
    z_mm: Annotated[
        list[float] | None,
        typer.Option("--z-mm", metavar="MM", help="Depth of each target behind the focal plane. Default: 0."),
    ] = None,
    expansion: Annotated[
        int | None,
        typer.Option(
            "--expansion",
            "-q",
            help="Étendue expansion 4, 16, 36 ... Default: the bench's.",
            show_default=False,
        ),
    ] = None,
    loss: Annotated[
        str,
        typer.Option("--loss", help="Which differences count.", metavar=_words(LOSSES.names())),
    ] = str(_DEFAULT.loss),
    centre: Annotated[
        str, typer.Option("--centre", metavar="Y,X", help="Of the spatial weights.")
    ] = ",".join(map(str, _DEFAULT.centre)),
    radius: Annotated[
        float, typer.Option("--radius", help="Of full weight, fraction of the field.")
    ] = _DEFAULT.radius,
    periphery: Annotated[float, typer.Option("--periphery", help="Weight far outside.")] = _DEFAULT.periphery,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", metavar="FILE", help="A weight image instead.", show_default=False),
    ] = None,
    alignment: Annotated[
        Path | None,
        typer.Option("--alignment", metavar="FILE", help="From align mask.", show_default=False),
    ] = None,
    method: Annotated[
        str, typer.Option("--method", "-m", metavar=_words(get_args(Method)))
    ] = _DEFAULT.method,
    grid: Annotated[
        str,
        typer.Option("--grid", help="dissertation: unpadded, aliases.", metavar=_words(get_args(Grid))),
    ] = _DEFAULT.grid,
    frames: Annotated[
        int, typer.Option("--frames", min=1, help="Time-multiplexed frames.")
    ] = _DEFAULT.frames,
    complex_slm: Annotated[
        bool, typer.Option("--complex", help="For an SLM that sets amplitude and phase; out is a .npy file.")
    ] = False,
    levels: Annotated[
        int | None,
        typer.Option(
            "--levels",
            metavar="N",
            help="The SLM shows N phases only (2, 4, 8 ... 256). Default: continuous, written in 256.",
            show_default=False,
        ),
    ] = None,
    video: Annotated[
        bool, typer.Option("--video", help="TARGET is a folder or stack; each frame starts from the last.")
    ] = False,
    color: Annotated[
        bool, typer.Option("--color", help="Field-sequential colour: one pattern a channel.")
    ] = False,
    wavelengths: Annotated[
        tuple[float, float, float], typer.Option("--wavelengths", metavar="R G B", help="With --color, nm.")
    ] = RGB_NM,
    fit: Annotated[
        str,
        typer.Option("--fit", help="How the picture fills the square field.", metavar=_words(get_args(Fit))),
    ] = _DEFAULT.fit,
    srgb: Annotated[
        bool, typer.Option("--srgb", help="Values are sRGB-coded; default: they are intensities.")
    ] = False,
    envelope: Annotated[
        str,
        typer.Option(
            "--envelope",
            help="Mask pixels' envelope: shade the target too, correct it in the hologram, ignore it.",
            metavar=_words(get_args(Envelope)),
        ),
    ] = _DEFAULT.envelope,
    iterations: Annotated[
        int, typer.Option("--iterations", "-n", min=1, help="At most so many.")
    ] = _DEFAULT.iterations,
    time_s: Annotated[
        float | None, typer.Option("--time", metavar="S", help="At most S seconds.", show_default=False)
    ] = None,
    psnr_db: Annotated[
        float | None,
        typer.Option("--psnr", metavar="DB", help="Stop at this PSNR of the seen image.", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Of the random start.")] = _DEFAULT.seed,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False,
) -> None:
    """Compute the SLM phase that shows a picture through the bench's scattering mask.

    Writes the pattern, a JSON file with settings and metrics, and a preview of what will be seen with and
    without the eye's low-pass (computed, not photographed). Ctrl-C keeps the pattern so far.
    """
    config = load_and_say(bench)
    size = slm_size(config)
    options = HologramOptions(
        fit=fit,  # type: ignore[arg-type]
        srgb=srgb,
        loss=loss,
        centre=_centre(centre),
        radius=radius,
        periphery=periphery,
        weights=None if weights is None else read_weights(weights),
        envelope=envelope,  # type: ignore[arg-type]
        expansion=expansion,
        frames=frames,
        complex_slm=complex_slm,
        phase_levels=levels,
        iterations=iterations,
        time_s=time_s,
        psnr_db=psnr_db,
        method=method,  # type: ignore[arg-type]
        grid=grid,  # type: ignore[arg-type]
        seed=seed,
    )
    pictures = _pictures(target, video=video)
    depths = _depths(z_mm, 1 if video else len(target))
    lasers = wavelengths if color else (None,)
    displays = [
        options.display_of(bench_display(config, size, expansion=options.expansion, wavelength_nm=nm))
        for nm in lasers
    ]
    if alignment is not None:
        found = load_alignment(alignment)
        displays = [found.of(display) for display in displays]
    writer = HologramFiles(
        out, config.display.slm_binning, options, displays, video=len(pictures) if video else 0
    )
    writer.check(overwrite=force)
    with saying_what_is_left(*writer.files()), first_interrupt_cancels() as cancel:
        initial: list[Any] = [None] * len(displays)
        for number, planes in enumerate(pictures):
            for channel, display in enumerate(displays):
                targets = [
                    prepare_target(_channel(picture, channel if color else None), display, options, z_mm=z)
                    for picture, z in zip(planes, depths, strict=True)
                ]
                result = _compute(
                    display, targets, options, initial[channel], cancel, writer.label(number, channel)
                )
                initial[channel] = result.hologram.slm if video else None
                writer.write(number, channel, result)
                tell(writer.label(number, channel), result, options)
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


def _centre(text: str) -> tuple[float, float]:
    try:
        y, x = (float(part) for part in text.split(","))
    except ValueError:
        raise BenchError(f"--centre {text!r}: write Y,X in fractions of the field, e.g. 0.5,0.5.") from None
    return y, x


def _pictures(target: list[Path], *, video: bool) -> list[list[Pixels]]:
    """Return, for each video frame (or once), the pictures of its planes."""
    if not video:
        return [[read_image(path).pixels for path in target]]
    if len(target) != 1:
        raise BenchError("--video takes one folder or stack of pictures.")
    return [[frame] for frame in read_stack(target[0]).pixels]


def _depths(z_mm: list[float] | None, count: int) -> list[float]:
    depths = [0.0] * count if not z_mm else list(z_mm)
    if len(depths) != count or (count > 1 and not z_mm):
        raise BenchError(f"Give --z-mm once for each of the {count} targets (found {len(z_mm or [])}).")
    return depths


def _channel(picture: Pixels, channel: int | None) -> npt.NDArray[Any]:
    if channel is None:
        return picture
    if picture.ndim != 3:
        raise BenchError("--color needs a colour picture; this one is grey.")
    return np.ascontiguousarray(picture[..., channel])
