"""``diffuserbench calibrate slm``: look-up table and flatness of the SLM from camera frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from calibration_routines.display_io import DisplayBench, bring_mask
from calibration_routines.slm_calibration import measure_flatness, measure_look_up_table
from instrument.alignment_file import load_alignment
from instrument.cli.app import BenchOption, examples, open_and_say
from instrument.cli.progress import progress_bar
from instrument.display_setup import bench_display
from instrument.errors import BenchError, FileError

EPILOG = examples(
    "diffuserbench calibrate slm --bench display.toml",
    "diffuserbench calibrate slm --bench display.toml --alignment alignment.json",
)


def slm(
    bench: BenchOption = None,
    alignment: Annotated[
        Path | None,
        typer.Option(
            "--alignment", metavar="FILE", help="From align mask: measures flatness too.", show_default=False
        ),
    ] = None,
    levels: Annotated[int, typer.Option("--levels", min=8, max=256, help="Grey levels to measure.")] = 33,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The calibration (.json).")] = Path(
        "slm-calibration.json"
    ),
    force: Annotated[bool, typer.Option("--force", help="Overwrite a file that exists.")] = False,
) -> None:
    """Measure the SLM's phase against its grey levels, and with an alignment its flatness, by the camera.

    Half of the pixels interfere with the other half; neither mask nor optics need to be known for that. Give
    the file to align mask and show (--slm-calibration).
    """
    if out.exists() and not force:
        raise FileError(out, "exists already.", "Choose another name, or overwrite with --force.")
    place = load_alignment(alignment) if alignment else None
    with open_and_say(bench) as opened, progress_bar() as bar:
        if opened.slm is None:
            raise BenchError(f"{opened.label} has no [slm].")
        task = bar.add_task("calibrate slm", total=levels + 2 + (22 if place else 0), note="")
        io = DisplayBench(opened, opened.config.display.slm_binning)

        def show(words: str, _n: int) -> None:
            bar.update(task, completed=io.frames, note=words)

        found = measure_look_up_table(io, n_levels=levels, progress=show)
        if place is not None:
            bring_mask(opened, place.stage_position)
            display = bench_display(opened.config, (opened.slm.shape, opened.slm.pixel_pitch_um))
            found = measure_flatness(io, display, place.pose, found, rest=place.rest, progress=show)
        simulated = bool(opened.simulated_kinds)
        facts = {"bench": opened.label, "simulated": simulated, "frames": found.frames}
        found.correction.save(out, facts)
    ideal = np.arange(256) * (2 * np.pi / 256)
    worst = float(np.abs(found.correction.phase_of_level_rad - ideal).max())
    mark = " (SIMULATED)" if simulated else ""
    typer.echo(f"{found.frames} frames{mark}: {found.phases_rad[-1]:.3f} rad at level {found.levels[-1]},")
    typer.echo(f"  up to {worst:.3f} rad from an ideal SLM's 256 levels a turn")
    if found.flatness_rms_rad is not None:
        typer.echo(f"  flatness error {found.flatness_rms_rad:.3f} rad rms")
    typer.echo(f"Wrote {out}")
