"""What a person asks of a sweep, where the bench fills in what was left out: planes, field, spacing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration_routines.optics.angular_response import load_response
from calibration_routines.psf.axial_plan import AxialSweep
from calibration_routines.psf.sampling import GridSweep, axial_planes, grid_sweep
from calibration_routines.psf.sweep_plan import PointSweep, Sweep
from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.plan import Span
from recon.optics.fall_off import FallOff, gaussian_fall_off

MOST_PLANES = 256
"""More planes than these are a mistake, or must be asked for."""


@dataclass(frozen=True, slots=True)
class PlannedSweep:
    """A sweep with what its numbers come from, in words."""

    sweep: Sweep
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Taking:
    """How each PSF is taken, for every kind of sweep; see :class:`AxialSweep` and :class:`PointSweep`."""

    average: int = 4
    dark_frames: int = 4
    target: float = 0.7
    dct_order: int = 0
    binning: int = 1
    x_um: float = 0.0
    y_um: float = 0.0

    def _lateral(self) -> dict[str, tuple[int, float]]:
        return {"x_um": (0, self.x_um), "y_um": (1, self.y_um)}


@dataclass(frozen=True, slots=True, kw_only=True)
class AxialRequest(_Taking):
    """PSFs along the axis.

    Attributes
    ----------
    z_min_um : float
        Nearest plane, from the diffuser.
    z_max_um : float, optional
        Farthest plane; None: one PSF at ``z_min_um``.
    planes : int, optional
        None: as many as the optics need.
    lenslet_um, wavelength_nm : float, optional
        For the number of planes, with a microlens diffuser (:func:`axial_planes`).
    by_hand : bool
        The source was placed by hand; nothing moves.
    reference_every : int
        PSFs between two visits to the reference point; 0: none.
    """

    z_min_um: float
    z_max_um: float | None = None
    planes: int | None = None
    lenslet_um: float | None = None
    wavelength_nm: float | None = None
    by_hand: bool = False
    reference_every: int = 16

    def plan(self, bench: Bench) -> PlannedSweep:
        """Return the sweep that the bench should do; nothing moves.

        Raises
        ------
        SettingsError, BenchError
            When settings make no sense or what would be needed is not known of the bench.
        """
        far_um = self.z_min_um if self.z_max_um is None else self.z_max_um
        planes = self.planes
        reasons: tuple[str, ...] = ()
        if planes is None and 0 < self.z_min_um < far_um:
            planes, reasons = _planes(bench, self.z_min_um, far_um, self.lenslet_um, self.wavelength_nm)
        sweep = AxialSweep(
            z_min_um=self.z_min_um,
            z_max_um=far_um,
            planes=1 if planes is None else planes,
            x_um=self.x_um,
            y_um=self.y_um,
            average=self.average,
            dark_frames=self.dark_frames,
            target=self.target,
            dct_order=self.dct_order,
            binning=self.binning,
            by_hand=self.by_hand,
            reference_every=self.reference_every,
        )
        if not self.by_hand:
            far = {} if self.z_max_um is None else {"z_max_um": (2, self.z_max_um)}
            _require_reach(bench, {"z_min_um": (2, self.z_min_um), **far, **self._lateral()})
        return PlannedSweep(sweep, reasons)


@dataclass(frozen=True, slots=True, kw_only=True)
class _GridRequest(_Taking):
    """What lateral and volume sweeps share.

    Attributes
    ----------
    half_field_x_um, half_field_y_um : float, optional
        Half the grid's width and height; both or none. None: what a reconstruction shows.
    spacing_um : float, optional
        Of the points; None: by Nyquist of the sensor's angular response.
    response : Path, optional
        File of a measured angular response.
    fall_off_deg : float, optional
        Standard deviation of a Gaussian one; neither: no response is known.
    x_um, y_um : float
        The grid's centre.
    """

    half_field_x_um: float | None = None
    half_field_y_um: float | None = None
    spacing_um: float | None = None
    response: Path | None = None
    fall_off_deg: float | None = None
    reference_every: int = 10

    def __post_init__(self) -> None:
        problems = []
        if self.response is not None and self.fall_off_deg is not None:
            words = "give a file with the angular response or a Gaussian's width in degrees, not both"
            problems.append(("fall_off_deg", words))
        if self.fall_off_deg is not None and not 0 < self.fall_off_deg < 90:
            words = f"the response's width must lie between 0 and 90 degrees, not {self.fall_off_deg:g}"
            problems.append(("fall_off_deg", words))
        if (self.half_field_x_um is None) != (self.half_field_y_um is None):
            missing = "half_field_x_um" if self.half_field_x_um is None else "half_field_y_um"
            problems.append((missing, "give half the field's width and its height, or neither"))
        for name in ("half_field_x_um", "half_field_y_um"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < np.inf:
                problems.append(
                    (name, f"half the field must be a finite number from 0, not {value / 1e3:g} mm")
                )
        if self.spacing_um is not None and not 0 < self.spacing_um < np.inf:
            words = f"the spacing must be a finite number above 0 mm, not {self.spacing_um / 1e3:g}"
            problems.append(("spacing_um", words))
        if problems:
            raise SettingsError(problems)
        self._sweep("volume", ((0.0, 0.0, 1.0),))  # further mistakes show before the bench is asked

    def _sweep(self, kind: str, points_um: tuple[tuple[float, float, float], ...]) -> PointSweep:
        return PointSweep(
            points_um,
            kind=kind,
            average=self.average,
            dark_frames=self.dark_frames,
            target=self.target,
            dct_order=self.dct_order,
            binning=self.binning,
            reference_every=self.reference_every,
        )

    def _grid(self, bench: Bench, depths_um: tuple[float, ...]) -> GridSweep:
        half = None
        if self.half_field_x_um is not None and self.half_field_y_um is not None:
            half = self.half_field_y_um, self.half_field_x_um
        return grid_sweep(
            bench,
            depths_um,
            response=self._fall_off(),
            half_field_um=half,
            spacing_um=self.spacing_um,
            x_um=self.x_um,
            y_um=self.y_um,
        )

    def _fall_off(self) -> FallOff | None:
        if self.response is not None:
            return load_response(self.response).fall_off()
        return None if self.fall_off_deg is None else gaussian_fall_off(self.fall_off_deg)


@dataclass(frozen=True, slots=True, kw_only=True)
class LateralRequest(_GridRequest):
    """PSFs on a grid at the depth ``z_um``."""

    z_um: float

    def plan(self, bench: Bench) -> PlannedSweep:
        """As :meth:`AxialRequest.plan`."""
        if not 0 < self.z_um < np.inf:
            words = f"a depth must be a finite number above 0 mm, not {self.z_um / 1e3:g}"
            raise SettingsError([("z_um", words)])
        _require_reach(bench, {"z_um": (2, self.z_um), **self._lateral()})
        grid = self._grid(bench, (self.z_um,))
        return PlannedSweep(self._sweep("lateral", grid.points_um), _said(grid))


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeRequest(_GridRequest):
    """PSFs on a grid at each of several depths, evenly spaced in 1/z; as :class:`AxialRequest`."""

    z_min_um: float
    z_max_um: float
    planes: int | None = None
    lenslet_um: float | None = None
    wavelength_nm: float | None = None

    def plan(self, bench: Bench) -> PlannedSweep:
        """As :meth:`AxialRequest.plan`."""
        near_um, far_um, planes = self.z_min_um, self.z_max_um, self.planes
        in_order = 0 < near_um < far_um < np.inf
        if not in_order or (planes is not None and planes < 2):
            words = (
                "a volume has two planes or more, 0 < z min < z max; not "
                f"{'any number' if planes is None else planes} between {near_um / 1e3:g} and "
                f"{far_um / 1e3:g} mm"
            )
            raise SettingsError([("z_max_um" if not in_order else "planes", words)])
        _require_reach(bench, {"z_min_um": (2, near_um), "z_max_um": (2, far_um), **self._lateral()})
        reasons: tuple[str, ...] = ()
        if planes is None:
            planes, reasons = _planes(bench, near_um, far_um, self.lenslet_um, self.wavelength_nm)
        depths = Span(start=near_um, stop=far_um, number=planes, spacing="dioptric").values()
        grid = self._grid(bench, depths)
        return PlannedSweep(self._sweep("volume", grid.points_um), (*reasons, *_said(grid)))


SweepRequest = AxialRequest | LateralRequest | VolumeRequest


def _require_reach(bench: Bench, places: Mapping[str, tuple[int, float]]) -> None:
    """Refuse settings that put the source beyond the stage's travel.

    Parameters
    ----------
    bench : Bench
    places : mapping
        Setting's name to axis (0: x, 1: y, 2: z) and place, micrometres from the diffuser's centre.
    """
    if bench.stage is None:
        return  # what needs one says so
    problems = []
    for name, (axis, place_um) in places.items():
        limits = bench.stage.limits.get(f"{'xyz'[axis]}_um")
        if limits is None:
            continue
        low_mm, high_mm = ((end + bench.config.source.offset_um[axis]) / 1e3 for end in limits)
        if not low_mm <= place_um / 1e3 <= high_mm:
            words = (
                f"{'xyz'[axis]} = {place_um / 1e3:g} mm is outside the stage's limits, {low_mm:g} to "
                f"{high_mm:g} mm"
            )
            problems.append((name, words))
    if problems:
        raise SettingsError(problems)


def reachable_depths_um(bench: Bench) -> tuple[float, float]:
    """Return a near and a far depth that the stage reaches, to begin with: the far third of its travel.

    Where the bench has no stage, both are one hundred times the diffuser's distance from the sensor (or 100
    mm), which a photographic camera may call far.
    """
    if bench.stage is None or "z_um" not in bench.stage.limits:
        distance_mm = bench.geometry.diffuser_distance_mm or 1.0
        return 1e5 * distance_mm, 1e5 * distance_mm
    offset_um = bench.config.source.offset_um[2]
    low, high = (end + offset_um for end in bench.stage.limits["z_um"])
    far_um = _rounded_down(high)
    return max(_rounded_down(far_um / 3), math.ceil(max(low, 1.0))), far_um


def _rounded_down(length_um: float) -> float:
    """Return a length with two digits, not longer."""
    unit = 10.0 ** (math.floor(math.log10(length_um)) - 1)
    return unit * math.floor(length_um / unit + 1e-9)


def _planes(
    bench: Bench, z_min_um: float, z_max_um: float, lenslet_um: float | None, wavelength_nm: float | None
) -> tuple[int, tuple[str, ...]]:
    needed = axial_planes(
        z_min_um, z_max_um, bench.geometry, lenslet_um=lenslet_um, wavelength_nm=wavelength_nm
    )
    number = int(needed.value)
    if number > MOST_PLANES:
        words = (
            f"from {z_min_um / 1e3:g} to {z_max_um / 1e3:g} mm these optics need {number} planes, more than "
            f"{MOST_PLANES}: narrow the range, or say how many planes"
        )
        raise SettingsError([("planes", words)])
    return number, (f"{needed.reason}. Another number of planes can be chosen.",)


def _said(grid: GridSweep) -> tuple[str, ...]:
    sizes = dict.fromkeys(f"{rows} x {columns}" for rows, columns in grid.shapes)
    return (*grid.reasons, f"Grid: {' to '.join(sizes)} points (y x x) at each depth")
