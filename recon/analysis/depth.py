"""How PSFs change along the axis (Kuo 2020, Fig. A.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.analysis.correlation import Correlation, autocorrelate, correlate, similarity

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

CUT_PX = 40
"""Pixels on either side of the peak that are kept of a correlation's cut."""


@dataclass(frozen=True)
class DepthSimilarity:
    """PSFs of different depths compared.

    Attributes
    ----------
    z_um : ndarray, (n_z,)
        Ascending.
    middle_um : float
        Depth of the PSF that the others are compared with.
    to_middle : ndarray, (n_z,)
        Inner product with the middle PSF, both on the axis (Fig. A.3b).
    near_cut, far_cut, cross_cut : ndarray, (2 CUT_PX + 1,)
        Cuts along the columns through the peaks of both autocorrelations and of the cross-correlation of the
        nearest and the farthest PSF (Fig. A.3a).
    """

    z_um: Floats
    middle_um: float
    to_middle: Floats
    near_cut: Floats
    far_cut: Floats
    cross_cut: Floats


def across_depth(depths_um: Floats, planes: Array) -> DepthSimilarity:
    """Compare the central PSFs (n_z, height, width) of ascending depths."""
    middle = int(np.argmin(np.abs(1 / depths_um - np.mean(1 / depths_um[[0, -1]]))))
    return DepthSimilarity(
        depths_um,
        float(depths_um[middle]),
        np.array([similarity(plane, planes[middle]) for plane in planes]),
        _cut(autocorrelate(planes[0])),
        _cut(autocorrelate(planes[-1])),
        _cut(correlate(planes[0], planes[-1])),
    )


def _cut(correlation: Correlation) -> Floats:
    cut = correlation.profile(1)
    peak = int(np.argmax(cut))
    index = np.arange(peak - CUT_PX, peak + CUT_PX + 1)
    inside = (index >= 0) & (index < len(cut))
    return np.where(inside, cut[np.clip(index, 0, len(cut) - 1)], 0.0)
