"""An SLM's look-up table by interference: half of its pixels with the other half, at every level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.slm_phases import MAX_PHASE_ERROR_RAD, steady_phases
from calibration_routines.purpose import CalibrationError
from calibration_routines.scatter import STEADY, Scatter
from instrument.files.errors import BenchError
from instrument.files.slm_image import SlmCorrection
from recon.arrays import Array, Float64Array

REFERENCE_EVERY = 8
"""Levels between two pictures of level 0."""


@dataclass(frozen=True, slots=True)
class SlmCalibration:
    """What was measured."""

    correction: SlmCorrection
    levels: npt.NDArray[np.int64]
    """(n,): grey levels measured."""
    phases_rad: Float64Array
    """(n,): their phases."""
    flatness_rms_rad: float | None
    """Of the flatness error found; None when it was not measured."""
    frames: int
    phase_error_rad: float = 0.0
    """Standard deviation of a phase of the table, by how far the pictures lie off interference."""
    steadiness: Scatter = STEADY
    """Of the picture of level 0, taken again and again in between."""


def measure_look_up_table(
    io: DisplayBench,
    *,
    n_levels: int = 33,
    on_more: Callable[[int, float], object] | None = None,
) -> SlmCalibration:
    """Let half of the SLM's pixels interfere with the other half at one level after the other.

    Needs no alignment and no model: see :func:`recon.holography.slm_response.phases_from_frames`. Level 0 is
    shown again after every few levels: a slow change of brightness is taken out where the pictures then lie
    better on one ellipse. Where they flicker too much for a table, and not more than the mean over a few
    series makes up for, more series are taken; ``on_more`` gets how many in all, and the error so far.

    Raises InputError when the pictures do not change as interference does; CalibrationError when they lie so
    far off it that the table would be wrong, with what flickers or shakes.
    """
    levels = np.unique(np.linspace(0, 255, n_levels).round().astype(int))
    height, width = io.slm.shape
    chosen = np.random.default_rng(0).random((height // io.binning, width // io.binning)) < 0.5
    varied = np.repeat(np.repeat(chosen, io.binning, axis=0), io.binning, axis=1)
    exposure_ms = _exposure_ms(io)
    order: list[int] = []
    reference: list[bool] = []
    before = []
    for number, level in enumerate([*levels, 0]):
        if number % REFERENCE_EVERY == 0 or number == len(levels):
            order.append(0)
            reference.append(True)
            before.append(number - 0.5)
        if number < len(levels):
            order.append(int(level))
            reference.append(False)
    images = [np.where(varied, level, 0).astype(np.uint8) for level in order]
    phases, error, scatter = steady_phases(
        lambda: _taken(io, images, reference, exposure_ms), np.array(before), on_more
    )
    if error > MAX_PHASE_ERROR_RAD:
        words = scatter.causes() or (
            "light, mask or camera are not steady, or the SLM flickers: look for saturation, loose mounts.",
        )
        raise CalibrationError(
            f"The SLM's table would be wrong by {error:.4f} rad (one standard deviation; at most "
            f"{MAX_PHASE_ERROR_RAD:g} is kept): {' '.join(words)} More grey levels (--levels) lessen it, too."
        )
    from scipy.interpolate import PchipInterpolator

    table = np.asarray(PchipInterpolator(levels, phases)(np.arange(256)), np.float64)
    return SlmCalibration(SlmCorrection(table), levels, phases, None, io.frames, error, scatter)


def _taken(
    io: DisplayBench, images: Sequence[npt.NDArray[np.uint8]], reference: Sequence[bool], exposure_ms: float
) -> tuple[Array, Array]:
    """Take a series; returns the levels' pictures, and those of level 0 in between."""
    pictures, references = [], []
    for picture, again in zip(io.photographs(images, exposure_ms), reference, strict=True):
        if again:  # whole: a picture of every other pixel does not tell how far it moved
            references.append(picture)
        else:  # every fourth pixel has more than enough light
            pictures.append(picture[::2, ::2])
    return np.array(pictures), np.array(references, np.float32)


def _exposure_ms(io: DisplayBench) -> float:
    """Return an exposure at which the mean is a twelfth of full scale."""
    camera = io.bench.camera
    io.show_levels(np.zeros(io.slm.shape, np.uint8))
    first = io.photograph(camera.exposure_ms)
    bright = first[first > np.median(first) / 4]
    lit = float(bright.mean()) if bright.size else 0.0
    if lit <= 0:
        raise BenchError(f"{camera.name}: it is dark. Check that the laser shines and the exposure.")
    return io.exposure_ms(lit)
