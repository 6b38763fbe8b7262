"""An SLM's smooth phase error by spots, once the mask is aligned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.slm_table import SlmCalibration
from calibration_routines.display.spot_camera import SpotCamera
from instrument.files.errors import BenchError
from instrument.files.slm_image import SlmCorrection
from recon.arrays import Array
from recon.holography import Display
from recon.holography.pose import Pose
from recon.holography.slm_response import MODES, flatness_jacobian, mode

FRAMES = 22
"""That it takes at most."""


def measure_flatness(
    io: DisplayBench,
    display: Display,
    pose: Pose,
    table: SlmCalibration,
    *,
    rest: Array | None = None,
    pictures: int = 10,
) -> SlmCalibration:
    """Find the SLM's smooth phase error by spots that take off more and less of it, a pair a mode.

    Parameters
    ----------
    pose : Pose
        Of the mask, from an alignment; the stage must be where that left it.
    table : SlmCalibration
        With the look-up table, which is used from here on.
    rest : ndarray, (rows, columns, 2), optional
        Smooth displacement beyond the pose's, from the alignment.
    pictures : int
        In the last of four steps.

    Raises BenchError when the spots are too weak: the mask is not aligned.
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
        if total[-1] ** 2 / count**2 < 0.03 * eye.ideal(len(total)):
            raise BenchError("Flatness cannot be measured: the spots are too weak. Align the mask first.")
        plus, minus = total[0:-1:2], total[1:-1:2]
        change = np.linalg.solve(jacobian, (plus - minus) / np.maximum(plus + minus, 1e-12))
        found = found + np.clip(change, -1.0, 1.0)
    coarse = (36, 64)
    flatness = np.tensordot(found, [mode(n, coarse) for n in range(len(MODES))], 1)
    correction = SlmCorrection(table.correction.phase_of_level_rad, flatness)
    io.correction = correction
    rms_rad = float(np.sqrt((found**2).sum()))
    return replace(table, correction=correction, flatness_rms_rad=rms_rad, frames=io.frames)
