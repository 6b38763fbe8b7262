"""Does the source drift while a sweep runs? The reference point, revisited, tells brightness and place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.background import block_mean
from recon.registration import register

MAX_BRIGHTNESS_DRIFT = 0.03
"""Relative change of the source's light that is called a drift."""
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

    def as_json(self) -> dict[str, Any]:
        """Return the figures as JSON-compatible values."""
        return {name: list(values) for name, values in asdict(self).items()}


def judge_drift(
    visits: Sequence[npt.NDArray[np.float32]], before_point: Sequence[int], last_point: int
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
    """
    first = visits[0]
    factor = max(1, int(np.ceil(np.sqrt(first.size / LARGEST_PX))))
    pattern = block_mean(first, factor)
    light = float(first.sum(dtype=np.float64))
    brightness, shifts = [1.0], [0.0]
    for visit in visits[1:]:
        brightness.append(float(visit.sum(dtype=np.float64)) / light if light > 0 else float("nan"))
        if not light > 0 or not np.ptp(visit) > 0:
            shifts.append(float("nan"))
            continue
        found = register(block_mean(visit, factor), pattern)
        shift = factor * float(np.hypot(found.rows, found.columns))
        shifts.append(shift if found.reliable else float("inf"))
    findings = []
    for k in range(1, len(visits)):
        where = f"between points {before_point[k - 1] + 1} and {min(before_point[k], last_point)}"
        change = brightness[k] / brightness[k - 1] - 1
        if not abs(change) <= MAX_BRIGHTNESS_DRIFT:
            findings.append(
                f"{where} the source became {abs(change):.1%} {'brighter' if change > 0 else 'dimmer'} "
                f"(up to {MAX_BRIGHTNESS_DRIFT:.0%} expected): let it warm up, keep other light out, and "
                "take the sweep again where PSFs must compare in brightness."
            )
        if not abs(shifts[k] - shifts[k - 1]) <= MAX_PLACE_DRIFT_PX:
            findings.append(
                f"{where} the reference's pattern moved from {shifts[k - 1]:.1f} to {shifts[k]:.1f} pixels "
                f"off its first place (up to {MAX_PLACE_DRIFT_PX:g} expected): the source, the stage or the "
                "camera moved. Fix it and take the sweep again."
            )
    return Drift(tuple(before_point), tuple(brightness), tuple(shifts), tuple(findings))
