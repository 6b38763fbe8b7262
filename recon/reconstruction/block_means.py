"""Means of blocks of pixels about the axis, and the way back."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]


def binned(image: Array, factor: int) -> Floats:
    """Average ``factor`` x ``factor`` pixels of (..., height, width); a rest at the end is left out.

    Blocks lie so that the pixel ``n // 2`` on the axis begins the block ``(n // factor) // 2`` on the axis.
    """
    if factor == 1:
        return np.asarray(image, np.float32)
    for axis in (-2, -1):
        first, count = blocks(image.shape[axis], factor)
        image = np.take(image, np.arange(first, first + count * factor), axis=axis)
    height, width = image.shape[-2] // factor, image.shape[-1] // factor
    tiles = image.reshape(*image.shape[:-2], height, factor, width, factor)
    return np.asarray(tiles.mean(axis=(-3, -1)), np.float32)


def blocks(n: int, factor: int) -> tuple[int, int]:
    """First pixel and number of the blocks: the axis' pixel begins block ``count // 2``."""
    count = n // factor
    first = n // 2 - (count // 2) * factor
    if first < 0 or first + count * factor > n:
        count -= 1
        first = n // 2 - (count // 2) * factor
    return first, count


def enlarged(image: Array, factor: int, shape: tuple[int, int]) -> Floats:
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
