"""Stray light in a PSF image: remove what varies slowly over the sensor (Kuo 2020, Sec. 6.4)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.fft import dctn, idctn


def remove_low_frequencies(
    image: npt.NDArray[np.floating], order: int = 10
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Set the ``order x order`` lowest DCT coefficients to zero, then negative values to zero.

    The dissertation's microscope does so with ``order=10`` against autofluorescence and unfiltered excitation
    light. It also removes the slowly varying part of the PSF itself: right for a few sharp spots on a large
    sensor, wrong for a caustic that fills a good part of it (docs/decisions/0004-psf-background.md).

    Parameters
    ----------
    image : ndarray, (..., height, width)
        Dark frame already subtracted; any number of leading axes.
    order : int
        Coefficients along each axis; 0 removes nothing but negative values.

    Returns
    -------
    cleaned : ndarray, float32, shape of ``image``, non-negative
    background : ndarray, float32, shape of ``image``
        What the removed coefficients stand for; may be negative where the PSF's own low frequencies were cut.

    Raises
    ------
    ValueError
        When ``order`` is negative or larger than the image.
    """
    height, width = image.shape[-2:]
    if not 0 <= order <= min(height, width):
        raise ValueError(f"order must lie between 0 and {min(height, width)} for this image, not {order}.")
    values = np.asarray(image, np.float32)
    if order == 0:
        return np.maximum(values, 0.0), np.zeros_like(values)
    coefficients = dctn(values, axes=(-2, -1), norm="ortho", workers=-1)
    low = np.zeros_like(coefficients)
    low[..., :order, :order] = coefficients[..., :order, :order]
    background = idctn(low, axes=(-2, -1), norm="ortho", workers=-1)
    return np.maximum(values - background, 0.0), background


def block_mean(image: npt.NDArray[np.floating], factor: int) -> npt.NDArray[np.float32]:
    """Average ``factor x factor`` blocks over the last two axes; left-over rows and columns are cut.

    Parameters
    ----------
    image : ndarray, (..., height, width)
    factor : int

    Returns
    -------
    ndarray, float32, (..., height // factor, width // factor)
    """
    if factor == 1:
        return np.asarray(image, np.float32)
    height, width = (n // factor for n in image.shape[-2:])
    if height == 0 or width == 0:
        raise ValueError(f"An image of {image.shape[-2:]} pixels cannot be binned by {factor}.")
    cropped = np.asarray(image[..., : height * factor, : width * factor], np.float32)
    blocks = cropped.reshape(*image.shape[:-2], height, factor, width, factor)
    averaged: npt.NDArray[np.float32] = blocks.mean(axis=(-3, -1), dtype=np.float32)
    return averaged
