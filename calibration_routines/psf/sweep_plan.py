"""A sweep's plan on the bench: dark frames, the points in order, visits to a reference point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration_routines.psf.sampling import Position
from calibration_routines.psf.sweep_options import Sweep
from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.plan import OFF, SOURCE, Part, Plan, SourcePoints, check
from instrument.runs.acquire import abilities_of

DARK, PSF, REFERENCE = "dark", "psf", "reference"
"""Labels of a sweep's steps."""
LEAST_POINTS_WITH_REFERENCE = 4
"""A shorter sweep is over before a source drifts: no reference visits."""
LEAST_SIDE_PX = 16
"""A PSF image with a shorter side shows no pattern that could be judged or reconstructed with."""


def check_image_settings(sweep: Sweep, frame_shape: Sequence[int]) -> None:
    """Refuse a binning or a number of DCT coefficients that leaves nothing of frames of this shape.

    Raises
    ------
    SettingsError
        Naming the largest values that fit.
    """
    height, width = frame_shape[:2]
    binning = max(sweep.binning, 1)  # automatic: known only once there are frames
    problems = []
    if min(height, width) // binning < LEAST_SIDE_PX:
        most = max(1, min(height, width) // LEAST_SIDE_PX)
        words = (
            f"binning {binning} leaves {height // binning} x {width // binning} pixels of the camera's "
            f"{height} x {width}, fewer than {LEAST_SIDE_PX} on a side: choose {most} at most"
        )
        problems.append(("binning", words))
    elif sweep.dct_order > min(height, width) // binning:
        words = (
            f"{sweep.dct_order} DCT coefficients along each axis (dct) are more than the image's "
            f"{height // binning} x {width // binning} pixels have: choose "
            f"{min(height, width) // binning} at most; Kuo 2020, Sec. 6.4 removes 10"
        )
        problems.append(("dct_order", words))
    if problems:
        raise SettingsError(problems)


def depths_um(sweep: Sweep) -> tuple[float, ...]:
    """Return the depths of a sweep, nearest first."""
    return tuple(sorted({z for _, _, z in sweep.points_um}))


def axis_point(sweep: Sweep, z_um: float) -> Position:
    """Return the point of a depth that is nearest to the axis; its PSF is the depth's central one."""
    return min((p for p in sweep.points_um if p[2] == z_um), key=lambda p: float(np.hypot(p[0], p[1])))


def reference_point(sweep: Sweep) -> Position | None:
    """Return the point that is revisited: on the axis, at the middle depth; None for a short sweep."""
    if sweep.by_hand or not sweep.reference_every or len(sweep.points_um) < LEAST_POINTS_WITH_REFERENCE:
        return None
    depths = depths_um(sweep)
    return axis_point(sweep, depths[len(depths) // 2])


def sweep_plan(sweep: Sweep, exposures_ms: Sequence[float]) -> Plan:
    """Return the plan: dark frames at the shortest and longest exposure, then every point in order.

    The reference point is visited before the first point, after every ``reference_every``, and after the
    last, with its own exposure.

    Parameters
    ----------
    sweep : Sweep
    exposures_ms : sequence of float
        One a point.
    """
    points_um = sweep.points_um  # once: an axial sweep computes them anew each time
    if len(exposures_ms) != len(points_um):
        raise ValueError(f"{len(points_um)} points need as many exposures, not {len(exposures_ms)}.")
    reference = reference_point(sweep)
    parts = []
    for start in range(0, len(points_um), sweep.reference_every or len(points_um)):
        stop = start + (sweep.reference_every or len(points_um))
        if reference is not None:
            exposure_ms = exposures_ms[points_um.index(reference)]
            parts.append(_point(sweep, REFERENCE, reference, exposure_ms))
        points = zip(points_um[start:stop], exposures_ms[start:stop], strict=True)
        parts += [_point(sweep, PSF, point, exposure_ms) for point, exposure_ms in points]
    if reference is not None:
        parts.append(parts[0])
    return Plan(label=f"{sweep.kind} sweep", parts=(_dark(sweep, exposures_ms), *parts))


def retake_plan(sweep: Sweep, points: Sequence[tuple[Position, float]]) -> Plan:
    """Return the plan for some points again, each with its exposure; dark frames of their own first."""
    parts = [_point(sweep, PSF, point, exposure_ms) for point, exposure_ms in points]
    dark = _dark(sweep, [exposure_ms for _, exposure_ms in points])
    return Plan(label=f"{sweep.kind} sweep retake", parts=(dark, *parts))


def check_sweep(bench: Bench, sweep: Sweep, folder: Path | None = None) -> Plan:
    """Refuse a sweep that leaves the bench's limits or the disk, before anything moves; returns a first plan.

    The plan is made with the camera's present exposure, by a trifle another for the last of several points so
    that there are dark frames at two exposures; :func:`~calibration_routines.expose_sweep` finds the right
    ones. The stage need not be homed yet: limits hold all the same, and the sweep itself is checked
    again.

    Raises
    ------
    PlanError
        Naming every step that cannot be done.
    SettingsError
        When binning or DCT order do not fit the camera's frames.
    """
    check_image_settings(sweep, bench.camera.frame_shape)
    present_ms, (shortest_ms, longest_ms) = bench.camera.exposure_ms, bench.camera.exposure_limits_ms
    exposures_ms = [present_ms] * len(sweep.points_um)
    if len(exposures_ms) > 1:
        limit_ms = shortest_ms if present_ms > shortest_ms else longest_ms
        exposures_ms[-1] = float(np.nextafter(present_ms, limit_ms))
    plan = sweep_plan(sweep, exposures_ms)
    check(plan, replace(abilities_of(bench, folder), stage_homed=True))
    return plan


def _dark(sweep: Sweep, exposures_ms: Sequence[float]) -> Part:
    ends = tuple(sorted({min(exposures_ms), max(exposures_ms)}))
    return Part(label=DARK, light=(OFF,), exposures_ms=ends, repeats=sweep.dark_frames)


def _point(sweep: Sweep, label: str, point: Position, exposure_ms: float) -> Part:
    return Part(
        label=label,
        positions=None if sweep.by_hand else SourcePoints(points_um=(point,)),
        light=(SOURCE,),
        exposures_ms=(exposure_ms,),
        repeats=sweep.average,
    )
