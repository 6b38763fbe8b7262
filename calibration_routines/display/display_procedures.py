"""Procedures for the holographic display: how the SLM answers, where the mask is."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.display.display_io import DisplayBench, bring_mask
from calibration_routines.display.mask_alignment import AlignmentReport, AlignmentSettings, MaskAlignment
from calibration_routines.display.slm_calibration import (
    SlmCalibration,
    measure_flatness,
    measure_look_up_table,
)
from calibration_routines.procedure import Listener, Outcome, Outlook, home_if_needed, under_control
from drivers.slm import Slm
from instrument.bench.bench import Bench
from instrument.bench.display_setup import bench_display
from instrument.files.alignment_file import Alignment, load_alignment, save_alignment
from instrument.files.atomic import check_writable
from instrument.files.errors import BenchError, FileError, SettingsError
from instrument.files.slm_image import load_slm_correction
from instrument.runs.folder import dated_name, free_name
from instrument.runs.run_control import RunControl
from recon.holography.pose import NAMES

_FLATNESS_FRAMES = 22
"""Of a flatness measurement, at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlmProcedure:
    """Measure the SLM's phase against its grey levels and, with an alignment, its flatness.

    Attributes
    ----------
    levels : int
        Grey levels to measure, 8 to 256.
    alignment : Path, optional
        Of the mask; flatness is measured with it.
    out : Path, optional
        The file; None: a dated name beside the runs.
    overwrite : bool
    """

    levels: int = 33
    alignment: Path | None = None
    out: Path | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        if not 8 <= self.levels <= 256:
            raise SettingsError([("levels", f"8 to 256 grey levels can be measured, not {self.levels}")])

    @property
    def frames(self) -> int:
        """Frames it takes at most."""
        return self.levels + 2 + (_FLATNESS_FRAMES if self.alignment is not None else 0)

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse a bench without SLM, an alignment that cannot be read, a file that exists."""
        _require_slm(bench)
        refuse_existing(self.out, overwrite=self.overwrite)
        if self.alignment is not None:
            load_alignment(self.alignment)
        return Outlook((f"{self.levels} grey levels, {self.frames} frames at most",))

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Measure, and save what ``align mask`` and ``show`` take."""
        heard, slm = listener or Listener(), _require_slm(bench)
        refuse_existing(self.out, overwrite=self.overwrite)
        out = _writable(bench, folder, self.out, "slm calibration")
        place = load_alignment(self.alignment) if self.alignment is not None else None
        io = DisplayBench(bench, bench.config.display.slm_binning)
        with under_control(bench, control) as control:
            heard.step("measuring the look-up table")

            def tell(_words: str, _n: int) -> None:
                control.check()
                heard.share(io.frames, self.frames)

            found = measure_look_up_table(io, n_levels=self.levels, progress=tell)
            if place is not None:
                heard.step("measuring flatness")
                bring_mask(bench, place.stage_position)
                display = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))
                found = measure_flatness(io, display, place.pose, found, rest=place.rest, progress=tell)
            bench.safe_state()
        facts = {"bench": bench.label, "simulated": bool(bench.simulated_kinds), "frames": found.frames}
        found.correction.save(out, facts)
        return Outcome(
            verdict=tuple(slm_lines(found, simulated=bool(bench.simulated_kinds))),
            good=True,
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
        f"  up to {worst:.3f} rad from an ideal SLM's 256 levels a turn",
    ]
    if found.flatness_rms_rad is not None:
        lines.append(f"  flatness error {found.flatness_rms_rad:.3f} rad rms")
    return lines


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentProcedure:
    """Find the scattering mask by spots, move it to its place, keep what is left.

    Attributes
    ----------
    settings : AlignmentSettings
    slm_calibration : Path, optional
        From :class:`SlmProcedure`.
    out : Path, optional
        The alignment's file, a picture goes beside it; None: a dated name beside the runs.
    overwrite : bool
    """

    settings: AlignmentSettings = field(default_factory=AlignmentSettings)
    slm_calibration: Path | None = None
    out: Path | None = None
    overwrite: bool = False

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse a bench without SLM, a display that does not fit, files that exist or cannot be read."""
        slm = _require_slm(bench)
        self._refuse_existing()
        if self.slm_calibration is not None:
            load_slm_correction(self.slm_calibration)
        display = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))
        moves = self.settings.moves
        return Outlook(
            (
                f"Mask of {display.mask.shape[0]} x {display.mask.shape[1]} pixels, searched for within "
                f"±{self.settings.reach:g} of its pixels and ±{self.settings.depth_um:g} µm",
                f"{self.settings.max_frames} frames at most; "
                + (f"the stage moves {moves} times at most" if moves and bench.stage else "nothing moves"),
            )
        )

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Align, and save the alignment with its picture."""
        heard, slm, settings = listener or Listener(), _require_slm(bench), self.settings
        self._refuse_existing()
        out = _writable(bench, folder, self.out, "alignment")
        correction = load_slm_correction(self.slm_calibration) if self.slm_calibration else None
        display = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))
        io = DisplayBench(bench, bench.config.display.slm_binning, correction)
        with under_control(bench, control) as control:
            if settings.moves:
                home_if_needed(bench, heard)
            heard.step("aligning the mask")

            def tell(words: str, frames: int) -> None:
                control.check()
                heard.said(words)
                heard.share(frames, settings.max_frames, at_most=True)

            report = MaskAlignment(io, display, settings, progress=tell, on_look=heard.look).run()
            alignment = _alignment(report, bench, display.mask.shape)
            bench.safe_state()
        figure = out.with_suffix(".png")
        save_alignment(out, alignment, _facts(report, bench))
        from instrument.display.alignment_figure import (
            write_alignment_figure,  # matplotlib, only where it is drawn
        )

        write_alignment_figure(
            figure,
            report.pose.displacement(display.mask.shape),
            report.rest,
            display.mask.shape,
            report.efficiencies,
            "Mask alignment",
            simulated=alignment.simulated,
        )
        return Outcome(
            verdict=tuple(alignment_lines(report, simulated=alignment.simulated)),
            good=True,
            calibration=out,
            files=(figure,),
            result=report,
        )

    def _refuse_existing(self) -> None:
        if self.out is not None:
            refuse_existing(self.out, overwrite=self.overwrite)
            refuse_existing(self.out.with_suffix(".png"), overwrite=self.overwrite)


