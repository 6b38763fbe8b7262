"""How many places a calibration must measure and where they lie, from the physics (Kuo 2020, Sec. 5.3).

Across the field the registered PSFs change with the sensor's angular response, ``f(atan(x / z))`` at the
pixel beneath the axis (Eq. 5.9). Its bandwidth gives the spacing. Along the axis the edge of the pattern
moves (Eq. 4.7), or lenslets go out of focus (Eq. 5.10).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.stage import OVER
from instrument.bench.bench import Bench
from instrument.files.errors import BenchError, SettingsError
from recon.analysis.resolution import SPECTRUM_LEVEL, axial_spacing_per_um, lateral_spacing_um
from recon.arrays import Float64Array
from recon.optics.fall_off import FallOff
from recon.types import Geometry

Position = tuple[float, float, float]
"""Of the source: ``(x, y, z)`` from the diffuser's centre, micrometres."""
MOST_PLANES = 256
"""More planes than these are a mistake, or must be asked for."""
NO_FALL_OFF_STEP_DEG = 15.0
"""Spacing where the sensor's response is not known: the PSF itself keeps its shape this far (Kuo 2020, Fig.
5.1)."""
FEATURE_PX = 2.0
"""How far the edge of the pattern may move from plane to plane: the PSF's smallest features (Sec. 4.3)."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """A spacing, or a number of planes, with its reason in words."""

    value: float
    reason: str


def lateral_spacing(response: FallOff | None, z_um: float, *, along: str = "x") -> Sampling:
    """Return the largest spacing of calibration points at a depth, micrometres.

    By Nyquist of the response (:func:`~recon.analysis.resolution.lateral_spacing_um`).

    Parameters
    ----------
    response : callable, optional
        The sensor's angular response (:mod:`recon.optics.fall_off`); None: not known, or none.
    along : {"x", "y"}
    """
    if response is None:
        spacing_um = float(np.tan(np.deg2rad(NO_FALL_OFF_STEP_DEG)) * z_um)
        return Sampling(
            spacing_um,
            f"{spacing_um / 1e3:.3g} mm along {along} at z = {z_um / 1e3:.4g} mm: {NO_FALL_OFF_STEP_DEG:g} "
            "degrees, over which a PSF keeps its shape (Kuo 2020, Fig. 5.1); no angular response of the "
            "sensor is known",
        )

    def along_axis(angles: Float64Array) -> Float64Array:
        tangents, zero = np.tan(angles), np.zeros_like(angles)
        return response(zero, tangents) if along == "x" else response(tangents, zero)

    spacing_um = lateral_spacing_um(along_axis, z_um)
    if not np.isfinite(spacing_um):
        raise BenchError("The sensor's angular response is the same at all angles: it asks for no spacing.")
    return Sampling(
        spacing_um,
        f"{spacing_um / 1e3:.3g} mm along {along} at z = {z_um / 1e3:.4g} mm: the sensor's response "
        f"f(atan({along}/z)) has frequencies up to {500 / spacing_um:.3g} per mm above "
        f"{SPECTRUM_LEVEL:.0%} of its mean, and is sampled at twice that (Kuo 2020, Eqs. 5.8 and 5.9)",
    )


def axial_planes(
    z_min_um: float,
    z_max_um: float,
    geometry: Geometry,
    *,
    lenslet_um: float | None = None,
    wavelength_nm: float | None = None,
) -> Sampling:
    """Return how many planes, evenly spaced in 1/z, leave no depth between them unsampled.

    Parameters
    ----------
    lenslet_um : float, optional
        Diameter p of a microlens diffuser's lenslets: then ``1/z1 - 1/z2 <= 4 wavelength / p^2`` (Kuo 2020,
        Eq. 5.10). Else the edge of the pattern moves by two pixels at most (Eq. 4.7).
    wavelength_nm : float, optional
        For Eq. 5.10; the geometry's by default.

    Raises BenchError when what is needed is not known.
    """
    if not 0 < z_min_um < z_max_um:
        raise BenchError(
            f"Planes lie in front of the diffuser, nearest first: 0 < z min < z max, not "
            f"{z_min_um / 1e3:g} and {z_max_um / 1e3:g} mm."
        )
    if lenslet_um is None:
        number = max(2, _planes_by_edge(z_min_um, z_max_um, geometry))
        step = (1 / z_min_um - 1 / z_max_um) / (number - 1)
        return Sampling(
            number,
            f"{number} planes every {1e6 * step:.3g} per metre: the edge of the pattern moves by up to "
            f"{FEATURE_PX:g} pixels from one to the next (Kuo 2020, Eq. 4.7)",
        )
    wavelength_nm = wavelength_nm or geometry.wavelength_nm
    if wavelength_nm is None or lenslet_um <= 0:
        raise BenchError(
            "For lenslets the spacing of the planes follows from their diameter and the wavelength "
            "(4 wavelength / p^2): give both, or wavelength_nm in [geometry] of bench.toml."
        )
    if not (lenslet_um > 1e-3 * wavelength_nm and lenslet_um < 1e6):
        raise BenchError(
            f"A lenslet is wider than the wavelength and less than a metre: {lenslet_um:g} um and "
            f"{wavelength_nm:g} nm make no sense together."
        )
    step = axial_spacing_per_um(lenslet_um, 1e-3 * wavelength_nm)
    number = max(2, 1 + int(np.ceil((1 / z_min_um - 1 / z_max_um) / step - 1e-9)))
    return Sampling(
        number,
        f"{number} planes, at most {1e6 * step:.3g} per metre apart: 4 wavelength / p^2 with lenslets of "
        f"{lenslet_um:g} um and {wavelength_nm:g} nm (Kuo 2020, Eq. 5.10)",
    )


def known(geometry: Geometry, *names: str, what: str, otherwise: str = "") -> list[Any]:
    """Return numbers of the optics by name; BenchError, which begins with ``what``, where one is unknown."""
    values = [getattr(geometry, name) for name in names]
    if None in values:
        listed = " and ".join([", ".join(names[:-1]), names[-1]])
        raise BenchError(f"{what} from {listed}: give them in [geometry] of bench.toml{otherwise}.")
    return values


MOST_POINTS_A_SIDE = 41
"""More points along one axis at one depth are a mistake, or need --spacing."""
_LEAST_SEEN = 0.1  # of a pattern's width
_REACH_MARGIN = 0.98  # of the stage's travel


@dataclass(frozen=True, slots=True)
class GridSweep:
    """The points of a sweep and why they lie where they do."""

    points_um: tuple[Position, ...]
    """Nearest depth first; within a depth row by row, every other row backwards."""
    reasons: tuple[str, ...]
    """What the numbers come from, in words."""
    shapes: tuple[tuple[int, int], ...]
    """Points along y and x at each depth, before those are left out from which too little is seen."""
    seen: tuple[int, ...]
    """How many of them are left at each depth."""


def grid_sweep(
    bench: Bench,
    depths_um: tuple[float, ...],
    *,
    response: FallOff | None = None,
    half_field_um: tuple[float, float] | None = None,
    spacing_um: float | None = None,
    x_um: float = 0.0,
    y_um: float = 0.0,
) -> GridSweep:
    """Plan a grid of points at each depth.

    Parameters
    ----------
    bench : Bench
        Asked for its geometry and for how far its stage reaches.
    depths_um : tuple of float
    response : callable, optional
        The sensor's angular response, for the spacing (:func:`lateral_spacing`).
    half_field_um : (float, float), optional
        Half height and half width of the grid, the same at all depths. Default: the field opposite to the
        sensor, which is that of a reconstruction, as far as the stage reaches.
    spacing_um : float, optional
        Of the points; by default by Nyquist of the response, larger at larger depths.
    x_um, y_um : float
        The grid's centre.

    Raises BenchError when a number makes no sense, the geometry is not known, there is no stage, the grid
    would be too large, or from no place of a depth enough of the pattern is seen.
    """
    _check_numbers(depths_um, half_field_um, spacing_um, (x_um, y_um))
    points: list[Position] = []
    reasons: list[str] = []
    shapes, seen, planned = [], [], 0
    for number, z_um in enumerate(depths_um):
        (half_y, half_x), field = _half_field(bench, z_um, half_field_um, (y_um, x_um))
        axes, words = [], []
        for along, half, centre in (("y", half_y, y_um), ("x", half_x, x_um)):
            if spacing_um is None:
                sampling = lateral_spacing(response, z_um, along=along)
                spacing = sampling.value
                words.append(sampling.reason)
            else:
                spacing = spacing_um
            needed = 2 * np.ceil(half / spacing - 1e-9) + 1  # a float: it may be too large for an integer
            if needed > MOST_POINTS_A_SIDE:
                raise BenchError(
                    f"A field of {2e-3 * half:.3g} mm along {along} at z = {z_um / 1e3:.4g} mm needs "
                    f"{needed:.6g} points every {spacing / 1e3:.3g} mm, more than {MOST_POINTS_A_SIDE}. "
                    "Make the field smaller or the spacing larger."
                )
            points_along = int(needed)
            axes.append(
                centre + np.linspace(-half, half, points_along) if points_along > 1 else np.array([centre])
            )
        shapes.append((len(axes[0]), len(axes[1])))
        if number in (0, len(depths_um) - 1):
            reasons += [f"Field: {field}", *(f"Spacing: {w}" for w in words)]
        here: list[Position] = []
        for row, y in enumerate(axes[0]):
            across = axes[1] if row % 2 == 0 else axes[1][::-1]
            here += [(round(float(x), 3), round(float(y), 3), z_um) for x in across]
        planned += len(here)
        here = [point for point in here if _is_seen(bench, point)]
        points += here
        seen.append(len(here))
    if spacing_um is not None:
        reasons.append(f"Spacing: {spacing_um / 1e3:.3g} mm at most, as asked")
    if dark := [z_um for z_um, count in zip(depths_um, seen, strict=True) if not count]:
        raise _nothing_seen(bench, dark, len(depths_um))
    if left_out := planned - len(points):
        reasons.append(f"{left_out} of {planned} places left out: from there the pattern leaves the sensor")
    return GridSweep(tuple(points), tuple(dict.fromkeys(reasons)), tuple(shapes), tuple(seen))


def _is_seen(bench: Bench, point: Position) -> bool:
    """Whether at least a tenth of a pattern's width lies in the frame; True where that is not known."""
    geometry, (x_um, y_um, z_um) = bench.geometry, point
    d_mm, pitch_um, aperture_mm = (
        geometry.diffuser_distance_mm,
        geometry.pixel_pitch_um,
        geometry.aperture_mm,
    )
    if d_mm is None or pitch_um is None or aperture_mm is None:
        return True
    per_z = 1e3 * d_mm / z_um
    opposite = _opposite_um(bench, z_um)
    return all(
        abs(place - best) * per_z <= n * pitch_um / 2 + (0.5 - _LEAST_SEEN) * 1e3 * side * (1 + per_z)
        for place, best, n, side in zip(
            (y_um, x_um), opposite, bench.camera.frame_shape[:2], aperture_mm, strict=True
        )
    )


