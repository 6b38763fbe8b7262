"""What is wrong with a simulated bench on purpose: light that flickers or drifts, a table that shakes.

Every frame has its own draw, by the world's seed and the frame's number; what changes with time goes by
the world's clock, also where nothing is waited for. Play, lost steps and wrong scales are options of the
stage's axes, a wrong mount of the stage, a large pinhole of the source.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from pydantic import Field

from drivers.device import DriverOptions
from recon.arrays import Float32Array
from recon.optics.sensor import FixedPattern

_LEAST_LIGHT = 0.02
"""Of its usual brightness: a lamp does not flicker to less."""
_DRAWS, _PLACES = 101, 103
"""Tell the random numbers of a frame's faults and of the late hot pixels from the others of a seed."""


class FaultOptions(DriverOptions):
    """Faults that every simulated world may have; none by default."""

    flicker: float = Field(
        0.0, ge=0, lt=1, description="Standard deviation of the light's brightness from frame to frame."
    )
    drift_per_min: float = Field(
        0.0, gt=-1, lt=10, description="How the light's brightness changes in a simulated minute, relative."
    )
    vibration_px: float = Field(
        0.0,
        ge=0,
        description="Standard deviation of the picture's place on the sensor from frame to frame, along each "
        "axis, unbinned pixels.",
    )
    creep_px_per_min: float = Field(
        0.0,
        description="How far the picture goes over the sensor in a simulated minute, along each axis, "
        "unbinned pixels.",
    )
    ambient_e_per_s: float = Field(
        0.0, ge=0, description="Other light that comes and goes: electrons a second in a pixel at its most."
    )
    ambient_period_s: float = Field(
        60.0, gt=0, description="Simulated seconds from one dark moment of it to the next; it begins dark."
    )
    late_hot_pixels: int = Field(0, ge=0, description="Pixels that turn hot while the bench is used.")
    late_hot_e_per_s: float = Field(1e5, gt=0, description="Their dark current.")
    late_hot_after_s: float = Field(2.0, ge=0, description="Simulated seconds until then.")


def disturbed(
    light: Float32Array, faults: FaultOptions, frame: tuple[int, int], at_s: float, binning: int
) -> Float32Array:
    """Return what falls on the pixels in a frame, given what would fall on them without faults.

    Parameters
    ----------
    light : ndarray, float32, (height, width)
        Electrons a second.
    frame : (int, int)
        The world's seed and the frame's number: the same frame is disturbed alike.
    at_s : float
        Simulated seconds since the world began.
    binning : int
        Of the pixels.
    """
    rng = np.random.default_rng((_DRAWS, *frame))
    level = (1 + faults.flicker * rng.standard_normal()) * (1 + faults.drift_per_min * at_s / 60)
    shaken = rng.normal(0.0, faults.vibration_px, 2) if faults.vibration_px else np.zeros(2)
    rows, columns = (shaken + faults.creep_px_per_min * at_s / 60) / binning
    seen = light * np.float32(max(level, _LEAST_LIGHT))
    if rows or columns:
        place = np.array([[1, 0, columns], [0, 1, rows]])
        size = seen.shape[1], seen.shape[0]
        beyond = cv2.BORDER_REFLECT_101  # a picture goes on beyond the sensor: no dark rim comes in
        there = cv2.warpAffine(seen, place, size, flags=cv2.INTER_LANCZOS4, borderMode=beyond)
        seen = np.maximum(there, 0).astype(np.float32)
    phase = 2 * np.pi * at_s / faults.ambient_period_s
    return seen + np.float32(faults.ambient_e_per_s * binning**2 * (1 - np.cos(phase)) / 2)


def disturbs(faults: FaultOptions) -> bool:
    """Whether frames are another thing than the light that would fall on the pixels."""
    return bool(
        faults.flicker
        or faults.drift_per_min
        or faults.vibration_px
        or faults.creep_px_per_min
        or faults.ambient_e_per_s
    )


def with_late_hot(pattern: FixedPattern, faults: FaultOptions, seed: int) -> FixedPattern:
    """Return a sensor's pixels once some more of them have turned hot."""
    dark = pattern.dark_e_per_s.copy()
    places = np.random.default_rng((_PLACES, seed)).choice(dark.size, faults.late_hot_pixels, replace=False)
    dark.flat[places] += np.float32(faults.late_hot_e_per_s)
    return replace(pattern, dark_e_per_s=dark)
