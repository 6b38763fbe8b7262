"""A sweep of the point source as data: where it goes, how each PSF is taken, its plan on the bench."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.plan import OFF, SOURCE, Part, Plan, SourcePoints, check
from instrument.runs.acquire import abilities_of

Position = tuple[float, float, float]

DARK, PSF, REFERENCE = "dark", "psf", "reference"
"""Labels of a sweep's steps."""
LEAST_POINTS_WITH_REFERENCE = 4
"""A shorter sweep is over before a source drifts: no reference visits."""
LEAST_SIDE_PX = 16
"""A PSF image with a shorter side shows no pattern that could be judged or reconstructed with."""


class Sweep(Protocol):
    """What the sweeping, and the analysis after it, need to know of a sweep."""

    @property
    def kind(self) -> str:
        """``"axial"``, ``"lateral"`` or ``"volume"``."""

    @property
    def points_um(self) -> tuple[Position, ...]:
        """Where the source stands for each PSF, in the order of the visits."""

    @property
    def average(self) -> int:
        """Frames a point."""

    @property
    def dark_frames(self) -> int:
        """Frames without light, at the shortest and at the longest exposure each."""

    @property
    def target(self) -> float:
        """Fraction of full scale for the 99.9th percentile of the PSF on the axis."""

    @property
    def dct_order(self) -> int:
        """Lowest DCT coefficients removed along each axis; 0 removes none."""

    @property
    def binning(self) -> int:
        """Software binning; 0: to the optical resolution."""

    @property
    def retakes(self) -> int:
        """How often PSFs that saturate or slipped are taken again."""

    @property
    def by_hand(self) -> bool:
        """Whether the source stands where it was put by hand; nothing moves then."""

    @property
    def reference_every(self) -> int:
        """Points between two visits to the reference point; 0: none."""


@dataclass(frozen=True, slots=True)
class PointSweep:
    """PSFs at listed places; the attributes are those of :class:`Sweep`."""

    points_um: tuple[Position, ...]
    kind: str = "volume"
    average: int = 4
    dark_frames: int = 4
    target: float = 0.7
    dct_order: int = 0
    binning: int = 1
    retakes: int = 1
    reference_every: int = 10
    by_hand: bool = False

    def __post_init__(self) -> None:
        problems = settings_problems(self)
        if not self.points_um:
            problems.append(("points_um", "a sweep needs at least one point"))
        if len(set(self.points_um)) != len(self.points_um):
            problems.append(("points_um", "a point is listed twice"))
        if not np.isfinite(self.points_um).all():
            problems.append(("points_um", "every coordinate of a point must be a finite number"))
        if any(z <= 0 for _, _, z in self.points_um):
            problems.append(("points_um", "every point must lie in front of the diffuser, z > 0"))
        if problems:
            raise SettingsError(problems)


def settings_problems(sweep: Sweep) -> list[tuple[str, str]]:
    """Return what is wrong with a sweep's settings: their names, and words."""
    problems = [
        (name, f"{name} must be at least {least}, not {getattr(sweep, name)}")
        for name, least in (
            ("average", 1),
            ("dark_frames", 1),
            ("binning", 0),
            ("dct_order", 0),
            ("retakes", 0),
            ("reference_every", 0),
        )
        if getattr(sweep, name) < least
    ]
    if not 0.05 <= sweep.target <= 0.9:
        problems.append(
            ("target", f"target must lie between 0.05 and 0.9 of full scale, not {sweep.target:g}")
        )
    return problems


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
