"""``diffuserbench show``: what is in a run; or put a hologram on the SLM, and photograph it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from calibration_routines.display.display_io import DisplayBench, bring_mask
from calibration_routines.display.hologram_photograph import (
    display_of_pattern,
    envelope_of_pattern,
    photograph_hologram,
    write_capture,
    write_refined,
)
from instrument.bench.bench import Bench
from instrument.cli.app import App, BenchOption, examples, naming_as_is, open_and_say
from instrument.display.hologram_job import prepare_target
from instrument.files.alignment_file import Alignment, load_alignment
from instrument.files.errors import BenchError, FileError
from instrument.files.images import read_image
from instrument.files.slm_correction import load_slm_correction
from instrument.files.slm_image import levels_phase, read_slm_image

app = App()

PICTURES = (".png", ".tif", ".tiff", ".npy", ".bmp")


@app.command(
    epilog=examples(
        "diffuserbench show runs/2026-11-21_14-03-22_axial-sweep",
        "diffuserbench show slm.png --bench display.toml --seconds 60",
        "diffuserbench show slm.png --bench display.toml --capture seen.png --target picture.png",
        "diffuserbench show slm-frame1.png slm-frame2.png --capture seen.png --target picture.png",
    )
)
def show(
    what: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN|PATTERN...",
            help="A run's folder; or an 8-bit phase picture from hologram (several: frames that add).",
        ),
    ],
    bench: BenchOption = None,
    slm_calibration: Annotated[
        Path | None,
        typer.Option("--slm-calibration", metavar="FILE", help="From calibrate slm.", show_default=False),
    ] = None,
    alignment: Annotated[
        Path | None,
        typer.Option(
            "--alignment",
            metavar="FILE",
            help="Bring the mask's stage to where align mask left it.",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds", min=0.0, help="How long. Default: until Enter or Ctrl-C.", show_default=False
        ),
    ] = None,
    capture: Annotated[
        Path | None,
        typer.Option("--capture", metavar="FILE", help="Photograph it (PNG) and end.", show_default=False),
    ] = None,
    target: Annotated[
        Path | None,
        typer.Option(
            "--target", metavar="FILE", help="With --capture: the picture wanted.", show_default=False
        ),
    ] = None,
    average: Annotated[int, typer.Option("--average", min=1, help="Photographs a frame.")] = 4,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            "-p",
            metavar="FILE",
            help="Of a run: where its picture goes (PNG). Default: summary.png in its folder.",
            show_default=False,
        ),
    ] = None,
    refine: Annotated[
        int,
        typer.Option(
            "--refine",
            min=0,
            metavar="N",
            help="With --capture: N rounds with the camera in the loop; writes PATTERN-refined.png.",
        ),
    ] = 0,
    as_is: Annotated[
        bool,
        typer.Option(
            "--as-is",
            help="With --capture: ask nobody; the laser stays on, and the background is estimated.",
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False,
) -> None:
    """Say how a run ended and what it holds, with a picture; or show a hologram on the SLM.

    A hologram's look-up table and flatness are applied here, once. Without --capture the light is yours.

    With --capture the camera is registered by the mask's own speckle, the hologram photographed, brought to
    the field of view, low-passed as an eye would, and compared with --target: PSNR and SSIM.
    """
    if len(what) == 1 and what[0].suffix.lower() not in PICTURES:
        from instrument.cli.show import show as show_run

        show_run(what[0], picture)
        return
    pattern = what
    if (capture is None) != (target is None):
        raise BenchError("Give --capture FILE and --target FILE together.")
    if capture is not None and (capture.exists() and not force):
        raise FileError(capture, "exists already.", "Choose another name, or overwrite with --force.")
    if capture is not None and capture.suffix.lower() != ".png":
        raise FileError(capture, "a capture is written as .png.")
    if as_is and capture is None:
        raise BenchError("--as-is goes with --capture: without it no light is switched and nobody asked.")
    if refine and (capture is None or len(pattern) > 1):
        raise BenchError("--refine needs --capture, and one pattern.")
    correction = load_slm_correction(slm_calibration) if slm_calibration else None
    place = load_alignment(alignment) if alignment else None
    read = [read_slm_image(path) for path in pattern]
    with naming_as_is(), open_and_say(bench, as_is=as_is) as opened:
        if opened.slm is None:
            raise BenchError(f"{opened.label} has no [slm].")
        for path, (levels, _) in zip(pattern, read, strict=True):
            if levels.shape != opened.slm.shape:
                raise FileError(path, f"is {levels.shape} pixels, the SLM {opened.slm.shape}.")
        bring_mask(opened, place.stage_position if place else {})
        binning = opened.config.display.slm_binning
        io = DisplayBench(opened, binning, correction, estimate_background=as_is)
        fields = [np.exp(1j * levels_phase(levels, binning)) for levels, _ in read]
        if capture is None or target is None:
            _hold(io, fields, seconds)
            return
        files = _CaptureFiles(pattern[0], capture, target)
        _capture(opened, io, fields, read[0][1], files, average=average, refine=refine, place=place)


def _hold(io: DisplayBench, fields: list[Any], seconds: float | None) -> None:
    io.show(fields[0])
    typer.echo(f"Shown on {io.slm.name}: {io.bench.label}", err=True)
    if seconds is None and len(fields) == 1:
        typer.echo("Press Enter to end.", err=True)
        input()
        return
    end = time.monotonic() + (seconds if seconds is not None else float("inf"))
    frame = 0
    while time.monotonic() < end:
        frame = (frame + 1) % len(fields)
        if len(fields) > 1:
            io.show(fields[frame])
        time.sleep(min(0.02, max(end - time.monotonic(), 0)))


def _capture(
    opened: Bench,
    io: DisplayBench,
    fields: list[Any],
    facts: dict[str, Any],
    files: _CaptureFiles,
    *,
    average: int,
    refine: int,
    place: Alignment | None,
) -> None:
    """Photograph, say how good it is, write."""
    assert opened.slm is not None
    display = display_of_pattern(opened.config, (opened.slm.shape, opened.slm.pixel_pitch_um), facts, place)
    found = photograph_hologram(
        io,
        fields,
        display,
        prepare_target(read_image(files.target).pixels, display, envelope=envelope_of_pattern(facts)),
        average=average,
        refine=refine,
        progress=lambda n, psnr: typer.echo(f"round {n}: {psnr:.2f} dB", err=True),
    )
    mark = " (SIMULATED)" if found.simulated else ""
    typer.echo(f"camera registered to {found.camera_residual_px:.2f} px{mark}")
    if found.background_estimated:
        typer.echo("Background estimated (--as-is): the darkest 10 x 10 pixels.", err=True)
    if found.refined is not None:
        path = write_refined(files.pattern, found.refined, facts, io.binning)
        first, best = found.refined.psnr_db[0], found.capture.scores.psnr_db
        typer.echo(f"camera in the loop: {first:.2f} dB -> {best:.2f} dB; {path}")
    write_capture(files.out, found)
    score = found.capture.scores
    typer.echo(
        f"photographed: {score.psnr_db:.2f} dB, SSIM {score.ssim:.3f}; "
        f"middle quarter {score.crop_psnr_db:.2f} dB"
    )
    if found.capture.saturated_fraction > 1e-3:
        percent = 100 * found.capture.saturated_fraction
        typer.echo(f"Warning: {percent:.1f} % of the camera's pixels are saturated.", err=True)
    typer.echo(f"Wrote {files.out}")


class _CaptureFiles(NamedTuple):
    pattern: Path
    out: Path
    target: Path
