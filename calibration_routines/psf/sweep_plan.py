"""A sweep on the bench, before it is taken: the exposure of every point, the plan, what is kept of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.psf.exposure import AutoExposure, TooDarkError, expose_source
from calibration_routines.psf.sampling import Position
from calibration_routines.psf.sweep_options import AxialSweep, PointSweep
from calibration_routines.purpose import Purpose
from instrument.bench.bench import Bench
from instrument.files.calibration_file import IN_SWEEP
from instrument.files.errors import SettingsError, count, duration
from instrument.files.record import RecordFormat, plain
from instrument.plan import OFF, SOURCE, Part, Plan, SourcePoints, check, estimate
from instrument.runs.acquire import abilities_of
from instrument.runs.run_control import RunControl
from recon.types import Geometry

DARK, PSF, REFERENCE = "dark", "psf", "reference"
"""Labels of a sweep's steps."""
LEAST_SIDE_PX = 16
"""A PSF image with a shorter side shows no pattern that could be judged or reconstructed with."""


def check_image_settings(sweep: PointSweep, frame_shape: Sequence[int]) -> None:
    """Refuse a binning or a number of DCT coefficients that leaves nothing of frames of this shape.

    Raises SettingsError, which names the largest values that fit.
    """
    height, width = frame_shape[:2]
    binning = max(sweep.binning, 1)  # automatic: known only once there are frames
    if min(height, width) // binning < LEAST_SIDE_PX:
        most = max(1, min(height, width) // LEAST_SIDE_PX)
        words = (
            f"binning {binning} leaves {height // binning} x {width // binning} pixels of the camera's "
            f"{height} x {width}, fewer than {LEAST_SIDE_PX} on a side: choose {most} at most"
        )
        raise SettingsError([("binning", words)])
    if sweep.dct_order > min(height, width) // binning:
        words = (
            f"{sweep.dct_order} DCT coefficients along each axis (dct) are more than the image's "
            f"{height // binning} x {width // binning} pixels have: choose "
            f"{min(height, width) // binning} at most; Kuo 2020, Sec. 6.4 removes 10"
        )
        raise SettingsError([("dct_order", words)])


def sweep_plan(sweep: PointSweep, exposures_ms: Sequence[float]) -> Plan:
    """Return the plan: every point in order, and dark frames at the shortest and longest exposure.

    Half of the dark frames come first, half last: other light that came in meanwhile and pixels that turned
    hot are seen in the difference.

    The reference point is visited before the first point, after every ``reference_every``, and after the
    last, with its own exposure. ``exposures_ms`` has one a point.
    """
    points_um = sweep.points_um
    if len(exposures_ms) != len(points_um):
        raise ValueError(f"{len(points_um)} points need as many exposures, not {len(exposures_ms)}.")
    reference = sweep.reference_point
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
    late = sweep.dark_frames // 2
    first, last = (_dark(exposures_ms, frames) for frames in (sweep.dark_frames - late, late))
    return Plan(label=f"{sweep.kind} sweep", parts=(*first, *parts, *last))


def retake_plan(sweep: PointSweep, points: Sequence[tuple[Position, float]]) -> Plan:
    """Return the plan for some points again, each with its exposure; dark frames of their own first."""
    parts = [_point(sweep, PSF, point, exposure_ms) for point, exposure_ms in points]
    dark = _dark([exposure_ms for _, exposure_ms in points], sweep.dark_frames)
    return Plan(label=f"{sweep.kind} sweep retake", parts=(*dark, *parts))


def check_sweep(bench: Bench, sweep: PointSweep, folder: Path | None = None) -> Plan:
    """Refuse a sweep that leaves the bench's limits or the disk, before anything moves; returns a first plan.

    The plan is made with the camera's present exposure, by a trifle another for the last of several points so
    that there are dark frames at two exposures; :func:`~calibration_routines.expose_sweep` finds the right
    ones. The stage need not be homed yet: limits hold all the same, and the sweep itself is checked
    again.

    Raises PlanError, which names every step that cannot be done, or SettingsError when binning or DCT order
    do not fit the camera's frames.
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


def _dark(exposures_ms: Sequence[float], frames: int) -> tuple[Part, ...]:
    ends = tuple(sorted({min(exposures_ms), max(exposures_ms)}))
    return (Part(label=DARK, light=(OFF,), exposures_ms=ends, repeats=frames),) if frames else ()


def _point(sweep: PointSweep, label: str, point: Position, exposure_ms: float) -> Part:
    return Part(
        label=label,
        positions=None if sweep.by_hand else SourcePoints(points_um=(point,)),
        light=(SOURCE,),
        exposures_ms=(exposure_ms,),
        repeats=sweep.average,
    )


FEATURE_PX = 2.0
"""Pixels that the finest structure must still cover: Nyquist (Kuo 2020, Sec. 4.3)."""
_MUCH_BYTES = 10e9  # of a sweep, above which the plan says how to need less


def plan_lines(bench: Bench, sweep: PointSweep, plan: Plan, folder: Path | None) -> list[str]:
    """Return what a sweep will do and cost, before it starts."""
    cost = estimate(plan, abilities_of(bench, folder))
    depths = sweep.depths_um
    listed = ", ".join(f"{z_um / 1e3:.4g}" for z_um in depths)
    if sweep.kind == "axial":
        lines = [f"Planes (mm): {listed}"]
        what = count(len(depths), "plane")
    else:
        planes = f"at {len(depths)} depths (mm): {listed}" if len(depths) > 1 else "at one depth"
        lines = [f"Points: {len(sweep.points_um)} {planes}"]
        what = count(len(sweep.points_um), "point")
    lit = len(sweep.points_um) * sweep.average
    dark = sum(step.label == DARK for step in plan.steps())
    revisits = ""
    if sweep.reference_point is not None:
        visits = (cost.frames - lit - dark) // sweep.average
        revisits = f" + {count(visits, 'visit')} to a reference x {sweep.average}"
    lines.append(
        f"Plan: {what} x {count(sweep.average, 'frame')}{revisits} + {count(dark, 'dark frame')} "
        f"= {count(cost.frames, 'frame')}, {cost.total_bytes / 1e6:.0f} MB at most, "
        f"{cost.time_of_motion}."
    )
    if cost.approaches:
        axes = ", ".join(f"{name[0]} {play:g} um" for name, play in bench.play.items())
        lines.append(
            f"Because of the stage's play ({axes}) {count(cost.approaches, 'move')} go below the place "
            f"first, which costs {duration(cost.approach_seconds)} of these."
        )
    if cost.total_bytes > _MUCH_BYTES:
        lines.append(
            f"Note: {cost.total_bytes / 1e9:.0f} GB are much. Fewer frames a PSF (--average), a larger "
            "--spacing or fewer --planes make it less, and so does binning in [camera]."
        )
    return lines


# Exposures ---------------------------------------------------------------------------------------------
_MOST_BOOST = 10.0  # exposure off the axis over that on it: beyond, a wrong guess would cost too much time
_CAUTION = 0.7  # of the logarithm: farther out than was asked, a brighter spot may lie on the sensor
_BESIDE = (2 / 3, 1 / 3, 1 / 6)
"""Of the field's radius: where the exposure off the axis is asked; farther in while the pattern misses the
sensor."""


@dataclass(frozen=True, slots=True)
class SweepExposures:
    """The exposure of every point of a sweep and how it was found."""

    exposures_ms: tuple[float, ...]
    found: tuple[tuple[float, AutoExposure], ...]
    """``(z_um, auto-exposure)`` where the camera was asked; planes between are interpolated."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Where the light did not suffice for the target, in words."""
        return tuple(
            f"z = {z_um / 1e3:g} mm: {exposure.message}"
            for z_um, exposure in self.found
            if not exposure.usable
        )


def expose_sweep(bench: Bench, sweep: PointSweep, *, control: RunControl | None = None) -> SweepExposures:
    """Find the exposure of every point: asked at up to three depths, interpolated between them.

    Light through the aperture falls off as a power of distance, so exposure against z is nearly a straight
    line in logarithms. Where a depth has points off the axis, one of them about two thirds out is asked as
    well: the logarithm of a Gaussian response goes with the square of the tangent. Ends with the light off.

    Raises CalibrationError when a PSF saturates at the shortest exposure, stays too dark at the longest, or
    flickers; EndedEarlyError when it was ended through ``control``.
    """
    control, depths = control or RunControl(), sweep.depths_um
    asked = sorted({depths[0], depths[len(depths) // 2], depths[-1]})
    found: list[tuple[float, AutoExposure]] = []
    slopes: list[float] = []
    try:
        for z_um in asked:
            control.check()
            axis = sweep.axis_point(z_um)
            if not sweep.by_hand:
                bench.place_source(*axis)
            found.append((z_um, expose_source(bench, target=sweep.target)))
            slopes.append(_slope(bench, sweep, axis, found[-1][1].exposure_ms, control))
    finally:
        bench.source_off()
    longest = bench.camera.exposure_limits_ms[1]
    exposures = []
    for point in sweep.points_um:
        axis = sweep.axis_point(point[2])
        on_axis = np.interp(np.log(point[2]), np.log(asked), np.log([one.exposure_ms for _, one in found]))
        slope = float(np.interp(np.log(point[2]), np.log(asked), slopes))
        boost = min(_CAUTION * slope * _tangent_squared(point, axis), np.log(_MOST_BOOST))
        exposures.append(min(float(np.exp(on_axis + boost)), longest))
    return SweepExposures(tuple(exposures), tuple(found))


def _slope(bench: Bench, sweep: PointSweep, axis: Position, on_axis_ms: float, control: RunControl) -> float:
    """Return how the logarithm of the exposure grows with the squared tangent; 0 where no place tells."""
    for beside in _beside(sweep, axis):
        control.check()
        bench.place_source(*beside)
        try:
            dimmer = expose_source(bench, target=sweep.target)
        except TooDarkError:
            continue  # lit on the axis, so the source works: from here its light misses the sensor
        more = np.log(dimmer.exposure_ms / on_axis_ms)
        return max(0.0, float(more)) / _tangent_squared(beside, axis)
    return 0.0


def _beside(sweep: PointSweep, axis: Position) -> list[Position]:
    """Return points of the axis point's depth, about two thirds out first; none where it is alone."""
    others = [p for p in sweep.points_um if p[2] == axis[2] and p != axis]
    farthest = max((_tangent_squared(p, axis) for p in others), default=0.0)

    def nearest(part: float) -> Position:
        return min(others, key=lambda p: abs(_tangent_squared(p, axis) - part**2 * farthest))

    return list(dict.fromkeys(nearest(part) for part in _BESIDE)) if others else []


def _tangent_squared(point: Position, axis: Position) -> float:
    return ((point[0] - axis[0]) ** 2 + (point[1] - axis[1]) ** 2) / point[2] ** 2


# What is kept in the run's folder ----------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class SweepRecord:
    """What the analysis needs besides the frames."""

    sweep: PointSweep
    exposures: SweepExposures
    geometry: Geometry
    bench: str
    simulated: bool
    source_size_um: float | None = None
    """Diameter of the pinhole, as the bench's configuration has it."""


def size_findings(size_um: float | None, geometry: Geometry, z_um: float) -> tuple[str, ...]:
    """Return what is to be said of a source too large for the resolution, seen from the nearest depth."""
    image_px = source_width_px(size_um, geometry, z_um)
    if size_um is None or image_px <= FEATURE_PX:
        return ()
    return (
        f"the source is too large: its {size_um:g} um ([source] size_um) are {image_px:.1f} pixels wide on "
        f"the sensor at z = {z_um / 1e3:.4g} mm, and the PSF is blurred (at most {FEATURE_PX:g}): take "
        f"a pinhole of {size_um * FEATURE_PX / image_px:.2g} um or less, or go farther away.",
    )


def source_width_px(size_um: float | None, geometry: Geometry, z_um: float) -> float:
    """Return how wide the image of a source of this size at this depth is on the sensor; 0 where unknown."""
    d_mm, pitch_um = geometry.diffuser_distance_mm, geometry.pixel_pitch_um
    if size_um is None or d_mm is None or pitch_um is None:
        return 0.0
    return 1e3 * d_mm / z_um * size_um / pitch_um


def _with_points(old: dict[str, Any]) -> dict[str, Any]:
    """Bring a record up to date whose axial sweep had its depths' range, and its exposures at the top."""
    sweep = dict(old.pop("sweep"))
    if sweep["kind"] == "axial":
        del sweep["kind"]
        sweep = plain(AxialSweep(**sweep).points())
    found = [[one.pop("z_um"), one] for one in old.pop("found")]
    exposures = {"exposures_ms": old.pop("exposures_ms"), "found": found}
    return {"sweep": sweep, "exposures": exposures, **old}


SWEEP = Purpose(
    SweepRecord,
    "sweep.json",
    IN_SWEEP,
    RecordFormat(
        "diffuserbench sweep",
        "sweep",
        major=2,
        restore="The frames beside it are not touched: take the sweep again, or bring the file from a copy.",
        migrate={1: _with_points},
        unnamed_before=True,
    ),
)
"""A sweep is a run with its record; the calibration is a folder inside the run's."""
