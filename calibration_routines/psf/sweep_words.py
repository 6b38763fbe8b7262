"""A sweep's exposures and quality in sentences, for terminals and windows."""

from __future__ import annotations

from calibration_routines.psf.axial_exposure import SweepExposures
from calibration_routines.psf.psf_quality import place_of
from calibration_routines.psf.sweep import SweepCalibration
from calibration_routines.psf.sweep_watch import SourceVisit, SweepEvent

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
    if done.drift is not None and not done.drift.findings:
        lines.append(
            f"Source: {len(done.drift.brightness)} visits to the reference; brightness within "
            f"{max(abs(b - 1) for b in done.drift.brightness):.1%} (taken out of the PSFs), place within "
            f"{max(done.drift.shift_px):.2f} pixels."
        )
    return lines


def _verdict(done: SweepCalibration) -> str:
    quality = done.quality
    count = len(quality)
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
    plural = "s" if count > 1 else ""
    return f"{'all ' if count > 1 else ''}{count} PSF{plural} good. No saturated pixel; {'; '.join(words)}."
