"""Measure an SLM on the holographic bench: its look-up table and, with an alignment, its flatness."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration_routines.display.display_io import DisplayBench, bring_mask, require_slm, writable
from calibration_routines.display.kept_frames import KeptFrames, SeenAgain, kept_words
from calibration_routines.display.slm_flatness import FRAMES as FLATNESS_FRAMES
from calibration_routines.display.slm_flatness import measure_flatness
from calibration_routines.display.slm_phases import MOST_SERIES
from calibration_routines.display.slm_table import REFERENCE_EVERY, SlmCalibration, measure_look_up_table
from calibration_routines.options import Checked
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.routine import Routine
from instrument.bench.bench import Bench
from instrument.display.alignment import load_alignment
from instrument.display.bench_display import bench_display
from instrument.files.atomic import require_new
from instrument.files.record import plain
from instrument.runs.run_control import RunControl
from recon.base.declare import option

SLM_FILE = "slm-calibration.json"
"""Where the command line writes it."""


@dataclass(frozen=True, kw_only=True)
class SlmProcedure(SeenAgain, Checked, Procedure):
    """Measure the SLM's phase against its grey levels and, with an alignment, its flatness."""

    levels: int = option(33, least=8, most=256, label="Grey levels", help="Grey levels to measure.")
    alignment: Path | None = option(
        None,
        metavar="FILE",
        help="Of the mask, from align mask: flatness is measured too.",
        default_words="none",
    )
    out: Path | None = option(
        None,
        flags=("--out", "-o"),
        metavar="FILE",
        label="File",
        help="Where the calibration goes (.json).",
        default_words=f"{SLM_FILE}; in the window dated, beside the runs",
    )
    overwrite: bool = option(False, flags=("--force",), help="Overwrite a file that exists.")

    @property
    def series_frames(self) -> int:
        """Frames of a series of levels."""
        return self.levels + 1 + -(-self.levels // REFERENCE_EVERY)

    @property
    def frames(self) -> int:
        """Frames it takes at most, of one series."""
        return self.series_frames + 2 + (FLATNESS_FRAMES if self.alignment is not None else 0)

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse a bench without phase SLM, an alignment that cannot be read, a file that exists."""
        require_slm(bench, "they have no phase that their levels could be measured by")
        if self.out is not None:
            require_new(self.out, overwrite=self.overwrite)
        if self.alignment is not None:
            load_alignment(self.alignment)
        most = self.frames + (MOST_SERIES - 1) * self.series_frames
        words = (
            f"{self.levels} grey levels, {self.frames} frames at most; where the light flickers the levels "
            f"are taken up to {MOST_SERIES} times, {most} frames"
        )
        return Outlook((words, kept_words(bench, most, self.again, folder)))

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Measure, and save what ``align mask`` and ``show`` take."""
        slm, out = require_slm(bench), writable(bench, folder, self.out, "slm calibration")
        place = load_alignment(self.alignment) if self.alignment is not None else None
        total = self.frames

        def more(series: int, error_rad: float) -> None:
            nonlocal total
            total = self.frames + (series - 1) * self.series_frames
            listener.said(
                f"The pictures are not steady: a level's phase is known to {error_rad:.4f} rad. All levels "
                f"are taken {series} times in all, for their mean."
            )

        with KeptFrames(bench, folder, "calibrate slm", self) as kept:
            io = DisplayBench(
                bench,
                bench.config.display.slm_binning,
                check=control.check,
                on_frame=lambda frames: listener.share(frames, total),
                kept=kept,
            )
            listener.step("measuring the look-up table")
            found = measure_look_up_table(io, n_levels=self.levels, on_more=more)
            if place is not None:
                listener.step("measuring flatness")
                bring_mask(bench, place.stage_position)
                display = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))
                found = measure_flatness(io, display, place.pose, found, rest=place.rest)
            bench.stop()
        facts = {"bench": bench.label, "simulated": bool(bench.simulated_kinds), "frames": found.frames}
        facts |= {"phase_error_rad": found.phase_error_rad, "scatter": plain(found.steadiness)}
        found.correction.save(out, facts)
        return Outcome(
            verdict=tuple(slm_lines(found, simulated=bool(bench.simulated_kinds))),
            good=True,
            runs=kept.paths,
            files=(out,),
            result=found,
        )


def slm_lines(found: SlmCalibration, *, simulated: bool) -> list[str]:
    """Return what was found out about an SLM, in lines."""
    ideal = np.arange(256) * (2 * np.pi / 256)
    worst = float(np.abs(found.correction.phase_of_level_rad - ideal).max())
    mark = " (SIMULATED)" if simulated else ""
    lines = [
        f"{found.frames} frames{mark}: {found.phases_rad[-1]:.3f} rad at level {found.levels[-1]},",
        f"  up to {worst:.3f} rad from an ideal SLM's 256 levels a turn; a level is known to "
        f"{found.phase_error_rad:.4f} rad",
    ]
    if (series := found.steadiness.frames) > 1:
        lines.append(f"  as the light flickers: every level was taken {series} times, for its mean")
    if found.flatness_rms_rad is not None:
        lines.append(f"  flatness error {found.flatness_rms_rad:.3f} rad rms")
    return lines


ROUTINES = (
    Routine(
        name="slm",
        title="SLM look-up table",
        help="Measure the SLM's phase against its grey levels, and with an alignment its flatness, by the "
        "camera.",
        details="Half of the pixels interfere with the other half; neither mask nor optics need to be "
        "known for that. Give the file to align mask and show (--slm-calibration).",
        options=SlmProcedure,
        procedure=lambda options: options,
        needs=("slm",),
        tried_on="display",
        examples=(
            "diffuserbench calibrate slm --bench display.toml",
            "diffuserbench calibrate slm --bench display.toml --alignment alignment.json",
        ),
        file=SLM_FILE,
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