def _opposite_um(bench: Bench, z_um: float) -> tuple[float, float]:
    """Return ``(y, x)`` of the source at a depth whose pattern lies in the middle of the camera's region.

    The pattern moves by ``-(x, y) d / z`` (Kuo 2020, Eq. 3.1). Needs the distance and the pitch.
    """
    camera, (d_mm, pitch_um) = (
        bench.camera,
        known(bench.geometry, "diffuser_distance_mm", "pixel_pitch_um", what="Where the field lies follows"),
    )
    (height, width), roi = camera.sensor_shape, camera.roi
    per_pixel = pitch_um / camera.binning * z_um / (1e3 * d_mm)
    beside = (roi.top + roi.height / 2 - height / 2, roi.left + roi.width / 2 - width / 2)
    return 0.0 - beside[0] * per_pixel, 0.0 - beside[1] * per_pixel  # not -0.0


def _nothing_seen(bench: Bench, dark_um: list[float], depths: int) -> BenchError:
    """Return the refusal of depths without a place from which enough is seen."""
    near, far = min(dark_um), max(dark_um)
    where = f"{near / 1e3:.4g}" if near == far else f"{near / 1e3:.4g} to {far / 1e3:.4g}"
    y_um, x_um = _opposite_um(bench, near)
    remedy = f"Bring the field nearer to x = {x_um / 1e3:.3g}, y = {y_um / 1e3:.3g} mm"
    return BenchError(
        f"At z = {where} mm the pattern leaves the sensor from all places of the field. {remedy}"
        + (f" (at z = {near / 1e3:.4g} mm)" if near != far else "")
        + (", or leave such depths out." if len(dark_um) < depths else ".")
    )


