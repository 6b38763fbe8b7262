"""Improve one hologram by what the camera sees of it; never for the worse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.hologram_capture import Capture, capture_hologram
from recon.holography import Budget, Display, HologramModel, Target, compute_hologram
from recon.holography.camera_map import CameraMap

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Refinement:
    """The best hologram found.

    Attributes
    ----------
    slm : ndarray, complex64, (1, height, width)
    first, best : Capture
        Of the hologram given and of the best one; the same where nothing was gained.
    psnr_db : tuple of float
        Captured, round by round; the first is the hologram given.
    """

    slm: npt.NDArray[np.complex64]
    first: Capture
    best: Capture
    psnr_db: tuple[float, ...]


def refine_hologram(
    io: DisplayBench,
    slm: Array,
    display: Display,
    target: Target,
    camera: CameraMap,
    *,
    mean_per_ms: float,
    rounds: int = 4,
    iterations: int = 15,
    average: int = 4,
    gain: float = 0.8,
    progress: Callable[[int, float], object] | None = None,
) -> Refinement:
    """Photograph, let the model aim as far beyond as the picture falls short, compute again, photograph.

    The model is wrong, but it knows well which change of the pattern changes the picture how. So it is asked
    for what it showed last plus what the photograph lacked. The best pattern by photograph is kept: the
    result is the given one where nothing helps (its photograph decides, with the camera's noise averaged).

    Parameters
    ----------
    io : DisplayBench
    slm : ndarray, complex, (1, height, width)
        Start, from :func:`recon.holography.compute_hologram`.
    display : Display
        As the hologram was computed for, displacement included.
    target : Target
    camera : CameraMap
    mean_per_ms : float
    rounds, iterations : int
        Photographs after the first, and iterations between them.
    average : int
        Photographs averaged in each round.
    gain : float
        Part of the shortfall that is added.
    progress : callable, optional
        ``progress(round, psnr_db)``.
    """
    best_slm = now = np.asarray(slm, np.complex64)
    first = _capture(io, now, display, target, camera, mean_per_ms, average)
    best, measured, history = first, first, [first.scores.psnr_db]
    plain = HologramModel(display, [target])
    for number in range(1, rounds + 1):
        shown = plain.seen(now) / plain.peaks[0]
        aim = np.maximum(shown + gain * (measured.wanted - measured.seen), 0)
        model = HologramModel(display, [replace(target, image=aim, white=1.0)])
        now = compute_hologram(model, budget=Budget(iterations, tolerance=0), initial=now).slm
        measured = _capture(io, now, display, target, camera, mean_per_ms, average)
        history.append(measured.scores.psnr_db)
        if progress is not None:
            progress(number, measured.scores.psnr_db)
        if measured.scores.psnr_db > best.scores.psnr_db:
            best, best_slm = measured, now
    return Refinement(best_slm, first, best, tuple(history))


def _capture(
    io: DisplayBench,
    slm: Array,
    display: Display,
    target: Target,
    camera: CameraMap,
    mean: float,
    average: int,
) -> Capture:
    return capture_hologram(io, list(slm), display, target, camera, mean_per_ms=mean, average=average)
