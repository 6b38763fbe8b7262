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


Stencil = tuple[tuple[int, int, float], ...]

_LINE = (1.0, -2.0, 1.0)
_PLANE: Stencil = tuple((i, j, _LINE[i] * _LINE[j]) for i in range(3) for j in range(3))
_ROW: Stencil = tuple((0, j, _LINE[j]) for j in range(3))
_PAIR: Stencil = ((0, 0, 1.0), (0, 1, -1.0))
ENOUGH = 256
"""Samples from which a median is trusted."""


def estimate_deviation(measurement: npt.NDArray[Any], valid: npt.NDArray[np.bool_] | None = None) -> float:
    """Estimate the standard deviation of white noise from one image (Immerkær 1996, with a median).

    The stencil ``[1, -2, 1] x [1, -2, 1]`` removes what is locally planar; the median of its magnitude is
    little moved by the sharp lines of a caustic. Where erased pixels leave too few whole stencils, sparser
    ones (every second pixel as in a Bayer mosaic, three in a row, pairs) take its place. Biased upwards when
    the image has structure in most pixels.

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
    v = np.ones(m.shape, bool) if valid is None else valid
    best = np.empty(0)
    for stencil in (_PLANE, _ROW, _PAIR):
        for stride in (1, 2):
            samples = _apply(stencil, stride, m, v)
            best = samples if samples.size > best.size else best
            if best.size >= min(ENOUGH, m.size // 4):
                break
        else:
            continue
        break
    if not best.size:
        return 0.0
    # A Gaussian's median magnitude is 0.6745 deviations.
    median = float(np.median(np.abs(best))) / 0.6745
    if median == 0 and np.array_equal(m[v], np.round(m[v])):
        return float(np.sqrt(np.mean(best**2)))  # single photons: most stencils are empty
    return median


def _apply(
    stencil: Stencil, stride: int, m: npt.NDArray[np.float64], valid: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float64]:
    """Return a stencil's values wherever all its pixels are valid, scaled to unit gain for white noise."""
    height = m.shape[0] - stride * max(i for i, _, _ in stencil)
    width = m.shape[1] - stride * max(j for _, j, _ in stencil)
    if height < 1 or width < 1:
        return np.empty(0)
    total, whole = np.zeros((height, width)), np.ones((height, width), bool)
    for i, j, coefficient in stencil:
        part = (slice(i * stride, i * stride + height), slice(j * stride, j * stride + width))
        total += coefficient * m[part]
        whole &= valid[part]
    gain = np.sqrt(sum(c * c for _, _, c in stencil))
    result: npt.NDArray[np.float64] = total[whole] / gain
    return result