def _check_numbers(
    depths_um: tuple[float, ...],
    half_field_um: tuple[float, float] | None,
    spacing_um: float | None,
    centre_um: tuple[float, float],
) -> None:
    problems = [
        f"a depth must be a finite number above 0 mm, not {z_um / 1e3:g}"
        for z_um in depths_um
        if not 0 < z_um < np.inf
    ]
    if spacing_um is not None and not 0 < spacing_um < np.inf:
        problems.append(f"the spacing must be a finite number above 0 mm, not {spacing_um / 1e3:g}")
    if not np.isfinite((*centre_um, *(half_field_um or ()))).all():
        problems.append("the field and its centre must be finite numbers")
    if problems:
        raise BenchError("; ".join(problems) + ".")


def _half_field(
    bench: Bench, z_um: float, asked_um: tuple[float, float] | None, centre_um: tuple[float, float]
) -> tuple[tuple[float, float], str]:
    """Return half height and width of the grid at a depth, and why."""
    if asked_um is not None:
        if min(asked_um) < 0:
            raise BenchError("Half the field's height and width must not be negative.")
        words = f"+-{asked_um[1] / 1e3:.3g} x +-{asked_um[0] / 1e3:.3g} mm (x, y), as asked"
        return asked_um, words
    d_mm, pitch_um = known(
        bench.geometry,
        "diffuser_distance_mm",
        "pixel_pitch_um",
        what="How large the field is follows",
        otherwise=", or give the field",
    )
    seen = tuple(n * pitch_um / 2 / (1e3 * d_mm / z_um) for n in bench.camera.frame_shape[:2])
    reach = _reach(bench, centre_um)
    half = (min(seen[0], reach[0]), min(seen[1], reach[1]))
    limited = " as far as the stage reaches," if half != seen else ""
    words = (
        f"+-{half[1] / 1e3:.3g} x +-{half[0] / 1e3:.3g} mm (x, y) at z = {z_um / 1e3:.4g} mm: the field "
        f"opposite to the sensor,{limited} +-{np.rad2deg(np.arctan2(half[1], z_um)):.3g} x "
        f"+-{np.rad2deg(np.arctan2(half[0], z_um)):.3g} degrees"
    )
    return half, words


