"""A measured angular response: from images to its curves, its cut-offs, how it is kept, shown, used again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy import ndimage

from calibration_routines.psf.sampling import Position
from calibration_routines.purpose import CalibrationError
from calibration_routines.scatter import STEADY, Scatter
from instrument.files.record import RecordFormat, plain, value_of
from recon.arrays import Float32Array, Float64Array
from recon.camera.registration import Registration, aligned, expected_shift, register
from recon.optics.fall_off import FallOff

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CUT_OFF = 0.2
"""Response at the cut-off angle, relative to the axis (Kuo 2020, Sec. 4.4)."""
_RESPONSE = RecordFormat(
    "diffuserbench angular response", "angular response", make="diffuserbench calibrate angular writes one."
)
Emission = Literal["pinhole", "bead"]
EMISSIONS: tuple[Emission, ...] = ("pinhole", "bead")
_POWER: dict[Emission, float] = {"pinhole": 4.0, "bead": 3.0}
"""Cosines in the light through the aperture: three of its solid angle, one of a flat source that faces it."""
LEAST_SEEN = 0.08
"""Part of the pattern's light that must still fall onto the sensor for an angle to be measured."""
_SMOOTH_PX, _SUPPORT = 6.0, 0.05  # the pattern is where its smoothed light is above this part of its maximum
_NEAR_PX = 40.0  # about where the stage says, the pattern is looked for
_COLOURS = ("#00798c", "#d1495b")
_LEAST = 1e-4  # below it a response's logarithm would be noise


@dataclass(frozen=True, slots=True)
class Curve:
    """Response along one axis."""

    angles_deg: tuple[float, ...]
    """Ascending, of both signs: where the light comes from."""
    response: tuple[float, ...]
    """Relative to the axis."""
    seen: tuple[float, ...]
    """Part of the pattern that the sensor still showed."""

    def cut_offs_deg(self) -> tuple[float | None, float | None]:
        """Return where the response falls to a fifth on the negative and the positive side; None: nowhere.

        Between the measured angles the logarithm goes with the square of the angle.
        """
        angles, values = np.array(self.angles_deg), np.array(self.response)
        sides: list[float | None] = []
        for sign in (-1.0, 1.0):
            side = np.flatnonzero(sign * angles >= 0)
            order = side[np.argsort(np.abs(angles[side]))]
            a, v = np.abs(angles[order]), values[order]
            below = np.flatnonzero(v < CUT_OFF)
            if not below.size or below[0] == 0:
                sides.append(None)
                continue
            k = int(below[0])
            logs = np.log(np.maximum(v[k - 1 : k + 1], _LEAST))
            part = (logs[0] - np.log(CUT_OFF)) / (logs[0] - logs[1])
            sides.append(float(np.sqrt(a[k - 1] ** 2 + part * (a[k] ** 2 - a[k - 1] ** 2))))
        return sides[0], sides[1]

    @property
    def cut_off_deg(self) -> float | None:
        """Mean of both sides' 20 % cut-offs; None when neither was reached."""
        reached = [angle for angle in self.cut_offs_deg() if angle is not None]
        return float(np.mean(reached)) if reached else None

    def folded(self) -> tuple[Float64Array, Float64Array]:
        """Return angles from 0 upwards, radians, and the mean response of both sides there."""
        magnitude = np.abs(np.array(self.angles_deg))
        values = np.array(self.response)
        grid = np.unique(np.round(magnitude, 6))
        ends = [magnitude[np.sign(self.angles_deg) == sign].max(initial=0.0) for sign in (-1, 1)]
        grid = grid[grid <= max(ends) + 1e-9]
        sides = []
        for sign in (-1, 1):
            mask = (np.sign(self.angles_deg) == sign) | (magnitude == 0)
            order = np.argsort(magnitude[mask])
            side = np.interp(grid, magnitude[mask][order], values[mask][order])
            side[grid > magnitude[mask].max() + 1e-9] = np.nan
            sides.append(side)
        return np.deg2rad(grid), np.nanmean(sides, axis=0)


@dataclass(frozen=True, slots=True)
class AngularResponse:
    """Response of the sensor to light from the side."""

    along_x: Curve
    along_y: Curve
    findings: tuple[str, ...] = ()
    """What is to be doubted; empty when all went well."""
    bench: str = ""
    simulated: bool = False
    scatter: Scatter = STEADY
    """Of the frames that were averaged, all places together."""

    def fall_off(self) -> FallOff:
        """Return the response as a function of the tangents along y and x.

        Its logarithm is linear in the square of the angle between and beyond the measured angles, and between
        the axes goes with the squares of the direction's cosines: exact for a Gaussian of two widths.
        """
        log_x, log_y = (_logarithm(*curve.folded()) for curve in (self.along_x, self.along_y))

        def response(tan_y: Float64Array, tan_x: Float64Array) -> Float64Array:
            squared = tan_y**2 + tan_x**2
            angle = np.arctan(np.sqrt(squared))
            part = np.divide(tan_x**2, squared, out=np.zeros_like(squared), where=squared > 0)
            return np.asarray(np.exp(part * log_x(angle) + (1 - part) * log_y(angle)))

        return response


