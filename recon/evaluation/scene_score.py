"""How well a picture or volume shows a test scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base import metrics
from recon.errors import InputError

VOLUME_BLUR_PX = 1.0
"""Volumes are compared through a blur of this deviation in every direction: a bead at a voxel's border is not
wrong by being in its neighbour."""


@dataclass(frozen=True, slots=True)
class Score:
    """Errors against the truth, after the one factor that fits the result to it best."""

    psnr_db: float
    ssim: float
    nrmse: float


def score(found: npt.NDArray[Any], truth: npt.NDArray[Any], *, volume: bool | None = None) -> Score:
    """Judge a reconstruction.

    Parameters
    ----------
    found, truth : ndarray
        Pictures (height, width[, n_channels]), or volumes (n_z, height, width[, n_channels]) of one shape.
    volume : bool, optional
        Whether the first axis is depth; default: 3 axes of which the last is longer than 4, or 4 axes.

    Raises
    ------
    InputError
        When the shapes differ.
    """
    if found.shape != truth.shape:
        raise InputError(f"The reconstruction is {found.shape} and the truth {truth.shape}.")
    if volume is None:
        volume = truth.ndim == 4 or (truth.ndim == 3 and truth.shape[2] > 4)
    a, b = np.asarray(found, np.float64), np.asarray(truth, np.float64)
    if not volume:
        return Score(
            metrics.psnr(a, b, fit_scale=True),
            metrics.ssim(a, b, fit_scale=True),
            metrics.nrmse(a, b, fit_scale=True),
        )
    from scipy.ndimage import gaussian_filter

    sigma = (VOLUME_BLUR_PX,) * 3 + (0.0,) * (b.ndim - 3)
    a, b = (gaussian_filter(v, sigma, mode="constant") for v in (a, b))
    # Planes side by side make one picture: one scale and one peak for all of the volume.
    wide_a, wide_b = (v.reshape(-1, *v.shape[2:]) for v in (a, b))
    return Score(
        metrics.psnr(wide_a, wide_b, fit_scale=True),
        metrics.ssim(wide_a, wide_b, fit_scale=True),
        metrics.nrmse(wide_a, wide_b, fit_scale=True),
    )
