"""Two calibrations of one camera compared: what moved, and whether to calibrate again.

What became of each PSF is in :mod:`recon.analysis.pattern_change`, which part moved in
:mod:`recon.analysis.what_moved`; here it becomes a verdict, in sentences.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from recon.analysis.pattern_change import PARTS, Change, compare_psfs
from recon.analysis.what_moved import Explanation, Seen, moved_across, moved_along, seen_px, unseen
from recon.arrays import Array
from recon.base.blocks import block_mean
from recon.base.checks import require_calibration
from recon.camera.depth_mixture import central_psfs
from recon.camera.grid import depth_in_words
from recon.camera.refocus import psf_at
from recon.errors import InputError
from recon.types import Calibration, Geometry

WIDER = 1.1
"""Spot that the old PSF makes of the new camera's light, over the sharpest: above this, calibrate again."""
EDGE_PX = 0.5
"""Displacement at the pattern's edge by scale or rotation that counts: a quarter of the smallest features."""
SHIFT_PX = 1.0
"""Shift from which pictures and depths of one calibration no longer lie on those of the other."""
DIMMER = 0.05
"""Relative change of brightness that is worth a word."""
DRIFTED = 0.03
"""Of the light between depths, likewise: noise changes it by a thousandth."""
_TELLS = 0.1  # relative change of light that a lamp does not have by itself
FRESH = 0.98
"""Inner product after alignment below which the pattern has changed, if the spot has not grown as well."""
MORE_ALIKE = 0.2
"""Of what a turned pattern lacks of being alike: a pattern that gains no more than this on it is another."""
ALIKE = 0.7
"""Inner product from which patterns are one whatever the turned one has: regular lenslets, or a spot, are
their own half turn. Measured diffusers have 0.5 in common with theirs."""
_SAME_PITCH = 1e-3  # relative: pitches of one camera are equal but for how they were written


@dataclass(frozen=True)
class Comparison:
    """Two calibrations compared."""

    changes: tuple[Change, ...]
    """At up to three depths of the new calibration."""
    due: bool
    """Whether to calibrate again (to use the new calibration instead of the old)."""
    reasons: tuple[str, ...]
    """Why, or why not, in sentences."""


def _size(calibration: Calibration) -> str:
    channels, height, width = calibration.psfs.shape[1:]
    pitch_um = calibration.geometry.pixel_pitch_um
    pixels = f"{height} x {width} pixels" + (f" of {pitch_um:.3g} um" if pitch_um is not None else "")
    return f"{pixels}, {channels} colour{'s' if channels > 1 else ''}"