def _logarithm(angles: Float64Array, values: Float64Array) -> Callable[[Float64Array], Float64Array]:
    """Return the response's logarithm as a function of the angle."""
    squares, logs = angles**2, np.log(np.maximum(values, _LEAST))

    def logarithm(angle: Float64Array) -> Float64Array:
        inside = np.interp(angle**2, squares, logs)
        return np.where(angle <= angles[-1], inside, logs[-1] * angle**2 / squares[-1])

    return logarithm


def save_response(response: AngularResponse, file: Path) -> Path:
    """Write the response as JSON; returns the file."""
    data: dict[str, Any] = plain(response)
    for name, curve in (("along_x", response.along_x), ("along_y", response.along_y)):
        data[name]["cut_offs_deg"] = curve.cut_offs_deg()
    _RESPONSE.write(file, data)
    return file


def load_response(file: Path | str) -> AngularResponse:
    """Read what :func:`save_response` wrote.

    Raises FileError when the file cannot be read or is something else.
    """
    data = _RESPONSE.read(Path(file))
    with _RESPONSE.damaged(Path(file)):
        return value_of(AngularResponse, data)  # the cut-offs beside its curves follow from them


# Measuring -------------------------------------------------------------------------------------------
def analyse_angular(
    images: Sequence[Float32Array],
    points_um: Sequence[Position],
    *,
    pitch_um: float,
    distance_um: float,
    emission: Emission = "pinhole",
    findings: Sequence[str] = (),
    bench: str = "",
    simulated: bool = False,
) -> AngularResponse:
    """Compute the response from images of the source at places along x and y.

    Parameters
    ----------
    images : sequence of ndarray, float32, (height, width)
        Light at one common exposure, dark frame subtracted; the first with the source on the axis.
    points_um : sequence of (x, y, z)
    pitch_um, distance_um : float
        Of the pixels; from diffuser to sensor.
    emission : {"pinhole", "bead"}
    findings, bench, simulated
        Kept with the result.

    Raises CalibrationError when fewer than three angles along x or y could be measured.
    """
    axis_image = np.asarray(images[0], np.float64)
    axis_bare = axis_image / _geometric(points_um[0], axis_image.shape, pitch_um, distance_um, emission)
    measured: dict[str, list[tuple[float, float, float]]] = {"x": [], "y": []}
    for image, point in zip(images[1:], points_um[1:], strict=True):
        found = _compare(image, images[0], axis_bare, point, points_um[0], pitch_um, distance_um, emission)
        if found is not None:
            measured["x" if point[0] != points_um[0][0] else "y"].append(found)
    curves = {}
    for along, rows in measured.items():
        if len(rows) < 3:
            raise CalibrationError(
                f"Only {len(rows)} angles along {along} could be measured: the pattern leaves the sensor. "
                "Use smaller steps."
            )
        rows = sorted([*rows, (0.0, 1.0, 1.0)])
        angles, values, seen = (tuple(column) for column in zip(*rows, strict=True))
        curves[along] = Curve(angles, values, seen)
    return AngularResponse(curves["x"], curves["y"], tuple(findings), bench, simulated)


def _compare(
    image: Float32Array,
    axis_image: Float32Array,
    axis_bare: Float64Array,
    point: Position,
    origin: Position,
    pitch_um: float,
    distance_um: float,
    emission: Emission,
) -> tuple[float, float, float] | None:
    """Return ``(angle, response, seen)`` of one place, or None when too little of its pattern is seen."""
    here, there = (expected_shift(p, distance_um, pitch_um) for p in (point, origin))
    near = here[0] - there[0], here[1] - there[1]
    if _part_seen(axis_bare, near) < LEAST_SEEN:
        return None  # nothing but noise may be left, in which a pattern would be found by chance
    found = register(image, axis_image, near=near, within_px=_NEAR_PX)
    if not found.reliable:  # too little is seen to tell; the stage knows well enough for a sum over pixels
        found = replace(found, rows=near[0], columns=near[1])
    expected = _displaced(axis_bare, (found.rows, found.columns))
    seen = float(expected.sum(dtype=np.float64) / axis_bare.sum())
    if seen < LEAST_SEEN:
        return None
    weight = expected * _geometric(point, image.shape, pitch_um, distance_um, emission)
    smooth = ndimage.gaussian_filter(expected, _SMOOTH_PX)
    support = smooth > _SUPPORT * float(ndimage.gaussian_filter(axis_bare, _SMOOTH_PX).max())
    angle = _tangent(point, image.shape, pitch_um, distance_um)
    mean = float((weight[support] * angle[support]).sum() / weight[support].sum())
    ratio = float(image[support].sum(dtype=np.float64) / weight[support].sum(dtype=np.float64))
    return float(np.rad2deg(np.arctan(mean))), ratio, seen


