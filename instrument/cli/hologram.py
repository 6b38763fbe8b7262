"""``diffuserbench hologram``: the SLM phase that shows a picture through the scattering mask."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from instrument.bench.display_setup import bench_display, slm_size
from instrument.cli.app import App, BenchOption, examples, load_and_say, saying_what_is_left
from instrument.cli.hologram_output import tell
from instrument.cli.progress import first_interrupt_cancels, progress_bar
from instrument.display.hologram_file import HologramFiles
from instrument.display.hologram_job import (
    HologramRequest,
    HologramResult,
    foveal,
    prepare_target,
    read_weights,
    run_request,
)
from instrument.files.alignment_file import load_alignment
from instrument.files.errors import BenchError
from instrument.files.images import Pixels, read_image, read_stack
from recon.holography import Budget, Display, HologramRecord, HologramStop, Target
from recon.holography.optimise import Method

app = App()

RGB_NM = (638.0, 520.0, 450.0)


class LossName(enum.StrEnum):
    """The losses of Kuo 2020, Eqs. 7.16, 7.17 and 7.19."""

    NONE = "none"
    FREQUENCY = "frequency"
    SPATIAL = "spatial"


class MethodName(enum.StrEnum):
    """The methods of :func:`recon.holography.compute_hologram`."""

    LBFGS = "lbfgs"
    NESTEROV = "nesterov"
    ONE_STEP = "one-step"


METHODS: dict[MethodName, Method] = {
    MethodName.LBFGS: "lbfgs",
    MethodName.NESTEROV: "nesterov",
    MethodName.ONE_STEP: "one_step",
}


class GridName(enum.StrEnum):
    """The grids of :mod:`recon.holography.lowpass`."""

    ALIAS_FREE = "alias-free"
    DISSERTATION = "dissertation"


class FitName(enum.StrEnum):
    """How a picture that is not square fills the field."""

    COVER = "cover"
    CONTAIN = "contain"
    STRETCH = "stretch"


class EnvelopeName(enum.StrEnum):
    """What becomes of the mask pixels' diffraction envelope."""

    SHADE = "shade"
    CORRECT = "correct"
    IGNORE = "ignore"


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
    loss: Annotated[LossName, typer.Option("--loss", help="Which differences count.")] = LossName.FREQUENCY,
    centre: Annotated[
        str, typer.Option("--centre", metavar="Y,X", help="Of the spatial weights.")
    ] = "0.5,0.5",
    radius: Annotated[float, typer.Option("--radius", help="Of full weight, fraction of the field.")] = 0.28,
    periphery: Annotated[float, typer.Option("--periphery", help="Weight far outside.")] = 0.1,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", metavar="FILE", help="A weight image instead.", show_default=False),
    ] = None,
    alignment: Annotated[
        Path | None,
        typer.Option("--alignment", metavar="FILE", help="From align mask.", show_default=False),
    ] = None,
    method: Annotated[MethodName, typer.Option("--method", "-m")] = MethodName.LBFGS,
    grid: Annotated[
        GridName, typer.Option("--grid", help="dissertation: unpadded, aliases.")
    ] = GridName.ALIAS_FREE,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Time-multiplexed frames.")] = 1,
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
        FitName, typer.Option("--fit", help="How the picture fills the square field.")
    ] = FitName.COVER,
    srgb: Annotated[
        bool, typer.Option("--srgb", help="Values are sRGB-coded; default: they are intensities.")
    ] = False,
    envelope: Annotated[
        EnvelopeName,
        typer.Option(
            "--envelope",
            help="Mask pixels' envelope: shade the target too, correct it in the hologram, ignore it.",
        ),
    ] = EnvelopeName.SHADE,
    iterations: Annotated[int, typer.Option("--iterations", "-n", min=1, help="At most so many.")] = 100,
    time_s: Annotated[
        float | None, typer.Option("--time", metavar="S", help="At most S seconds.", show_default=False)
    ] = None,
    psnr_db: Annotated[
        float | None,
        typer.Option("--psnr", metavar="DB", help="Stop at this PSNR of the seen image.", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Of the random start.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False,
) -> None:
    """Compute the SLM phase that shows a picture through the bench's scattering mask.

    Writes the pattern, a JSON file with settings and metrics, and a preview of what will be seen with and
    without the eye's low-pass (computed, not photographed). Ctrl-C keeps the pattern so far.
    """
    if levels is not None and levels not in (2, 4, 8, 16, 32, 64, 128, 256):
        raise BenchError(f"--levels {levels}: the SLM's phases are 2, 4, 8, 16, 32, 64, 128 or 256.")
    config = load_and_say(bench)
    size = slm_size(config)
    request = HologramRequest(
        method=METHODS[method],
        loss_kind=loss.value,
        weights=_weights(loss, weights, centre, radius, periphery),
        grid="alias_free" if grid is GridName.ALIAS_FREE else "dissertation",
        frames=frames,
        complex_slm=complex_slm,
        phase_levels=levels,
        envelope=envelope.value,
        budget=Budget(iterations, time_s, psnr_db),
        seed=seed,
    )
    pictures = _pictures(target, video=video)
    depths = _depths(z_mm, 1 if video else len(target))
    lasers = wavelengths if color else (None,)
    displays = [
        request.display_of(bench_display(config, size, expansion=expansion, wavelength_nm=nm))
        for nm in lasers
    ]
    if alignment is not None:
        found = load_alignment(alignment)
        displays = [found.of(display) for display in displays]
    writer = HologramFiles(
        out, config.display.slm_binning, request, displays, video=len(pictures) if video else 0
    )
    writer.check(overwrite=force)
    with saying_what_is_left(*writer.files()), first_interrupt_cancels() as cancel:
        initial: list[Any] = [None] * len(displays)
        for number, planes in enumerate(pictures):
            for channel, display in enumerate(displays):
                targets = [
                    prepare_target(
                        _channel(picture, channel if color else None),
                        display,
                        z_mm=z,
                        fit=fit.value,
                        srgb=srgb,
                        envelope=envelope.value,
                    )
                    for picture, z in zip(planes, depths, strict=True)
                ]
                result = _compute(
                    display, targets, request, initial[channel], cancel, writer.label(number, channel)
                )
                initial[channel] = result.hologram.slm if video else None
                writer.write(number, channel, result)
                tell(writer.label(number, channel), result, request)
                if result.hologram.stop_reason is HologramStop.CANCELLED:
                    typer.echo("Interrupted: this is the pattern so far.", err=True)
                    raise typer.Exit(130)


def _compute(
    display: Display, targets: list[Target], request: HologramRequest, initial: Any, cancel: Any, label: str
) -> HologramResult:
    budget = request.budget
    with progress_bar() as bar:
        task = bar.add_task(label, total=budget.iterations, note="")

        def show(record: HologramRecord, _slm: object) -> None:
            done = float(record.iteration)
            if budget.time_s is not None:
                done = max(done, budget.iterations * record.seconds / budget.time_s)
            bar.update(task, completed=done, note=f"{record.psnr_db:.2f} dB")

        return run_request(display, targets, request, initial=initial, callback=show, cancel=cancel)


def _weights(
    loss: LossName, weights: Path | None, centre: str, radius: float, periphery: float
) -> np.ndarray[Any, Any] | None:
    if loss is not LossName.SPATIAL:
        if weights is not None:
            raise BenchError("--weights needs --loss spatial.")
        return None
    return read_weights(weights) if weights is not None else foveal(centre, radius, periphery)


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
