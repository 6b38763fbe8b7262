"""Raw frames of a colour mosaic sensor, without demosaicing.

A Bayer raw frame is a colour measurement of which every pixel kept one channel: the rest is erased
(Kuo 2020, Eq. 3.10). Reconstructing it as such uses what was measured and invents nothing.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from recon.errors import InputError

Pattern = Literal["RGGB", "GRBG", "GBRG", "BGGR"]
PATTERNS: tuple[Pattern, ...] = ("RGGB", "GRBG", "GBRG", "BGGR")


def split_bayer(raw: npt.NDArray[Any], pattern: Pattern) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    """Return a Bayer raw frame as a colour measurement and its erasures, both for :func:`recon.reconstruct`.

    Parameters
    ----------
    raw : ndarray, (height, width)
        Background subtracted.
    pattern : str
        Colours of the first four pixels in reading order: ``"RGGB"`` is GenICam's ``BayerRG``.

    Returns
    -------
    image : ndarray, (height, width, 3), as ``raw``
        Red, green, blue; zero where a colour was not measured.
    erasures : ndarray of bool, (height, width, 3)
        True where a colour was not measured.
    """
    erasures = ~_sites(raw, pattern)
    return np.where(erasures, raw.dtype.type(0), raw[..., None]), erasures


def interpolate_bayer(raw: npt.NDArray[Any], pattern: Pattern) -> npt.NDArray[np.float32]:
    """Return a colour image (height, width, 3) with missing colours as the mean of their nearest neighbours.

    For PSF images, which the model needs at every pixel. It blurs details finer than two pixels.
    """
    from scipy.ndimage import convolve

    sites = _sites(raw, pattern)
    kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], np.float32)
    channels = []
    for c in range(3):
        known = sites[..., c].astype(np.float32)
        total = convolve(np.where(sites[..., c], raw, 0).astype(np.float32), kernel, mode="constant")
        weight = convolve(known, kernel, mode="constant")
        channels.append(np.where(sites[..., c], raw, total / np.maximum(weight, 1e-6)))
    return np.stack(channels, axis=-1).astype(np.float32)


def _sites(raw: npt.NDArray[Any], pattern: Pattern) -> npt.NDArray[np.bool_]:
    """Return where each colour was measured, (height, width, 3)."""
    if pattern not in PATTERNS:
        raise InputError(f"The Bayer pattern {pattern!r} is not known. Choose one of {', '.join(PATTERNS)}.")
    if raw.ndim != 2 or min(raw.shape) < 2:
        raise InputError(f"A Bayer frame must be (height, width), at least 2 x 2; it is {raw.shape}.")
    sites = np.zeros((*raw.shape, 3), bool)
    for k, colour in enumerate(pattern):
        sites[k // 2 :: 2, k % 2 :: 2, "RGB".index(colour)] = True
    return sites
