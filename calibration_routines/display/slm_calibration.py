"""Measure an SLM on the holographic bench: look-up table by interference, flatness by spots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.spot_camera import SpotCamera
from instrument.files.errors import BenchError
from instrument.files.slm_image import SlmCorrection
from recon.holography import Display
from recon.holography.pose import Pose
from recon.holography.slm_response import MODES, flatness_jacobian, mode, phases_from_frames

Array = npt.NDArray[Any]
Progress = Callable[[str, int], object]


@dataclass(frozen=True, slots=True)
class SlmCalibration:
    """What was measured.

    Attributes
    ----------
    correction : SlmCorrection
    levels : ndarray, int, (n,)
        Grey levels measured.
    phases_rad : ndarray, float64, (n,)
        Their phases.
    flatness_rms_rad : float or None
        Of the flatness error found; None when it was not measured.
    frames : int
    """

    correction: SlmCorrection
    levels: npt.NDArray[np.int64]
    phases_rad: npt.NDArray[np.float64]
    flatness_rms_rad: float | None
    frames: int


def measure_look_up_table(
    io: DisplayBench, *, n_levels: int = 33, seed: int = 0, progress: Progress | None = None
) -> SlmCalibration:
    """Let half of the SLM's pixels interfere with the other half at one level after the other.

    Needs no alignment and no model: see :func:`recon.holography.slm_response.phases_from_frames`.

    Raises
    ------
    InputError
        When the pictures do not change as interference does.
    """
    levels = np.unique(np.linspace(0, 255, n_levels).round().astype(int))
    height, width = io.slm.shape
    chosen = np.random.default_rng(seed).random((height // io.binning, width // io.binning)) < 0.5
    varied = np.repeat(np.repeat(chosen, io.binning, axis=0), io.binning, axis=1)
    exposure_ms = _exposure_ms(io)
    frames = []
    for level in levels:
        io.show_levels(np.where(varied, level, 0).astype(np.uint8))
        picture = io.photograph(exposure_ms)
        # Every fourth pixel has more than enough light.
        frames.append(picture[::2, ::2])
        if progress is not None:
            progress(f"level {level}", len(frames))
    phases = phases_from_frames(np.array(frames))
    from scipy.interpolate import PchipInterpolator

    table = np.asarray(PchipInterpolator(levels, phases)(np.arange(256)), np.float64)
    return SlmCalibration(SlmCorrection(table), levels, phases, None, io.frames)


def measure_flatness(
    io: DisplayBench,
    display: Display,
    pose: Pose,
    table: SlmCalibration,
    *,
    rest: Array | None = None,
    pictures: int = 10,
    progress: Progress | None = None,
) -> SlmCalibration:
    """Find the SLM's smooth phase error by spots that take off more and less of it, a pair a mode.

    Parameters
    ----------
    io : DisplayBench
    display : Display
    pose : Pose
        Of the mask, from an alignment; the stage must be where that left it.
    table : SlmCalibration
        With the look-up table, which is used from here on.
    rest : ndarray, (rows, columns, 2), optional
        Smooth displacement beyond the pose's, from the alignment.
    pictures : int
        In the last of four steps.

    Raises
    ------
    BenchError
        When the spots are too weak: the mask is not aligned.
    """
    io.correction = table.correction
    eye = SpotCamera(io, display)
    eye.maker.rest = rest
    eye.register()
    step = 0.8
    jacobian = flatness_jacobian(step)
    modes = [mode(n, display.slm_shape) for n in range(len(MODES))]
    found = np.zeros(len(MODES))
    for count in (3, 3, 3, pictures):
        total = np.zeros(2 * len(MODES) + 1)
        for _ in range(count):
            trials = [found + s * step * np.eye(len(MODES))[n] for n in range(len(MODES)) for s in (1, -1)]
            phases = [np.tensordot(c, modes, 1) for c in (*trials, found)]
            brightness, _ = eye.measure_with_phases(pose, phases)
            total += np.sqrt(np.maximum(brightness, 0))
            if progress is not None:
                progress("flatness", io.frames)
        if total[-1] ** 2 / count**2 < 0.03 * eye.ideal(len(total)):
            raise BenchError("Flatness cannot be measured: the spots are too weak. Align the mask first.")
        plus, minus = total[0:-1:2], total[1:-1:2]
        change = np.linalg.solve(jacobian, (plus - minus) / np.maximum(plus + minus, 1e-12))
        found = found + np.clip(change, -1.0, 1.0)
    coarse = (36, 64)
    flatness = np.tensordot(found, [mode(n, coarse) for n in range(len(MODES))], 1)
    correction = SlmCorrection(table.correction.phase_of_level_rad, flatness)
    io.correction = correction
    return SlmCalibration(
        correction, table.levels, table.phases_rad, float(np.sqrt((found**2).sum())), io.frames
    )


def _exposure_ms(io: DisplayBench) -> float:
    """Return an exposure at which the mean is a twelfth of full scale."""
    camera = io.bench.camera
    io.show_levels(np.zeros(io.slm.shape, np.uint8))
    first = io.photograph(camera.exposure_ms)
    full = (1 << camera.significant_bits) - 1
    lit = float(np.mean(first[first > np.median(first) / 4]))
    if lit <= 0:
        raise BenchError(f"{camera.name}: it is dark. Check that the laser shines and the exposure.")
    return full / (12 * lit)
