"""Sweeps as procedures: what is asked, how it went in words, and what the registry offers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from calibration_routines.planned import outlook_of
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.analysis import late_hot_lines
from calibration_routines.psf.mount_fit import off_middle
from calibration_routines.psf.psf_quality import place_of
from calibration_routines.psf.sampling import reachable_depths_um, standing_depth_um
from calibration_routines.psf.stage_fit import CREEP_PX, Drift
from calibration_routines.psf.sweep import SweepCalibration, calibrate_sweep, finish_sweep, watch_sweep
from calibration_routines.psf.sweep_options import AskedSweep, AxialSweep, LateralSweep, VolumeSweep
from calibration_routines.psf.sweep_plan import (
    FEATURE_PX,
    SWEEP,
    SweepExposures,
    check_sweep,
    plan_lines,
    size_findings,
)
from calibration_routines.psf.sweep_watch import SourceVisit, SweepEvent
from calibration_routines.routine import Routine
from calibration_routines.scatter import TOLERATED, Scatter
from instrument.bench.bench import Bench
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl

_COMPUTES = {"sweeping": (10.4, 4.8), "analysing": (14.3, 2.1)}
"""Transforms for each megapixel of a frame, compared and all (docs/benchmarks/time-told.md)."""


@dataclass(frozen=True, slots=True)
class SweepProcedure(Procedure):
    """Carries out what was asked of a sweep."""

    sweep: AskedSweep

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Plan the sweep and hold it against the bench's limits and the disk."""
        planned = self.sweep.planned(bench)
        plan = check_sweep(bench, planned.sweep, folder or bench.config.data_folder)
        outlook = outlook_of(
            bench, plan, folder, planned.reasons, homes=not planned.sweep.by_hand, computes=_COMPUTES
        )
        caveat = (
            f"Seconds are for the camera's present {bench.camera.exposure_ms:g} ms; the exposures are found "
            "at the start."
        )
        if len(planned.sweep.points_um) > 1:
            caveat += " Dark frames are for two exposures; one suffices if all points get the same."
        lines = plan_lines(bench, planned.sweep, plan, folder)
        size_um = bench.config.source.size_um
        lines += [f"Note: {w}" for w in size_findings(size_um, bench.geometry, planned.sweep.depths_um[0])]
        return replace(outlook, plan_lines=(*lines, caveat))

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Home the stage, find exposures, take the sweep and save its calibration."""
        sweep = self.sweep.planned(bench).sweep
        if bench.stage is not None and not sweep.by_hand:
            listener.step("homing the stage")
            bench.stage.home()
        return sweep_outcome(calibrate_sweep(bench, sweep, folder, control=control, listener=listener))


def _finish(run: Run, bench: Bench | None, control: RunControl, listener: Listener) -> Outcome:
    return sweep_outcome(finish_sweep(run.path, bench, control=control, listener=listener))


def sweep_outcome(done: SweepCalibration) -> Outcome:
    """Return what a sweep leaves, with its verdict in words."""
    return Outcome(
        verdict=tuple(quality_lines(done)),
        good=not done.findings,
        runs=tuple(run.path for run in done.runs),
        calibration=done.path,
        result=done,
    )


_SEEN_WIDTH_PX = 0.5  # of a source's image: less blurs a PSF by less than a pixel does
_SEEN_MOTION_PX = 0.05  # of a PSF's place: a tenth of what a pixel tells
_MOST_LINES = 12  # findings in words; all of them are in calibration.json


def exposure_lines(exposures: SweepExposures) -> list[str]:
    """Return what auto-exposure found, and where it fell short."""
    lines = []
    for z_um, found in exposures.found:
        last = found.trace[-1]
        frames = "1 frame" if len(found.trace) == 1 else f"{len(found.trace)} frames"
        lines.append(
            f"Exposure at {z_um / 1e3:.4g} mm: {found.exposure_ms:.4g} ms in {frames}; "
            f"99.9th percentile at {last.level:.0%}, brightest pixel at {last.brightest:.0%} of full scale, "
            f"{last.saturated_pixels} saturated ({found.hot_pixels} hot pixels excepted)."
        )
    return lines + [f"Note: {warning}" for warning in exposures.warnings]


def event_note(event: SweepEvent) -> str:
    """Return the newest PSF's or visit's figures for the end of a progress bar."""
    if isinstance(event, SourceVisit):
        return f"source {event.brightness:.1%}, {event.shift_px:.2f} px off"
    quality = event.quality
    words = [f"PSF {event.number}/{event.total}: signal {quality.snr:.0f} x noise"]
    words += [f"SATURATED {quality.saturated_pixels}"] if quality.saturated_pixels else []
    words += [f"{quality.step_px:.1f} px off"] if quality.step_px else []
    return ", ".join(words)


def event_lines(event: SweepEvent) -> list[str]:
    """Return what is wrong with a PSF or the source as soon as it is known, and whether it is taken again."""
    if isinstance(event, SourceVisit):
        return [f"Source: {finding}" for finding in event.findings]
    again = " Taking it again now." if event.retaking else ""
    taken = "" if event.take == 1 else f", take {event.take}"
    place = f"PSF {event.number} of {event.total} ({place_of(event.quality)}{taken})"
    lines = [f"{place}: {finding}{again}" for finding in event.quality.findings]
    if event.take > 1 and not event.quality.findings:
        lines.append(f"PSF {event.number} of {event.total}: good now.")
    return lines


def quality_lines(done: SweepCalibration) -> list[str]:
    """Return the verdict on every PSF, or one line when all are good; stage and source in a line each."""
    lines = [f"Quality: {finding}" for finding in done.findings[:_MOST_LINES]]
    if not done.findings:
        lines = [f"Quality: {_verdict(done)}"]
    if len(done.findings) > _MOST_LINES:
        lines.append(f"Quality: and {len(done.findings) - _MOST_LINES} findings more, in calibration.json.")
    for stage in done.stages:
        gain = "" if stage.gain_error is None else f"{stage.gain_error:+.2%} off d/z, "
        lines.append(
            f"Stage at z = {stage.z_um / 1e3:.4g} mm: {stage.points} shifts measured, {gain}"
            f"turned by {stage.rotation_mrad:+.1f} mrad; single points are off by "
            f"{stage.residual_median_px:.3f} (median) and {stage.residual_95_px:.3f} (95 %) pixels."
        )
        words = stage.distance_words(done.calibration.geometry.diffuser_distance_mm)
        if words and len(done.stages) == 1:  # several depths tell more: below
            lines.append(words)
    if done.mount is not None:
        lines.append(done.mount.line(done.calibration.geometry))
    if done.drift is not None and not done.drift.findings:
        known = done.drift.brightness_error
        taken = f"each known to {known:.1%}" if known > TOLERATED else "taken out of the PSFs"
        lines.append(
            f"Source: {len(done.drift.brightness)} visits to the reference; brightness within "
            f"{max(abs(b - 1) for b in done.drift.brightness):.1%} ({taken}), place within "
            f"{max(done.drift.shift_px):.2f} pixels{_crept(done.drift)}."
        )
    if FEATURE_PX >= done.source_width_px > _SEEN_WIDTH_PX:
        lines.append(
            f"Source: the pinhole's image is {done.source_width_px:.1f} pixels wide from the nearest depth "
            "([source] size_um): the PSFs are blurred by that."
        )
    if done.structure is not None and (
        words := done.structure.line(done.source_size_um, done.source_width_px)
    ):
        lines.append(words)
    if done.scatter.averages and not done.scatter.findings():
        lines.append(_frames_line(done.scatter))
    central = [q for q in done.quality if q.similarity is None]
    if words := off_middle(central, done.calibration.geometry):
        lines.append(words)
    return [*lines, *late_hot_lines(done.late_hot, "sweep")]


def _crept(drift: Drift) -> str:
    """Return the words for a pattern that moved by more than places should."""
    return ": it moved, and places are off by that" if max(drift.shift_px) > CREEP_PX else ""


def _frames_line(scatter: Scatter) -> str:
    steady = f"Frames: brightness steady within {scatter.flicker:.1%}"
    if scatter.place_error_px <= _SEEN_MOTION_PX:
        return f"{steady}, place within {scatter.motion_px:.2f} pixels from frame to frame, noise taken off."
    return (
        f"{steady}; the picture shakes by {scatter.motion_px:.2f} pixels from frame to frame: frames were "
        f"put onto one another, and the place of a PSF is known to {scatter.place_error_px:.2f} pixels."
    )


def _verdict(done: SweepCalibration) -> str:
    quality = done.quality
    number = len(quality)
    words = [f"signal at least {min(q.snr for q in quality):.0f} times the noise"]
    planes = [q for q in quality if q.similarity is None]
    if len(planes) >= 4:  # fewer planes give no line to hold a centroid against
        words.append(f"centroids within {max(q.step_px for q in planes):.2f} pixels of their line in 1/z")
    if len(planes) >= 2:
        words.append(f"support within {max(abs(q.scale_error) for q in planes):.1%} of 1 + d/z")
    across = [q.similarity for q in quality if q.similarity is not None]
    if across:
        words.append(f"similar to the central PSF by at least {min(across):.2f}")
        cut = sum(q.clipped > 0 for q in quality)
        words += [f"{cut} patterns reach the sensor's edge"] if cut else []
    plural = "s" if number > 1 else ""
    return f"{'all ' if number > 1 else ''}{number} PSF{plural} good. No saturated pixel; {'; '.join(words)}."


def _depths(bench: Bench) -> dict[str, float]:
    """Return what depths a form begins with: one PSF is asked for where the source stands."""
    near_um, far_um = reachable_depths_um(bench)
    here_um = standing_depth_um(bench)
    return {"z_min_um": here_um or near_um, "z_max_um": far_um, "z_um": here_um or far_um}


_sweep = partial(
    Routine, procedure=SweepProcedure, purpose=SWEEP, finish=_finish, watch=watch_sweep, start=_depths
)
ROUTINES = (
    _sweep(
        name="axial",
        title="Axial sweep",
        help="Move the point source along the axis and measure one PSF a plane.",
        details="For volumes, and with one plane for photographs. Finds the exposures without saturating, "
        "takes dark frames, sweeps, judges every PSF in words, takes bad planes again, and saves "
        "the calibration in the run's folder. Ends with the light off.",
        options=AxialSweep,
        examples=(
            "diffuserbench calibrate axial --z-min 100 --z-max 300 --planes 12",
            "diffuserbench calibrate axial --z-min 300          one PSF, 300 mm in front of the diffuser",
            "diffuserbench calibrate axial --z-min 100 --z-max 300 --dry-run",
        ),
    ),
    _sweep(
        name="lateral",
        title="Lateral sweep",
        help="Move the point source over a grid at one depth and measure a PSF at each point.",
        details="For a camera whose PSF changes over the field: reconstruct --volume CALIBRATION --model "
        "local, lowrank or auto. Each pattern's shift is measured and held against the stage; a "
        "reference point is visited again and again to tell whether the source drifts.",
        options=LateralSweep,
        needs=("stage",),
        examples=(
            "diffuserbench calibrate lateral --z 300 --dry-run          the grid, and why",
            "diffuserbench calibrate lateral --z 1.7 --fall-off-deg 13 --half-field-x 1.2 --half-field-y 0.8",
            "diffuserbench calibrate lateral --z 300 --spacing 40",
        ),
    ),
    _sweep(
        name="volume",
        title="Volume sweep",
        help="Move the point source over a grid at each of several depths, evenly spaced in 1/z.",
        details="As lateral, plane after plane. The number of planes and of points follows from the optics"
        " unless given.",
        options=VolumeSweep,
        needs=("stage",),
        examples=(
            "diffuserbench calibrate volume --z-min 100 --z-max 300 --dry-run",
            "diffuserbench calibrate volume --z-min 1.7 --z-max 3 --lenslet 250 --wavelength 520 "
            "--fall-off-deg 13",
        ),
    ),
)
"""Rows of :data:`calibration_routines.routine.routines`."""