def binned_alike(old: Calibration, new: Calibration) -> tuple[Calibration, Calibration, float]:
    """Return both on the coarser one's pixels, and the side of the new one's pixels over the old one's.

    Raises InputError where they cannot be laid on one another: another camera, or another region of interest.
    """
    before_um, after_um = (c.geometry.pixel_pitch_um for c in (old, new))
    ratio = old.psfs.shape[-1] / new.psfs.shape[-1]
    if before_um is not None and after_um is not None:
        ratio = after_um / before_um
    known = None not in (before_um, after_um)
    factor = round(max(ratio, 1 / ratio))
    fine, coarse = (old, new) if ratio > 1 else (new, old)
    same_pitch = not known or math.isclose(max(ratio, 1 / ratio), factor, rel_tol=_SAME_PITCH)
    shape = fine.psfs.shape[1], *(n // factor for n in fine.psfs.shape[2:])
    if shape != coarse.psfs.shape[1:] or not same_pitch:
        raise InputError(
            f"The cameras or their settings differ: the old PSFs have {_size(old)}, the new ones "
            f"{_size(new)}. Only calibrations of one camera with the same region of interest compare."
        )
    if factor == 1:
        return old, new, 1.0
    psfs = block_mean(fine.psfs, factor)
    fine = replace(fine, psfs=psfs, background=None, geometry=coarse.geometry)
    return (fine, new, float(factor)) if ratio > 1 else (old, fine, 1 / factor)


def _of_binned(changes: list[Change], ratio: float) -> tuple[list[Change], tuple[str, ...]]:
    """Return changes of brightness as a camera has them that adds binned pixels where that is more likely."""
    if ratio == 1:
        return changes, ()
    brightness, added = float(np.median([c.brightness for c in changes])), ratio**2
    if brightness > 0 and abs(math.log(brightness / added)) < abs(math.log(brightness)):
        changes = [replace(c, brightness=c.brightness / added) for c in changes]
    coarser, times = ("new", ratio) if ratio > 1 else ("old", 1 / ratio)
    return changes, (
        f"Another binning: pixels of the {coarser} PSFs are {times:.0f} times as large; both were compared "
        "with those. A photograph goes with PSFs that are binned as it is.",
    )


def compare(
    old: Calibration, new: Calibration, on_progress: Callable[[float], object] | None = None
) -> Comparison:
    """Compare a ``new`` calibration with an ``old`` one of the same camera.

    ``on_progress`` gets the share done.

    Depths that the old one does not have are refocused. Shift alone moves pictures without blurring them; it
    counts when it differs between depths, or for the position in space. Of another binning the finer one is
    binned, and that is said.

    Returns
    -------
    Comparison
        What changed at up to three depths, whether to calibrate again, and why.

    Raises InputError when the PSFs are of other regions or cameras, or depths are not known.
    """
    for given in (old, new):
        require_calibration(given)
    old, new, ratio = binned_alike(old, new)
    depths, planes = central_psfs(new)
    chosen = sorted({0, len(depths) // 2, len(depths) - 1})
    exposure = _exposure_ratio(old, new)
    changes: list[Change] = []
    for k in chosen:
        reference = _at(old, float(depths[k]))
        done = len(changes)

        def part_done(number: int, done: int = done) -> None:
            if on_progress is not None:
                on_progress((done + number / PARTS) / len(chosen))

        plane = planes[k].mean(axis=0)
        changes.append(compare_psfs(plane, reference, float(depths[k]), exposure, part_done))
    changes, binning = _of_binned(changes, ratio)
    due, reasons = _verdict(changes, new.geometry)
    return Comparison(tuple(changes), due, (*binning, *reasons))


def _at(old: Calibration, z_um: float) -> Array:
    depths, planes = central_psfs(old)
    nearest = int(np.argmin(np.abs(1 / depths - 1 / z_um)))
    if abs(depths[nearest] / z_um - 1) < 1e-6:
        return np.asarray(planes[nearest].mean(axis=0))
    return psf_at(old, z_um)


def _exposure_ratio(old: Calibration, new: Calibration) -> float:
    before, after = (c.provenance.get("reference_exposure_ms") for c in (old, new))
    if isinstance(before, int | float) and isinstance(after, int | float) and min(before, after) > 0:
        return after / before
    return 1.0


def _either(change: Change, distance_um: float) -> str:
    """Return by how much the diffuser moved, or else the source, and which of both the light says."""
    if not np.isfinite(change.z_um) or abs(change.scale - 1) < 1e-4:
        return ""
    change_um = (change.scale - 1) * (change.z_um + distance_um)  # scale = (1 + d'/z) / (1 + d/z)
    to = "farther from" if change_um > 0 else "nearer to"
    words = f" If the diffuser moved, it is {abs(change_um):.3g} um {to} the sensor."
    return words + _source_instead(change, distance_um)


def _source_instead(change: Change, distance_um: float) -> str:
    """Return where the source stood if not the diffuser moved, and which of both the light says."""
    nearness = change.scale * (1 + distance_um / change.z_um) - 1
    if nearness <= 0:
        return ""
    stood_um = distance_um / nearness
    expected = (change.z_um / stood_um) ** 2
    words = (
        f" If the source did, it stands at {stood_um / 1e3:.4g} instead of {change.z_um / 1e3:.4g} mm, and "
        f"gives {expected:.2f} times the light"
    )
    if abs(expected - 1) < _TELLS:
        return f"{words}: the light does not tell."
    if abs(change.brightness / expected - 1) < 0.25 * abs(expected - 1):
        return f"{words}, as is seen: it was the source, unless the lamp changed."
    if abs(change.brightness - 1) < 0.25 * abs(expected - 1):
        return f"{words}, which is not seen: it was the diffuser, unless the lamp changed."
    return f"{words}; {change.brightness:.2f} is seen, which tells neither."


def _seen(changes: list[Change]) -> list[Seen]:
    return [
        Seen(c.z_um, c.rows, c.columns, c.scale - 1, c.place_error_px, c.scale_error, c.extent_px)
        for c in changes
    ]


def _what_moved(changes: list[Change], geometry: Geometry) -> tuple[Explanation | None, Explanation | None]:
    """Return what moved across and along, where there are several depths and the geometry is known."""
    known = geometry.diffuser_distance_mm, geometry.pixel_pitch_um
    if None in known or len(changes) < 2 or not all(math.isfinite(c.place_error_px) for c in changes):
        return None, None
    distance_um, pitch_um = 1e3 * (known[0] or 0.0), known[1] or 0.0
    seen = _seen(changes)
    return moved_across(seen, distance_um, pitch_um), moved_along(seen, distance_um)


def _verdict(changes: list[Change], geometry: Geometry) -> tuple[bool, tuple[str, ...]]:
    due, reasons = False, []
    distance_um = None if geometry.diffuser_distance_mm is None else 1e3 * geometry.diffuser_distance_mm
    across, along = _what_moved(changes, geometry)
    alike = max(max(c.as_is, c.aligned) - c.decoy for c in changes)
    best = max(max(c.as_is, c.aligned) for c in changes)
    if best < ALIKE and alike < MORE_ALIKE * (1 - max(c.decoy for c in changes)):
        return True, (
            f"These are different patterns: at best {best:.2f} alike, no more than one turned by 180 degrees "
            f"({max(c.decoy for c in changes):.2f}). Another diffuser, or another part or side of it; shift, "
            "size and rotation tell nothing then. Use the new calibration.",
        )
    spot = max(c.spot for c in changes)
    # What a recalibration is due for, else what is seen most clearly: one depth may be noisier than another.
    edge = max(changes, key=lambda c: (c.edge_px > EDGE_PX, c.edge_px / _seen_edge_px(c)))
    if spot > WIDER:
        due = True
        reasons.append(f"With the old PSFs, spots come out {spot:.2f} times as wide as they could be.")
    if edge.edge_px > min(EDGE_PX, _seen_edge_px(edge)):
        due = due or edge.edge_px > EDGE_PX
        reasons.append(_edge(edge, changes, along, distance_um))
    least = min(c.aligned for c in changes)
    if least < FRESH:
        due = due or spot > WIDER or least < FRESH - 0.08
        reasons.append(
            f"Even aligned, the patterns are only {least:.3f} alike: noise, dust, or another tilt or place "
            "of the diffuser."
        )
    shifts = np.array([[c.rows, c.columns] for c in changes])
    spread = float(np.hypot(*np.ptp(shifts, axis=0)))
    limits = [min(SHIFT_PX, seen_px(c.place_error_px)) for c in changes]  # each depth's own
    largest = max((m for m, px in zip(np.hypot(*shifts.T), limits, strict=True) if m > px), default=0.0)
    if spread > SHIFT_PX:
        due = True
        reasons.append(
            f"The shift differs by {spread:.2g} pixels between depths, and volumes would be sheared."
            + _said(across, len(changes))
        )
    elif largest > SHIFT_PX:
        reasons.append(
            f"The pattern moved by {largest:.3g} pixels: pictures move by as much, and stay as sharp."
            + _said(across, len(changes))
        )
    elif largest > 0:
        reasons.append(f"The pattern moved by {largest:.2g} pixels.{_said(across, len(changes))}")
    reasons += _light(changes)
    reasons.append(unseen(_seen(changes), distance_um, geometry.pixel_pitch_um, (SHIFT_PX, DRIFTED)))
    if not due:
        reasons.insert(0, "The old calibration still serves.")
    return due, tuple(reasons)


def _seen_edge_px(change: Change) -> float:
    return seen_px(change.scale_error * change.extent_px)


def _grown_px(change: Change) -> float:
    return abs(change.scale - 1) * change.extent_px


def _turned_px(change: Change) -> float:
    return abs(math.radians(change.rotation_deg or 0.0)) * change.extent_px


def _edge(change: Change, changes: list[Change], along: Explanation | None, distance_um: float | None) -> str:
    """Return what became of a pattern's size and turn, whichever is seen, and what explains the size.

    ``change`` is the one of ``changes`` to tell; where it is turned alone, another depth's size is told too,
    and where it is not turned, another depth's turn.
    """
    least_px = _seen_edge_px(change)
    turned = _turned_px(change) > least_px
    grown = _grown_px(change) > least_px
    found = [f"{change.scale - 1:+.2%} in size"] if grown or not turned else []
    found += [f"turned by {change.rotation_deg:+.2f} degrees"] if turned else []
    words = f"The pattern is {' and '.join(found)}, {change.edge_px:.2g} pixels at its edge."
    other = max(changes, key=lambda c: _turned_px(c) / _seen_edge_px(c))
    if not turned and _turned_px(other) > _seen_edge_px(other):
        words += (
            f" At {depth_in_words(other.z_um)} it is turned by {other.rotation_deg:+.2f} degrees, "
            f"{_turned_px(other):.2g} pixels at its edge."
        )
    if not grown:
        change = max(changes, key=lambda c: _grown_px(c) / _seen_edge_px(c))
        if _grown_px(change) <= _seen_edge_px(change):
            return words
        words += (
            f" At {depth_in_words(change.z_um)} it is {change.scale - 1:+.2%} in size, "
            f"{_grown_px(change):.2g} pixels at its edge."
        )
    if along is not None:
        words += f" {along.sentence}"
    if distance_um is None:
        return words
    if along is None:
        return words + _either(change, distance_um)
    return words + (_source_instead(change, distance_um) if len(along.parts) > 1 else "")


def _said(across: Explanation | None, depths: int) -> str:
    if across is not None:
        return f" {across.sentence}"
    return " One depth does not tell whether source, diffuser or sensor moved." if depths == 1 else ""


def _light(changes: list[Change]) -> list[str]:
    """Return what became of the light: of all depths, and between them."""
    light = np.array([c.brightness for c in changes])
    brightness = float(np.median(light))
    found = []
    if abs(brightness - 1) > DIMMER:
        found.append(
            f"The light is {brightness:.2f} times what it was: check lamp and exposure; sharpness does not "
            "depend on it."
        )
    if np.ptp(light) > DRIFTED * brightness:
        seen = ", ".join(f"{c.brightness:.2f} at {c.z_um / 1e3:.4g}" for c in changes)
        found.append(
            f"The light changed differently at each depth (times what it was: {seen} mm): the lamp's drift "
            "in one of the sweeps, or a source nearer or farther."
        )
    return found
