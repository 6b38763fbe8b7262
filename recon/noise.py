"""How much noise to expect in a measurement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Photon and read noise of a camera, in counts.

    Attributes
    ----------
    read_noise : float
        Standard deviation in the dark, counts.
    counts_per_electron : float
        Slope of the photon-transfer curve: variance of ``n`` counts of light is ``n * counts_per_electron``.
    """

    read_noise: float
    counts_per_electron: float

    def deviation(self, measurement: npt.NDArray[Any]) -> float:
        """Root mean square of the noise expected in a measurement (background subtracted, counts)."""
        signal = float(np.mean(np.maximum(measurement, 0), dtype=np.float64))
        return float(np.sqrt(self.read_noise**2 + self.counts_per_electron * signal))


def estimate_deviation(measurement: npt.NDArray[Any], valid: npt.NDArray[np.bool_] | None = None) -> float:
    """Estimate the standard deviation of white noise from one image (Immerkær 1996, with a median).

    The stencil ``[1, -2, 1] x [1, -2, 1]`` removes what is locally planar; the median of its magnitude is
    little moved by the sharp lines of a caustic. Biased upwards when the image has structure in most pixels.

    Parameters
    ----------
    measurement : ndarray, (height, width)
    valid : ndarray of bool, optional
        Stencils that touch a pixel which is not valid are left out.

    Returns
    -------
    float
        0 for an image too small or too erased to tell.
    """
    m = np.asarray(measurement, np.float64)
    if min(m.shape) < 3:
        return 0.0
    rows = m[:-2] - 2 * m[1:-1] + m[2:]
    stencil = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    magnitude = np.abs(stencil)
    if valid is not None:
        touched = np.lib.stride_tricks.sliding_window_view(valid, (3, 3)).all(axis=(2, 3))
        magnitude = magnitude[touched]
        if magnitude.size < 16:
            return 0.0
    # The stencil's noise is 6 times the pixel's; a Gaussian's median magnitude is 0.6745 deviations.
    return float(np.median(magnitude)) / (6 * 0.6745)
