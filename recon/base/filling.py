"""Erased pixels filled from those around them, for what works on whole images alone."""

from __future__ import annotations

import numpy as np

from recon.arrays import Array
from recon.base import fft

LEAST_SHARE = 1e-3
"""Share of valid pixels from which a local mean is worth taking."""


def fill_smoothly(image: Array, weight: Array) -> None:
    """Replace, in place, pixels of weight 0 by local means of the others, from the nearest that there are.

    Gaussian means, each twice as wide as the one before, until one is as wide as the image; what is farther
    from all others is given their mean, and 0 where no pixel is valid.

    Parameters
    ----------
    image : ndarray, (height, width)
        Real; what it holds where it is erased is not looked at.
    weight : ndarray, (height, width)
        1 where the pixel is valid, 0 where it is erased; of the image's dtype.
    """
    found = weight > 0
    image[~found] = 0
    if not found.any():
        return
    known, valid = fft.dct(image, np.empty_like(image)), fft.dct(weight, np.empty_like(weight))
    frequency = [np.pi * np.arange(n) / n for n in image.shape]
    total, share = np.empty_like(image), np.empty_like(image)
    reach = 1.0
    while not found.all() and reach < max(image.shape):
        blur = np.outer(*(np.exp(-0.5 * (reach * f) ** 2) for f in frequency)).astype(image.dtype)
        fft.idct(known * blur, total)
        fft.idct(valid * blur, share)
        near = ~found & (share > LEAST_SHARE)
        image[near] = total[near] / share[near]
        found |= near
        reach *= 2
    image[~found] = known[0, 0] / valid[0, 0]
