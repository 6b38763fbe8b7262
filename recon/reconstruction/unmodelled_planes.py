"""Depth planes that were left out before the work: whether what is left of the data shows light there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.camera_model import members_of_depths
from recon.reconstruction.part import Part
from recon.types import Calibration

Array = npt.NDArray[Any]

TV_LEAVES = 2.0
"""How many times noise's reach total variation leaves unexplained: up to 1.4 times where planes were left out
rightly, from 2.6 times where wrongly, on two scenes of beads, each with one PSF and with nine a depth."""


def signs_of_light(
    residual: Array, left_out: Calibration, channel: int, window: tuple[int, int] | None
) -> npt.NDArray[np.float64]:
    """Return the largest correlation of a residual with every left-out plane's unit-energy central PSF.

    Parameters
    ----------
    residual : ndarray, (height, width)
        In units of the noise, so that white noise alone correlates with deviation 1.
    left_out : Calibration
    channel : int
    window : (int, int) or None
        Central part of the PSFs to take.
    """
    from scipy.signal import fftconvolve

    positions, signs = left_out.source_positions_um, []
    for group in members_of_depths(positions):
        off_axis = np.nan_to_num(np.hypot(positions[group, 0], positions[group, 1]))
        psfs = left_out.psfs[group[int(np.argmin(off_axis))]]
        psf = psfs[channel if len(psfs) > 1 else 0].astype(np.float64)
        for axis, m in enumerate(window or psf.shape):
            first = psf.shape[axis] // 2 - m // 2
            psf = np.take(psf, np.arange(first, first + m), axis=axis)
        energy = float(np.linalg.norm(psf))
        correlation = fftconvolve(residual.astype(np.float64), psf[::-1, ::-1] / max(energy, 1e-30))
        signs.append(max(float(correlation.max()), 0.0))
    return np.array(signs)


def limit_of(part: Part) -> float:
    """Return what noise alone reaches, or the prior holds down: no sign of light."""
    noise = float(np.sqrt(2 * np.log(np.prod(part.camera.domain_shape)))) + 1
    return max(noise * (TV_LEAVES if part.problem.prior_name.startswith("tv") else 1.0), part.weight)


def signs_in_words(signs: Sequence[float]) -> list[str]:
    """Return a warning where a plane's sign, relative to its limit, exceeds 1."""
    if not len(signs) or max(signs) <= 1:
        return []
    return [
        "There may be light in the depth planes that were left out: what is left of the data correlates with "
        f"their PSFs {max(signs):.1f} times as much as noise and prior explain. Keep all planes "
        "(--choose planes=all) to see."
    ]