def _reach(bench: Bench, centre_um: tuple[float, float]) -> tuple[float, float]:
    """How far the source can go from the centre to both sides along y and x."""
    if bench.stage is None:
        raise BenchError(f"{bench.config.label} has no [stage]: a grid of points needs one.")
    limits, reach = source_limits(bench), []
    for axis, centre in zip(("y_um", "x_um"), centre_um, strict=True):
        low, high = limits.get(axis, (centre, centre))
        reach.append(max(0.0, _REACH_MARGIN * min(high - centre, centre - low)))
    return reach[0], reach[1]


def _planes_by_edge(z_min_um: float, z_max_um: float, geometry: Geometry) -> int:
    """Return how many planes leave no depth between them unsampled; BenchError where optics are not known.

    From plane to plane the edge of the aperture's shadow moves on the sensor by ``w / 2 * d * (1/z1 - 1/z2)``
    (from the scaling ``1 + d/z``), which may be one feature of the PSF at most: the constant of Kuo 2020,
    Eq. 4.7. The PSF's smallest features are about two pixels (Sec. 4.3).
    """
    aperture_mm, d_mm, pitch_um = known(
        geometry,
        "aperture_mm",
        "diffuser_distance_mm",
        "pixel_pitch_um",
        what="How many planes are needed follows",
        otherwise=", or give the number of planes",
    )
    travel_px = 1e6 * max(aperture_mm) / 2 * d_mm * (1 / z_min_um - 1 / z_max_um) / pitch_um
    return 1 + int(np.ceil(travel_px / FEATURE_PX - 1e-9))


def source_limits(bench: Bench) -> dict[str, tuple[float, float]]:
    """Return how far the stage takes the source along each of its axes, micrometres; empty: no stage.

    What an axis' play needs to come to a place from below is taken off.
    """
    if bench.stage is None:
        return {}
    offsets = dict(zip(("x_um", "y_um", "z_um"), bench.config.source.offset_um, strict=True))
    limits = {name: ends for name, ends in bench.stage.limits.items() if name in offsets}
    need = {name: OVER * bench.play.get(name, 0.0) for name in offsets}
    return {
        name: (low + need[name] + offsets[name], high + offsets[name]) for name, (low, high) in limits.items()
    }


def require_reach(bench: Bench, places: Mapping[str, tuple[int, float]]) -> None:
    """Refuse settings that put the source beyond the stage's travel.

    ``places`` maps a setting's name to axis (0: x, 1: y, 2: z) and micrometres from the diffuser's centre.
    """
    limits, problems = source_limits(bench), []  # no stage, no limits: what needs one says so
    for name, (axis, place_um) in places.items():
        if f"{'xyz'[axis]}_um" not in limits:
            continue
        low_mm, high_mm = (end / 1e3 for end in limits[f"{'xyz'[axis]}_um"])
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
    limits = source_limits(bench)
    if "z_um" not in limits:
        distance_mm = bench.geometry.diffuser_distance_mm or 1.0
        return 1e5 * distance_mm, 1e5 * distance_mm
    low, high = limits["z_um"]
    far_um = _rounded_down(high)
    return max(_rounded_down(far_um / 3), math.ceil(max(low, 1.0))), far_um


def standing_depth_um(bench: Bench) -> float | None:
    """Return the depth at which the point source stands, by the stage's word, in whole micrometres.

    None where no stage moves it along z, or what an unhomed one says is out of its reach.
    """
    limits = source_limits(bench)
    if "z_um" not in limits:
        return None
    low, high = limits["z_um"]
    z_um = float(round(bench.source_position_um[2]))
    return z_um if max(low, 1.0) <= z_um <= high else None


def _rounded_down(length_um: float) -> float:
    """Return a length with two digits, not longer."""
    unit = 10.0 ** (math.floor(math.log10(length_um)) - 1)
    return unit * math.floor(length_um / unit + 1e-9)
