"""A measured angular response: its curves, its cut-offs, and how it is kept and used again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.record import RecordFormat, plain, value_of
from recon.optics.fall_off import FallOff

CUT_OFF = 0.2
"""Response at the cut-off angle, relative to the axis (Kuo 2020, Sec. 4.4)."""
_RESPONSE = RecordFormat(
    "diffuserbench angular response", "angular response", make="diffuserbench calibrate angular writes one."
)
_LEAST = 1e-4  # below it a response's logarithm would be noise

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Curve:
    """Response along one axis.

    Attributes
    ----------
    angles_deg : tuple of float
        Ascending, of both signs: where the light comes from.
    response : tuple of float
        Relative to the axis.
    seen : tuple of float
        Part of the pattern that the sensor still showed.
    """

    angles_deg: tuple[float, ...]
    response: tuple[float, ...]
    seen: tuple[float, ...]

    def cut_offs_deg(self, level: float = CUT_OFF) -> tuple[float | None, float | None]:
        """Return where the response falls to ``level`` on the negative and the positive side; None: nowhere.

        Between the measured angles the logarithm goes with the square of the angle.
        """
        angles, values = np.array(self.angles_deg), np.array(self.response)
        sides: list[float | None] = []
        for sign in (-1.0, 1.0):
            side = np.flatnonzero(sign * angles >= 0)
            order = side[np.argsort(np.abs(angles[side]))]
            a, v = np.abs(angles[order]), values[order]
            below = np.flatnonzero(v < level)
            if not below.size or below[0] == 0:
                sides.append(None)
                continue
            k = int(below[0])
            logs = np.log(np.maximum(v[k - 1 : k + 1], _LEAST))
            part = (logs[0] - np.log(level)) / (logs[0] - logs[1])
            sides.append(float(np.sqrt(a[k - 1] ** 2 + part * (a[k] ** 2 - a[k - 1] ** 2))))
        return sides[0], sides[1]

    @property
    def cut_off_deg(self) -> float | None:
        """Mean of both sides' 20 % cut-offs; None when neither was reached."""
        reached = [angle for angle in self.cut_offs_deg() if angle is not None]
        return float(np.mean(reached)) if reached else None

    def folded(self) -> tuple[Floats, Floats]:
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
    """Response of the sensor to light from the side.

    Attributes
    ----------
    along_x, along_y : Curve
    findings : tuple of str
        What is to be doubted; empty when all went well.
    bench : str
    simulated : bool
    """

    along_x: Curve
    along_y: Curve
    findings: tuple[str, ...] = ()
    bench: str = ""
    simulated: bool = False

    def fall_off(self) -> FallOff:
        """Return the response as a function of the tangents along y and x.

        Its logarithm is linear in the square of the angle between and beyond the measured angles, and between
        the axes goes with the squares of the direction's cosines: exact for a Gaussian of two widths.
        """
        log_x, log_y = (_logarithm(*curve.folded()) for curve in (self.along_x, self.along_y))

        def response(tan_y: Floats, tan_x: Floats) -> Floats:
            squared = tan_y**2 + tan_x**2
            angle = np.arctan(np.sqrt(squared))
            part = np.divide(tan_x**2, squared, out=np.zeros_like(squared), where=squared > 0)
            return np.asarray(np.exp(part * log_x(angle) + (1 - part) * log_y(angle)))

        return response


def _logarithm(angles: Floats, values: Floats) -> Callable[[Floats], Floats]:
    """Return the response's logarithm as a function of the angle."""
    squares, logs = angles**2, np.log(np.maximum(values, _LEAST))

    def logarithm(angle: Floats) -> Floats:
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

    Raises
    ------
    FileError
        When the file cannot be read or is something else.
    """
    data = _RESPONSE.read(Path(file))
    with _RESPONSE.damaged(Path(file)):
        return value_of(AngularResponse, data)  # the cut-offs beside its curves follow from them
