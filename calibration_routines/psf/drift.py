"""Does the source drift while a sweep runs? The reference point, revisited, tells brightness and place.

A change of brightness is corrected: every PSF is divided by the brightness of its moment, a straight line
between the visits before and after it. A change of place is only reported, as it may be the source's, the
camera's or the stage's (docs/decisions/0019-sweep-watch-and-drift.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.psf.background import block_mean
from recon.camera.registration import register

Floats = npt.NDArray[np.float32]

MAX_BRIGHTNESS_DRIFT = 0.1
"""Change of the source's light between two visits beyond which a straight line is not to be relied on."""
_CORRECTABLE = (0.2, 5.0)  # brightness over the first visit's: beyond, it is another light, not a drift
MAX_PLACE_DRIFT_PX = 0.5
"""Shift of the reference's pattern that is called a drift, pixels."""
LARGEST_PX = 500_000
"""Larger images are binned before patterns are registered: a twentieth of a pixel is told still."""


@dataclass(frozen=True, slots=True)
class Drift:
    """The reference point's visits, each against the first.

    Attributes
    ----------
    before_point : tuple of int
        Points of the sweep that had been taken before each visit.
    brightness : tuple of float
        Light received, relative to the first visit.
    shift_px : tuple of float
        Distance of the pattern from its place at the first visit, pixels of the PSFs.
    findings : tuple of str
        Empty when the source stayed what it was.
    """

    before_point: tuple[int, ...]
    brightness: tuple[float, ...]
    shift_px: tuple[float, ...]
    findings: tuple[str, ...]
    seconds: tuple[float, ...]
    """When each visit was, from the first."""

    @property
    def is_correctable(self) -> bool:
        """Whether brightness was measured at every visit, one after the other, and is that of one source."""
        least, most = _CORRECTABLE
        in_order = bool((np.diff(self.seconds) > 0).all())  # a clock that was set meanwhile tells nothing
        return in_order and all(least <= brightness <= most for brightness in self.brightness)

    def brightness_at(self, seconds: float) -> float:
        """Return the source's brightness, relative to the first visit, so long after that.

        After the last visit it stays what it was then; 1 where the drift is not correctable.
        """
        return float(np.interp(seconds, self.seconds, self.brightness)) if self.is_correctable else 1.0

    def as_json(self) -> dict[str, Any]:
        """Return the figures as JSON-compatible values."""
        return {name: list(values) for name, values in asdict(self).items()} | {
            "corrected": self.is_correctable
        }


def judge_drift(
    visits: Sequence[Floats], before_point: Sequence[int], last_point: int, seconds: Sequence[float]
) -> Drift:
    """Compare each visit to the reference with the first.

    Parameters
    ----------
    visits : sequence of ndarray, float32, (height, width)
        Averaged, dark frame subtracted, in the order of time; the first is the reference.
    before_point : sequence of int
        How many of the sweep's points had been taken before each.
    last_point : int
        How many points the sweep has.
    seconds : sequence of float
        When each visit was, from the first.
    """
    first = visits[0]
    brightness, shifts = [1.0], [0.0]
    for visit in visits[1:]:
        light, shift_px = compare_visit(visit, first)
        brightness.append(light)
        shifts.append(shift_px)
    findings: list[str] = []
    for k in range(1, len(visits)):
        points = (before_point[k - 1], min(before_point[k], last_point))
        findings += judge_visit(tuple(brightness[k - 1 : k + 1]), tuple(shifts[k - 1 : k + 1]), points)
    return Drift(tuple(before_point), tuple(brightness), tuple(shifts), tuple(findings), tuple(seconds))


def compare_visit(visit: Floats, first: Floats) -> tuple[float, float]:
    """Return brightness and shift (pixels of these images) of a visit against the first.

    The shift is infinite where the pattern is not found again; both are nan where there is no light.
    """
    factor = max(1, int(np.ceil(np.sqrt(first.size / LARGEST_PX))))
    light = float(first.sum(dtype=np.float64))
    brightness = float(visit.sum(dtype=np.float64)) / light if light > 0 else float("nan")
    if not light > 0 or not np.ptp(visit) > 0:
        return brightness, float("nan")
    found = register(block_mean(visit, factor), block_mean(first, factor))
    shift_px = factor * float(np.hypot(found.rows, found.columns))
    return brightness, shift_px if found.reliable else float("inf")


def judge_visit(
    brightness: tuple[float, ...], shift_px: tuple[float, ...], points: tuple[int, int]
) -> tuple[str, ...]:
    """Return what changed between two visits, in words.

    Parameters
    ----------
    brightness, shift_px : (float, float)
        At the earlier and at the later visit, relative to the first of all.
    points : (int, int)
        Points of the sweep that had been taken before each.
    """
    findings = []
    where = f"between points {points[0] + 1} and {points[1]}"
    change = brightness[1] / brightness[0] - 1 if brightness[0] else float("nan")
    if not abs(change) <= MAX_BRIGHTNESS_DRIFT:
        findings.append(
            f"{where} the source became {abs(change):.1%} {'brighter' if change > 0 else 'dimmer'} "
            f"(up to {MAX_BRIGHTNESS_DRIFT:.0%} can be corrected for): let it warm up, keep other light out, "
            "and take the sweep again where PSFs must compare in brightness."
        )
    if not abs(shift_px[1] - shift_px[0]) <= MAX_PLACE_DRIFT_PX:
        findings.append(
            f"{where} the reference's pattern moved from {shift_px[0]:.1f} to {shift_px[1]:.1f} pixels "
            f"off its first place (up to {MAX_PLACE_DRIFT_PX:g} expected): the source, the stage or the "
            "camera moved. Fix it and take the sweep again."
        )
    return tuple(findings)
