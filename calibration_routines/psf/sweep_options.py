"""A sweep of the point source as data: what a person asks for, and what is measured then.

:class:`AxialSweep`, :class:`LateralSweep` and :class:`VolumeSweep` are what is asked; what was left out of
them (planes, field, spacing) the bench fills in (``planned``). What is measured is always a
:class:`PointSweep`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import MISSING, dataclass, fields, replace
from numbers import Real
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from calibration_routines.optics.angular_response import load_response
from calibration_routines.options import MM, Checked
from calibration_routines.psf.sampling import MOST_PLANES, Position, axial_planes, grid_sweep, require_reach
from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.plan import Span
from recon.base.arguments import is_several
from recon.base.declare import RARE, option
from recon.optics.fall_off import FallOff, gaussian_fall_off
from recon.types import plain_number

LEAST_POINTS_WITH_REFERENCE = 4
"""A shorter sweep is over before a source drifts: no reference visits."""


@dataclass(frozen=True, slots=True)
class PlannedSweep:
    """A sweep with what its numbers come from, in words."""

    sweep: PointSweep
    reasons: tuple[str, ...] = ()


class AskedSweep(Protocol):
    """What a person asks of a sweep: declared options, which the bench completes."""

    def planned(self, bench: Bench) -> PlannedSweep:
        """Return the sweep that the bench should do; nothing moves.

        Raises SettingsError, BenchError when it leaves the stage's travel or what would be needed is not
        known of the bench.
        """


def _binning(text: str) -> int:
    if text == "auto":
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise ValueError("write a whole number from 1, or auto.")
    return int(text)


@dataclass(frozen=True, kw_only=True)
class Taking(Checked):
    """How each PSF is taken, whatever the sweep."""

    average: int = option(
        4, least=1, label="Frames a PSF", help="Frames a PSF; all are stored, their mean is the PSF."
    )
    dark_frames: int = option(
        4, least=1, help="Frames without light, at the shortest and at the longest exposure each."
    )
    target: float = option(
        0.7,
        least=0.05,
        most=0.9,
        label="Exposure target",
        help="Level of each PSF's 99.9th percentile, as a fraction of full scale.",
        group=RARE,
    )
    dct_order: int = option(
        0,
        least=0,
        flags=("--dct",),
        label="Remove DCT",
        help="Remove the N x N lowest DCT coefficients (stray light); 0: none.",
        group=RARE,
    )
    binning: int = option(
        1,
        least=0,
        metavar="N|auto",
        parse=_binning,
        help="Software binning, on top of the camera's; auto or 0: as far as the PSF's finest structure "
        "allows.",
        group=RARE,
    )
    retakes: int = option(
        1, least=0, help="How often PSFs that saturate or slipped are taken again.", group=RARE
    )
    reference_every: int = option(
        10,
        least=0,
        help="PSFs between two visits to a reference point, which tell whether the source drifts; 0: none.",
        group=RARE,
    )

    def _taking(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(Taking)}


def _is_position(point: object) -> bool:
    return isinstance(point, tuple | list) and len(point) == 3 and all(isinstance(x, Real) for x in point)


@dataclass(frozen=True, kw_only=True)
class PointSweep(Taking):
    """PSFs at listed places."""

    points_um: tuple[Position, ...]
    """``(x, y, z)`` from the diffuser's centre, micrometres."""
    kind: str = "volume"
    """What its run is called, and its record."""
    by_hand: bool = False
    """Somebody moves the source, without a stage."""

    def __post_init__(self) -> None:
        if is_several(self.points_um) and all(map(is_several, self.points_um)):
            points = tuple(tuple(map(plain_number, point)) for point in self.points_um)
            object.__setattr__(self, "points_um", points)
        super().__post_init__()

    def disagreements(self, wrong: Collection[str]) -> list[tuple[str, str]]:
        """As :meth:`Checked.disagreements`."""
        if not (isinstance(self.points_um, tuple | list) and all(map(_is_position, self.points_um))):
            return [("points_um", "points must be a tuple of positions, ((x, y, z), ...), in um")]
        words = {
            "a sweep needs at least one point": not self.points_um,
            "a point is listed twice": len(set(self.points_um)) != len(self.points_um),
            "every coordinate of a point must be a finite number": not np.isfinite(self.points_um).all(),
            "every point must lie in front of the diffuser, z > 0": any(z <= 0 for *_, z in self.points_um),
        }
        return [("points_um", said) for said, is_wrong in words.items() if is_wrong]

    @property
    def depths_um(self) -> tuple[float, ...]:
        """Depths of the points, nearest first."""
        return tuple(sorted({z for _, _, z in self.points_um}))

    def axis_point(self, z_um: float) -> Position:
        """Return the point of a depth that is nearest to the axis; its PSF is the depth's central one."""
        return min((p for p in self.points_um if p[2] == z_um), key=lambda p: float(np.hypot(p[0], p[1])))

    @property
    def central(self) -> frozenset[Position]:
        """The point of each depth that is nearest to the axis."""
        return frozenset(self.axis_point(z_um) for z_um in self.depths_um)

    @property
    def reference_point(self) -> Position | None:
        """The point that is revisited: on the axis, at the middle depth; None for a short sweep."""
        if self.by_hand or not self.reference_every or len(self.points_um) < LEAST_POINTS_WITH_REFERENCE:
            return None
        return self.axis_point(self.depths_um[len(self.depths_um) // 2])

    def planned(self, bench: Bench) -> PlannedSweep:
        """Return itself: nothing was left to the bench."""
        return PlannedSweep(self)


@dataclass(frozen=True, kw_only=True)
class _Lateral:
    """Where the source, or the grid's centre, stands laterally."""

    x_um: float = option(0.0, **MM, flags=("--x",), help="Source, or the grid's centre, along x.", group=RARE)
    y_um: float = option(0.0, **MM, flags=("--y",), help="Source, or the grid's centre, along y.", group=RARE)

    def _require_reach(self, bench: Bench, **depths_um: float) -> None:
        depths = {name: (2, z_um) for name, z_um in depths_um.items()}
        require_reach(bench, {**depths, "x_um": (0, self.x_um), "y_um": (1, self.y_um)})


@dataclass(frozen=True, kw_only=True)
class _Depths:
    """Planes evenly spaced in 1/z."""

    z_min_um: float = option(
        MISSING,
        **MM,
        flags=("--z-min",),
        above=0,
        label="Nearest plane",
        help="Nearest plane, from the diffuser.",
    )
    z_max_um: float | None = option(
        None,
        **MM,
        flags=("--z-max",),
        above=0,
        label="Farthest plane",
        help="Farthest plane, from the diffuser.",
        default_words="one PSF, at the nearest plane",
    )
    planes: int | None = option(
        None,
        least=1,
        most=10_000,
        help="Number of planes, evenly spaced in 1/z.",
        default_words="as many as the optics need",
    )
    lenslet_um: float | None = option(
        None,
        unit="um",
        above=0,
        flags=("--lenslet",),
        help="Diameter of a microlens diffuser's lenslets, for the number of planes (Kuo 2020, Eq. 5.10).",
        default_words="no lenslets",
        group=RARE,
    )
    wavelength_nm: float | None = option(
        None,
        unit="nm",
        above=0,
        flags=("--wavelength",),
        help="For the lenslets' depth of field.",
        default_words="the bench's",
        group=RARE,
    )

    @property
    def far_um(self) -> float:
        """Depth of the farthest plane."""
        return self.z_min_um if self.z_max_um is None else self.z_max_um

    def _planes(self, bench: Bench) -> tuple[int, tuple[str, ...]]:
        """Return the number of planes, and why where it was left to the optics."""
        if self.planes is not None:
            return self.planes, ()
        if self.far_um == self.z_min_um:
            return 1, ()
        needed = axial_planes(
            self.z_min_um,
            self.far_um,
            bench.geometry,
            lenslet_um=self.lenslet_um,
            wavelength_nm=self.wavelength_nm,
        )
        if needed.value > MOST_PLANES:
            words = (
                f"from {self.z_min_um / 1e3:g} to {self.far_um / 1e3:g} mm these optics need "
                f"{needed.value:.6g} planes, more than {MOST_PLANES}: narrow the range, or say how many"
            )
            raise SettingsError([("planes", words)])
        return int(needed.value), (f"{needed.reason}. Another number of planes can be chosen.",)


@dataclass(frozen=True, kw_only=True)
class AxialSweep(Taking, _Lateral, _Depths):
    """PSFs along the axis.

    A camera behind a diffuser is calibrated by moving a point source along its axis and keeping one PSF a
    depth (Kuo 2020, Sec. 4.3), evenly spaced in 1/z because that is how the size of the pattern changes (Eq.
    4.7). One plane alone is the calibration of a photographic camera (Sec. 3.1).
    """

    by_hand: bool = option(
        False,
        label="Placed by hand",
        help="The source was placed by hand at the nearest plane; nothing moves.",
        group=RARE,
    )
    reference_every: int = option(
        16,
        least=0,
        help="PSFs between two visits to a reference point, which tell whether the source drifts; 0: none.",
        group=RARE,
    )

    def disagreements(self, wrong: Collection[str]) -> list[tuple[str, str]]:
        """As :meth:`Checked.disagreements`."""
        if not {"z_min_um", "z_max_um", "planes"}.isdisjoint(wrong):
            return []
        if self.z_min_um > self.far_um:
            words = (
                f"planes must lie in front of the diffuser, nearest first: 0 < z min <= z max, "
                f"not {self.z_min_um / 1e3:g} and {self.far_um / 1e3:g} mm"
            )
            return [("z_max_um", words)]
        if self.planes is not None and (self.planes == 1) != (self.z_min_um == self.far_um):
            words = (
                f"the number of planes is {self.planes}: one plane needs z min = z max, "
                "more need z min < z max"
            )
            return [("planes", words)]
        if self.by_hand and self.far_um > self.z_min_um:
            words = f"{self.planes or 'several'} planes need a stage; by hand one PSF is taken at a time"
            return [("by_hand", words)]
        return []

    @property
    def z_um(self) -> tuple[float, ...]:
        """Depths of the planes, nearest first, evenly spaced in 1/z (Kuo 2020, Eq. 4.7).

        Raises SettingsError when the number of planes was left to the optics.
        """
        planes = 1 if self.far_um == self.z_min_um else self.planes
        if planes is None:
            words = (
                "the number of planes was left to the optics: give it, or take what planned(bench) returns"
            )
            raise SettingsError([("planes", words)])
        return Span(start=self.z_min_um, stop=self.far_um, number=planes, spacing="dioptric").values()

    def points(self) -> PointSweep:
        """Return what is measured, nearest plane first; errors as :attr:`z_um`."""
        points = tuple((self.x_um, self.y_um, z_um) for z_um in self.z_um)
        return PointSweep(points_um=points, kind="axial", by_hand=self.by_hand, **self._taking())

    def planned(self, bench: Bench) -> PlannedSweep:
        """As :meth:`AskedSweep.planned`."""
        planes, reasons = self._planes(bench)
        if not self.by_hand:
            far = {} if self.z_max_um is None else {"z_max_um": self.z_max_um}
            self._require_reach(bench, z_min_um=self.z_min_um, **far)
        return PlannedSweep(replace(self, z_max_um=self.far_um, planes=planes).points(), reasons)


@dataclass(frozen=True, kw_only=True)
class _Points:
    """Points of a grid at each depth."""

    half_field_x_um: float | None = option(
        None,
        **MM,
        least=0,
        flags=("--half-field-x",),
        label="Half field x",
        help="Half the grid's width; both or none.",
        default_words="what a reconstruction shows",
    )
    half_field_y_um: float | None = option(
        None,
        **MM,
        least=0,
        flags=("--half-field-y",),
        label="Half field y",
        help="Half the grid's height; both or none.",
        default_words="what a reconstruction shows",
    )
    spacing_um: float | None = option(
        None,
        **MM,
        above=0,
        flags=("--spacing",),
        help="Of the grid's points.",
        default_words="by Nyquist of the fall-off",
    )
    response: Path | None = option(
        None,
        metavar="FILE",
        label="Angular response",
        help="Angular response of the sensor: angular_response.json of calibrate angular.",
        default_words="none",
    )
    fall_off_deg: float | None = option(
        None,
        unit="deg",
        above=0,
        below=90,
        flags=("--fall-off-deg",),
        label="or Gaussian fall-off",
        help="Standard deviation of a Gaussian angular response.",
        default_words="none",
    )


@dataclass(frozen=True, kw_only=True)
class _Grid(Taking, _Lateral, _Points):
    """A grid of points at each depth; ``(x_um, y_um)`` is its centre."""

    def disagreements(self, wrong: Collection[str]) -> list[tuple[str, str]]:
        """As :meth:`Checked.disagreements`."""
        problems = []
        if self.response is not None and self.fall_off_deg is not None:
            words = "give a file with the angular response or a Gaussian's width in degrees, not both"
            problems.append(("fall_off_deg", words))
        if (self.half_field_x_um is None) != (self.half_field_y_um is None):
            missing = "half_field_x_um" if self.half_field_x_um is None else "half_field_y_um"
            problems.append((missing, "give half the field's width and its height, or neither"))
        return problems

    def _over(self, bench: Bench, kind: str, depths_um: tuple[float, ...]) -> PlannedSweep:
        """Return the sweep over the grid at each depth."""
        half = None
        if self.half_field_x_um is not None and self.half_field_y_um is not None:
            half = self.half_field_y_um, self.half_field_x_um
        grid = grid_sweep(
            bench,
            depths_um,
            response=self._fall_off(),
            half_field_um=half,
            spacing_um=self.spacing_um,
            x_um=self.x_um,
            y_um=self.y_um,
        )
        sizes = dict.fromkeys(f"{rows} x {columns}" for rows, columns in grid.shapes)
        words = f"Grid: {' to '.join(sizes)} points (y x x) at each depth"
        if any(seen < rows * columns for seen, (rows, columns) in zip(grid.seen, grid.shapes, strict=True)):
            least, most = min(grid.seen), max(grid.seen)
            words += f", of which {least if least == most else f'{least} to {most}'} seen"
        return PlannedSweep(
            PointSweep(points_um=grid.points_um, kind=kind, **self._taking()), (*grid.reasons, words)
        )

    def _fall_off(self) -> FallOff | None:
        if self.response is not None:
            return load_response(self.response).fall_off()
        return None if self.fall_off_deg is None else gaussian_fall_off(self.fall_off_deg)


@dataclass(frozen=True, kw_only=True)
class _Depth:
    """One plane."""

    z_um: float = option(
        MISSING, **MM, flags=("--z",), above=0, label="Depth", help="Depth of the grid, from the diffuser."
    )


@dataclass(frozen=True, kw_only=True)
class LateralSweep(_Grid, _Depth):
    """PSFs on a grid at one depth."""

    def planned(self, bench: Bench) -> PlannedSweep:
        """As :meth:`AskedSweep.planned`."""
        self._require_reach(bench, z_um=self.z_um)
        return self._over(bench, "lateral", (self.z_um,))


@dataclass(frozen=True, kw_only=True)
class VolumeSweep(_Grid, _Depths):
    """PSFs on a grid at each of several depths."""

    z_max_um: float = option(
        MISSING,
        **MM,
        flags=("--z-max",),
        above=0,
        label="Farthest plane",
        help="Farthest plane, from the diffuser.",
    )

    def disagreements(self, wrong: Collection[str]) -> list[tuple[str, str]]:
        """As :meth:`Checked.disagreements`."""
        problems = super().disagreements(wrong)
        in_order = self.z_min_um < self.z_max_um
        if not (wrong or problems) and (not in_order or (self.planes is not None and self.planes < 2)):
            words = (
                "a volume has two planes or more, 0 < z min < z max; not "
                f"{'any number' if self.planes is None else self.planes} between {self.z_min_um / 1e3:g} and "
                f"{self.z_max_um / 1e3:g} mm"
            )
            problems.append(("z_max_um" if not in_order else "planes", words))
        return problems

    def planned(self, bench: Bench) -> PlannedSweep:
        """As :meth:`AskedSweep.planned`."""
        self._require_reach(bench, z_min_um=self.z_min_um, z_max_um=self.z_max_um)
        planes, reasons = self._planes(bench)
        depths = Span(start=self.z_min_um, stop=self.z_max_um, number=planes, spacing="dioptric").values()
        planned = self._over(bench, "volume", depths)
        return replace(planned, reasons=(*reasons, *planned.reasons))
