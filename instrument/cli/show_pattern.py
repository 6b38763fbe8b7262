"""``diffuserbench show``: what is in a run; or put a hologram on the SLM, and photograph it."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from calibration_routines.camera_in_the_loop import refine_hologram
from calibration_routines.display_io import DisplayBench, bring_mask
from calibration_routines.hologram_capture import Capture, capture_hologram, find_camera
from instrument.alignment_file import Alignment, load_alignment
from instrument.bench import Bench
from instrument.cli.app import BenchOption, command_app, examples, naming_as_is, open_and_say
from instrument.display_setup import bench_display
from instrument.errors import BenchError, FileError
from instrument.hologram_job import prepare_target
from instrument.images import read_image, write_image
from instrument.slm_correction import load_slm_correction
from instrument.slm_image import levels_phase, phase_levels, read_slm_image, write_slm_image
from recon.holography import Display, Target
from recon.holography.camera_map import CameraMap

app = command_app()

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
        job = _CaptureJob(opened, io, read[0][1], capture, target, average, place)
        job.run(fields, pattern[0], refine)


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


@dataclass(frozen=True, slots=True)
class _CaptureJob:
    """Photographs fields and says how good they are; refines one where asked to."""

    opened: Bench
    io: DisplayBench
    facts: dict[str, Any]
    out: Path
    target: Path
    average: int
    place: Alignment | None

    def run(self, fields: list[Any], pattern: Path, refine: int) -> None:
        """Photograph, compare, write; with the camera in the loop ``refine`` times."""
        opened = self.opened
        assert opened.slm is not None
        display = bench_display(
            opened.config,
            (opened.slm.shape, opened.slm.pixel_pitch_um),
            expansion=self.facts.get("expansion"),
        )
        display = self.place.of(display) if self.place else display
        envelope = self.facts.get("metrics_computed_for", {}).get("envelope", "shade")
        wanted = prepare_target(read_image(self.target).pixels, display, envelope=envelope)
        camera, mean_per_ms = find_camera(self.io, display)
        simulated = bool(opened.simulated_kinds)
        mark = " (SIMULATED)" if simulated else ""
        typer.echo(f"camera registered to {camera.residual_px:.2f} px{mark}")
        if self.io.estimates_background:
            typer.echo("Background estimated (--as-is): the darkest 10 x 10 pixels.", err=True)
        if refine:
            found = self._refine(fields[0], display, wanted, camera, mean_per_ms, refine, pattern)
        else:
            found = capture_hologram(
                self.io, fields, display, wanted, camera, mean_per_ms=mean_per_ms, average=self.average
            )
        background = "estimated" if self.io.estimates_background else "measured"
        _write(found, self.out, camera.residual_px, {"simulated": simulated, "background": background})
        score = found.scores
        typer.echo(
            f"photographed: {score.psnr_db:.2f} dB, SSIM {score.ssim:.3f}; "
            f"middle quarter {score.crop_psnr_db:.2f} dB"
        )
        if found.saturated_fraction > 1e-3:
            percent = 100 * found.saturated_fraction
            typer.echo(f"Warning: {percent:.1f} % of the camera's pixels are saturated.", err=True)
        typer.echo(f"Wrote {self.out}")

    def _refine(
        self,
        field: Any,
        display: Display,
        wanted: Target,
        camera: CameraMap,
        mean_per_ms: float,
        rounds: int,
        pattern: Path,
    ) -> Capture:
        found = refine_hologram(
            self.io,
            field[None],
            display,
            wanted,
            camera,
            mean_per_ms=mean_per_ms,
            rounds=rounds,
            average=self.average,
            progress=lambda n, psnr: typer.echo(f"round {n}: {psnr:.2f} dB", err=True),
        )
        path = pattern.with_name(f"{pattern.stem}-refined.png")
        facts = {**self.facts, "refined_by_camera": True, "captured_psnr_db": list(found.psnr_db)}
        facts.pop("format", None)
        facts.pop("levels_per_turn", None)
        write_slm_image(path, phase_levels(np.angle(found.slm[0]), self.io.binning), facts)
        typer.echo(
            f"camera in the loop: {found.psnr_db[0]:.2f} dB -> {found.best.scores.psnr_db:.2f} dB; {path}"
        )
        return found.best


def _write(found: Capture, out: Path, residual_px: float, origin: dict[str, Any]) -> None:
    pixels = np.clip(np.rint(found.seen * 255), 0, 255).astype(np.uint8)
    facts = {**origin, "metrics": asdict(found.scores), "camera_residual_px": residual_px}
    write_image(out, pixels, {**facts, "low_passed": True, "white": 255})