def alignment_lines(report: AlignmentReport, *, simulated: bool) -> list[str]:
    """Return what was found and what it costs, in lines."""
    mark = " (SIMULATED)" if simulated else ""
    spots = f"spots at {100 * report.efficiency:.0f} % of the ideal"
    lines = [f"Aligned with {report.frames} frames{mark}: {spots}"]
    for name, value, error in zip(NAMES, report.pose.vector(), report.error, strict=True):
        if name != "cubic":  # part of the smooth rest
            lines.append(f"  {name:<12}{value:+10.4f} +- {error:.4f}")
    size = np.hypot(report.rest[..., 0], report.rest[..., 1])
    lines.append(f"  smooth rest {np.sqrt(np.mean(size**2)):.2f} mask pixels rms, {size.max():.2f} at most")
    lines.append(
        f"  what remains costs a hologram about {report.psnr_lost_db:.2f} dB"
        + (
            ""
            if np.isnan(report.repeatability_db)
            else f"; stage repeatable to {report.repeatability_db:.2f} dB"
        )
    )
    reversed_axes = [name for name, direction in report.directions.items() if direction < 0]
    if reversed_axes:
        lines.append(f"  these axes go against their names: {', '.join(reversed_axes)}")
    return lines


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


def _facts(report: AlignmentReport, bench: Bench) -> dict[str, Any]:
    return {
        "bench": bench.label,
        "frames": report.frames,
        "found_at": asdict(report.found_at),
        "psnr_lost_db": report.psnr_lost_db,
        "repeatability_db": None if np.isnan(report.repeatability_db) else report.repeatability_db,
        "axis_directions": report.directions,
        "camera_residual_px": report.camera.residual_px,
        "log": report.log,
    }


def _require_slm(bench: Bench) -> Slm:
    if bench.slm is None:
        raise BenchError(f"{bench.label} has no [slm].")
    return bench.slm


def refuse_existing(file: Path | None, *, overwrite: bool) -> None:
    """Refuse to write over a file that nobody allowed to be replaced.

    Raises
    ------
    FileError
        When it exists.
    """
    if file is not None and file.exists() and not overwrite:
        raise FileError(file, "exists already.", "Choose another name, or overwrite with --force.")


def _writable(bench: Bench, folder: Path | None, out: Path | None, label: str) -> Path:
    """Return the file to write in the end, by default one with a date, sure now that it can be written."""
    if out is None:
        where = folder or bench.config.data_folder
        where.mkdir(parents=True, exist_ok=True)
        out = free_name(where, dated_name(label), ".json")
    check_writable(out)
    return out