def _geometric(
    point: Position, shape: tuple[int, ...], pitch_um: float, distance_um: float, emission: Emission
) -> Float64Array:
    """Light from the source on each pixel without any response: a power of the ray's cosine."""
    tangents = _tangents(point, shape, pitch_um, distance_um)
    return np.asarray((1 + tangents[0] ** 2 + tangents[1] ** 2) ** (-0.5 * _POWER[emission]))


def _tangent(point: Position, shape: tuple[int, ...], pitch_um: float, distance_um: float) -> Float64Array:
    """Signed tangent of the incidence along the axis on which the source was moved, (height, width)."""
    y, x = _tangents(point, shape, pitch_um, distance_um)
    return -np.broadcast_to(x if abs(point[0]) >= abs(point[1]) else y, shape)


def _tangents(
    point: Position, shape: tuple[int, ...], pitch_um: float, distance_um: float
) -> tuple[Float64Array, Float64Array]:
    """Tangents of the straight ray from the source to each pixel, along y (h, 1) and x (1, w)."""
    x, y, z = point
    rows, columns = (np.asarray((np.arange(n) - (n - 1) / 2) * pitch_um, np.float64) for n in shape)
    tan_y, tan_x = (rows[:, None] - y) / (z + distance_um), (columns[None, :] - x) / (z + distance_um)
    return np.asarray(tan_y, np.float64), np.asarray(tan_x, np.float64)


def _displaced(image: Float64Array, shift: tuple[float, float]) -> Float32Array:
    """Move an image by ``(rows, columns)``; aligned() takes a displacement back, so it gets the opposite."""
    return aligned(image.astype(np.float32), Registration(-shift[0], -shift[1], 1.0, 1.0, 1.0))


def _part_seen(image: Float64Array, shift: tuple[float, float]) -> float:
    """Return the part of an image's light that is left when it is displaced."""
    return float(_displaced(image, shift).sum(dtype=np.float64) / image.sum())


# Showing ---------------------------------------------------------------------------------------------
def response_lines(response: AngularResponse) -> list[str]:
    """Return the cut-offs and the quality of a response in sentences."""
    lines = []
    for name, curve in (("x", response.along_x), ("y", response.along_y)):
        words = []
        for sign, angle in zip("-+", curve.cut_offs_deg(), strict=True):
            end = curve.angles_deg[0 if sign == "-" else -1]
            value = curve.response[0 if sign == "-" else -1]
            words.append(
                f"{sign}{angle:.1f} degrees"
                if angle is not None
                else f"not reached on the {sign} side ({value:.0%} at {end:+.1f} degrees)"
            )
        lines.append(f"Cut-off along {name} ({CUT_OFF:.0%} of the axis): {' and '.join(words)}")
    return lines + [f"Quality: {finding}" for finding in response.findings]


def response_figure(response: AngularResponse) -> Figure:
    """Draw the response along x and y with the cut-off angles."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    for name, curve, colour in zip("xy", (response.along_x, response.along_y), _COLOURS, strict=True):
        cut_off = curve.cut_off_deg
        label = f"along {name}" + ("" if cut_off is None else f": {CUT_OFF:.0%} at {cut_off:.1f} degrees")
        axes.plot(curve.angles_deg, curve.response, ".-", color=colour, label=label)
        for side, sign in zip(curve.cut_offs_deg(), (-1, 1), strict=True):
            if side is not None:
                axes.plot([sign * side], [CUT_OFF], "o", mfc="none", color=colour)
    axes.axhline(CUT_OFF, color="#8496a5", lw=0.8)
    axes.set(xlabel="angle of incidence, degrees", ylabel="response relative to the axis", ylim=(0, None))
    axes.set_xlim(*(1.05 * np.array([-1, 1]) * max(map(abs, response.along_x.angles_deg))))
    axes.legend(frameon=False)
    axes.set_title(f"Angular response of the sensor, {response.bench}", fontsize=10)
    return figure
