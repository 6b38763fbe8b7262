"""``diffuserbench align mask``: find the scattering mask, bring it to its place, keep what is left."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from calibration_routines.display_io import DisplayBench
from calibration_routines.mask_alignment import AlignmentReport, AlignmentSettings, MaskAlignment
from instrument.alignment_file import Alignment, save_alignment
from instrument.bench import Bench
from instrument.cli.app import BenchOption, command_app, examples, open_and_say
from instrument.cli.progress import progress_bar
from instrument.display_setup import bench_display
from instrument.errors import BenchError, FileError
from instrument.slm_correction import load_slm_correction
from recon.holography.pose import NAMES

app = command_app("Align the holographic display.")


@app.callback()
def align() -> None:
    """Align the holographic display."""


@app.command(
    epilog=examples(
        "diffuserbench align mask --bench display.toml",
        "diffuserbench align mask --reach 30 --depth-um 300 --moves 0",
    )
)
def mask(
    bench: BenchOption = None,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FILE", help="The alignment (.json); a .png goes beside it."),
    ] = Path("alignment.json"),
    reach: Annotated[float, typer.Option("--reach", help="Largest shift to look for, mask pixels.")] = 72.0,
    depth_um: Annotated[float, typer.Option("--depth-um", help="Largest distance to look for.")] = 1000.0,
    moves: Annotated[int, typer.Option("--moves", min=0, help="Stage moves at most; 0: nothing moves.")] = 4,
    sections: Annotated[
        str, typer.Option("--sections", metavar="ROWSxCOLUMNS", help="Of the SLM, measured one by one.")
    ] = "3x5",
    max_frames: Annotated[int, typer.Option("--max-frames", min=10)] = 100,
    slm_calibration: Annotated[
        Path | None,
        typer.Option("--slm-calibration", metavar="FILE", help="From calibrate slm.", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False,
) -> None:
    """Find the mask's pose by spots on the camera, move the stage, and store what is left as an alignment.

    The camera must see the whole field of view. The search moves nothing. Then a small move and back tells
    which way the stage's axes go and how well it comes back (it is homed before); it takes out shift,
    distance, rotation and clear tilts until a move promises less than that. What stays is measured section
    by section. Give the file to hologram --alignment.
    """
    division = _division(sections)
    figure = out.with_suffix(".png")
    for file in (out, figure):
        if file.exists() and not force:
            raise FileError(file, "exists already.", "Choose another name, or overwrite with --force.")
    correction = load_slm_correction(slm_calibration) if slm_calibration else None
    with open_and_say(bench) as opened:
        if opened.slm is None:
            raise BenchError(f"{opened.label} has no [slm].")
        stage = opened.stage
        if stage is not None and moves and not stage.is_homed:
            typer.echo("Homing the stage.", err=True)
            stage.home()
        display = bench_display(opened.config, (opened.slm.shape, opened.slm.pixel_pitch_um))
        io = DisplayBench(opened, opened.config.display.slm_binning, correction)
        settings = AlignmentSettings(
            reach=reach, depth_um=depth_um, moves=moves, max_frames=max_frames, division=division
        )
        with progress_bar() as bar:
            task = bar.add_task("align mask", total=max_frames, note="")
            report = MaskAlignment(
                io, display, settings, progress=lambda words, n: bar.update(task, completed=n, note=words)
            ).run()
        alignment = _alignment(report, opened, display.mask.shape)
        facts = {
            "bench": opened.label,
            "frames": report.frames,
            "found_at": dict(zip(NAMES, map(float, report.found_at.vector()), strict=True)),
            "psnr_lost_db": report.psnr_lost_db,
            "repeatability_db": None if np.isnan(report.repeatability_db) else report.repeatability_db,
            "axis_directions": report.directions,
            "camera_residual_px": report.camera.residual_px,
            "log": report.log,
        }
        save_alignment(out, alignment, facts)
        from instrument.alignment_figure import write_alignment_figure  # matplotlib, only where it is drawn

        write_alignment_figure(
            figure,
            report.pose.displacement(display.mask.shape),
            report.rest,
            display.mask.shape,
            report.efficiencies,
            "Mask alignment",
            simulated=alignment.simulated,
        )
    _tell(report, alignment)
    typer.echo(f"Wrote {out}, {figure}")


def _alignment(report: AlignmentReport, bench: Bench, mask_shape: tuple[int, int]) -> Alignment:
    return Alignment(
        report.pose,
        dict(zip(NAMES, map(float, report.error), strict=True)),
        report.rest,
        report.efficiency,
        bench.stage.commanded_position() if bench.stage else {},
        mask_shape,
        bool(bench.simulated_kinds),
    )


def _tell(report: AlignmentReport, alignment: Alignment) -> None:
    mark = " (SIMULATED)" if alignment.simulated else ""
    typer.echo(
        f"Aligned with {report.frames} frames{mark}: spots at {100 * report.efficiency:.0f} % of the ideal"
    )
    for name, value, error in zip(NAMES, report.pose.vector(), report.error, strict=True):
        if name != "cubic":  # part of the smooth rest
            typer.echo(f"  {name:<12}{value:+10.4f} +- {error:.4f}")
    size = np.hypot(report.rest[..., 0], report.rest[..., 1])
    typer.echo(f"  smooth rest {np.sqrt(np.mean(size**2)):.2f} mask pixels rms, {size.max():.2f} at most")
    typer.echo(
        f"  what remains costs a hologram about {report.psnr_lost_db:.2f} dB"
        + (
            ""
            if np.isnan(report.repeatability_db)
            else f"; stage repeatable to {report.repeatability_db:.2f} dB"
        )
    )
    reversed_axes = [name for name, direction in report.directions.items() if direction < 0]
    if reversed_axes:
        typer.echo(f"  these axes go against their names: {', '.join(reversed_axes)}")


def _division(text: str) -> tuple[int, int]:
    try:
        rows, columns = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise BenchError(f"--sections {text!r}: write ROWSxCOLUMNS, for example 3x5.") from None
    return rows, columns
