"""Sums and means of blocks of pixels, and the way back: binning, the one way to do it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray

WHOLE = 0.9
"""Least share of the blocks that are whole, of the share of pixels that are not erased."""


def block_sum(
    image: Array, factor: int, *, about_axis: bool = False, dtype: npt.DTypeLike = np.float32
) -> Array:
    """Sum ``factor`` x ``factor`` pixels of (..., height, width).

    Parameters
    ----------
    image : ndarray, (..., height, width)
        Any real dtype.
    factor : int
    about_axis : bool
        Let the pixel ``n // 2`` on the axis begin the block on the axis, ``count // 2`` (see
        :func:`blocks_about_axis`); a rest is left out on both sides. Else blocks begin at the first pixel,
        and it is left out at the last rows and columns.
    dtype : dtype
        Of sums and result.

    Returns
    -------
    ndarray, (..., height // factor, width // factor)
        About the axis one block less where that many do not fit.

    Raises ValueError when not one block fits.
    """
    if factor == 1:
        return np.asarray(image, dtype)
    places = [blocks_about_axis(n, factor) if about_axis else (0, n // factor) for n in image.shape[-2:]]
    if min(count for _, count in places) < 1:
        raise ValueError(f"An image of {image.shape[-2:]} pixels cannot be binned by {factor}.")
    (top, height), (left, width) = ((first, first + count * factor) for first, count in places)
    # Sums of strided views: several times faster than a mean over axes of length ``factor``.
    rows = image[..., top:height:factor, :].astype(dtype)
    for i in range(1, factor):
        rows += image[..., top + i : height : factor, :]
    total: Array = rows[..., left:width:factor].copy()
    for j in range(1, factor):
        total += rows[..., left + j : width : factor]
    return total


def block_mean(
    image: Array, factor: int, *, about_axis: bool = False, dtype: npt.DTypeLike = np.float32
) -> Array:
    """Average ``factor`` x ``factor`` pixels of (..., height, width); as :func:`block_sum`."""
    if factor == 1:
        return np.asarray(image, dtype)
    total = block_sum(image, factor, about_axis=about_axis, dtype=dtype)
    total *= total.dtype.type(1 / factor**2)
    return total


def whole_blocks(valid: BoolArray, most: int) -> int:
    """Return the side of blocks about the axis, at most ``most``, of which nearly all have no erased pixel.

    One erased pixel erases its block: a few hot pixels or a bright spot cost little, scattered ones nearly
    all. Of ``most`` its halves are tried; 1 where erased pixels are too many for any.

    Parameters
    ----------
    valid : ndarray of bool, (..., height, width)
        False where a pixel is erased.
    most : int
    """
    factor = most
    while factor > 1:
        whole = block_mean(valid, factor, about_axis=True) > 1 - 1e-6
        if whole.mean() >= WHOLE * valid.mean():
            break
        factor //= 2
    return factor


def blocks_about_axis(n: int, factor: int) -> tuple[int, int]:
    """First pixel and number of the blocks of ``n`` pixels: pixel ``n // 2`` begins block ``count // 2``."""
    count = n // factor
    first = n // 2 - (count // 2) * factor
    if first < 0 or first + count * factor > n:
        count -= 1
        first = n // 2 - (count // 2) * factor
    return first, count


def enlarged(image: Array, factor: int, shape: tuple[int, int]) -> Array:
    """Bring a binned object (..., height, width) back to pixels, linearly between them.

    PSF and measurement were binned alike, so that an object's pixel ``k`` blocks from the axis lies ``k *
    factor`` pixels from it. Light is kept: ``factor^2`` pixels share that of one.
    """
    if factor == 1:
        return np.asarray(image, np.float32)
    out = np.asarray(image, np.float32)
    for axis, n in ((-2, shape[0]), (-1, shape[1])):
        m = out.shape[axis]
        at = m // 2 + (np.arange(n) - n // 2) / factor
        low = np.clip(np.floor(at).astype(int), 0, m - 1)
        high = np.minimum(low + 1, m - 1)
        part = np.clip(at - low, 0, 1).astype(np.float32)
        shaped = part[:, None] if axis == -2 else part
        out = np.take(out, low, axis=axis) * (1 - shaped) + np.take(out, high, axis=axis) * shaped
    return np.asarray(out / np.float32(factor**2), np.float32)
