"""What an axial sweep measures: its planes, how many are needed, and its plan.

A camera behind a diffuser is calibrated by moving a point source along its axis and keeping one PSF a depth
(Kuo 2020, Sec. 4.3). The planes are evenly spaced in 1/z, because that is how the size of the pattern changes
(Eq. 4.7). One plane alone is the calibration of a photographic camera (Sec. 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from instrument.acquire import abilities_of
from instrument.bench import Bench
from instrument.errors import BenchError
from instrument.plan import OFF, SOURCE, Part, Plan, SourcePoints, Span, check
from recon.types import Geometry


@dataclass(frozen=True, slots=True)
class AxialSweep:
    """What to measure.

    Attributes
    ----------
    z_min_um, z_max_um : float
        Nearest and farthest plane, from the diffuser. Equal for a single PSF.
    planes : int
    x_um, y_um : float
        Where the source stands laterally.
    average : int
        Frames a plane; all are stored, their mean is the PSF (Kuo 2020, Sec. 6.4: 4).
    dark_frames : int
        Frames without light, at the shortest and at the longest exposure each.
    target : float
        Fraction of full scale for the 99.9th percentile of each PSF.
    dct_order : int
        Lowest DCT coefficients removed along each axis, against stray light; 0 removes none.
    binning : int
        Software binning of the PSFs, on top of the camera's.
    retakes : int
        How often planes that saturate or slipped are taken again.
    by_hand : bool
        One plane only: the source stands where it was put by hand, nothing moves.
    """

    z_min_um: float
    z_max_um: float
    planes: int = 1
    x_um: float = 0.0
    y_um: float = 0.0
    average: int = 4
    dark_frames: int = 4
    target: float = 0.7
    dct_order: int = 0
    binning: int = 1
    retakes: int = 1
    by_hand: bool = False

    def __post_init__(self) -> None:
        problems = []
        if not 0 < self.z_min_um <= self.z_max_um:
            problems.append(
                f"planes must lie in front of the diffuser, nearest first: 0 < z min <= z max, "
                f"not {self.z_min_um / 1e3:g} and {self.z_max_um / 1e3:g} mm"
            )
        if self.planes < 1 or (self.planes == 1) != (self.z_min_um == self.z_max_um):
            problems.append(f"{self.planes} planes between z min and z max: one plane needs z min = z max")
        if self.by_hand and self.planes > 1:
            problems.append(f"{self.planes} planes need a stage; by hand one PSF is taken at a time")
        for name in ("average", "dark_frames", "binning"):
            if getattr(self, name) < 1:
                problems.append(f"{name} must be at least 1, not {getattr(self, name)}")
        if not 0.05 <= self.target <= 0.9:
            problems.append(f"target must lie between 0.05 and 0.9 of full scale, not {self.target:g}")
        if problems:
            raise BenchError("; ".join(problems) + ".")

    @property
    def z_um(self) -> tuple[float, ...]:
        """Depths of the planes, nearest first, evenly spaced in 1/z (Kuo 2020, Eq. 4.7)."""
        return Span(start=self.z_min_um, stop=self.z_max_um, number=self.planes, spacing="dioptric").values()


def planes_needed(z_min_um: float, z_max_um: float, geometry: Geometry, feature_px: float = 2.0) -> int:
    """Return how many planes leave no depth between them unsampled.

    From plane to plane the edge of the aperture's shadow moves on the sensor by ``w / 2 * d * (1/z1 - 1/z2)``
    (from the scaling ``1 + d/z``), which may be one feature of the PSF at most: the constant of Kuo 2020,
    Eq. 4.7. The PSF's smallest features are about two pixels (Sec. 4.3).

    Raises
    ------
    BenchError
        When the geometry lacks the aperture, the distance d or the pixel pitch.
    """
    if (
        geometry.aperture_mm is None
        or geometry.diffuser_distance_mm is None
        or geometry.pixel_pitch_um is None
    ):
        raise BenchError(
            "How many planes are needed follows from aperture_mm, diffuser_distance_mm and pixel_pitch_um: "
            "give them in [geometry] of bench.toml, or give the number of planes."
        )
    edge_um2 = 1e6 * max(geometry.aperture_mm) / 2 * geometry.diffuser_distance_mm
    travel_px = edge_um2 * (1 / z_min_um - 1 / z_max_um) / geometry.pixel_pitch_um
    return 1 + int(np.ceil(travel_px / feature_px - 1e-9))


def axial_plan(sweep: AxialSweep, exposures_ms: Sequence[float], label: str = "axial sweep") -> Plan:
    """Return the plan: dark frames at the shortest and longest exposure, then each plane from near to far."""
    depths = sweep.z_um
    if len(exposures_ms) != len(depths):
        raise ValueError(f"{len(depths)} planes need as many exposures, not {len(exposures_ms)}.")
    return plan_planes(sweep, list(zip(depths, exposures_ms, strict=True)), label)


def plan_planes(sweep: AxialSweep, planes: Sequence[tuple[float, float]], label: str) -> Plan:
    """Return the plan for planes given as ``(z_um, exposure_ms)``, dark frames first."""
    exposures_ms = [exposure_ms for _, exposure_ms in planes]
    dark = Part(
        label="dark",
        light=(OFF,),
        exposures_ms=tuple(sorted({min(exposures_ms), max(exposures_ms)})),
        repeats=sweep.dark_frames,
    )
    psfs = (
        Part(
            label="psf",
            positions=None if sweep.by_hand else SourcePoints(points_um=((sweep.x_um, sweep.y_um, z_um),)),
            light=(SOURCE,),
            exposures_ms=(exposure_ms,),
            repeats=sweep.average,
        )
        for z_um, exposure_ms in planes
    )
    return Plan(label=label, parts=(dark, *psfs))


def check_sweep(bench: Bench, sweep: AxialSweep, folder: Path | None = None) -> Plan:
    """Refuse a sweep that leaves the bench's limits or the disk, before anything moves; returns a first plan.

    The plan is made with the camera's present exposure; :func:`expose_sweep` finds the right ones. The stage
    need not be homed yet: limits hold all the same, and the sweep itself is checked again.

    Raises
    ------
    PlanError
        Naming every step that cannot be done.
    """
    plan = axial_plan(sweep, [bench.camera.exposure_ms] * sweep.planes)
    check(plan, replace(abilities_of(bench, folder), stage_homed=True))
    return plan
