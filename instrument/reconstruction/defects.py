"""Hot and dead pixels: which they are in a photograph, and a PSF without them."""

from __future__ import annotations

import numpy as np

from recon.arrays import Array, BoolArray, Float32Array

FloatImage = Float32Array

SPREAD = 0.01
"""Share of a PSF's pixels above a fifth of its maximum from which its light is spread out: spots of lenslets
are as narrow as a hot pixel, those of a diffuser's caustic are not alone."""
TAIL = 99.99
ODD, LEAST_ODD = 4.0, 0.05
"""Times its 99th percentile by which a defective pixel differs from its neighbours, and twice what the
:data:`TAIL` of the PSF's own pixels do; and at least so much of the photograph's range. Photographs through
simulated and measured PSFs, without such pixels, reach 2.3 times."""

ALONE = 8.0
"""Times by which one pixel of a PSF differs more than any of its eight neighbours does, as optics cannot: the
image of a point whose standard deviation is half a pixel has 7.4."""
MOST_LIGHT = 0.5
"""Share of a PSF's light from which such pixels are its spots and not defects."""
ALIKE, FINE_PX = 0.41, 3.0
"""Correlation of neighbouring pixels (less what is wider than the latter) from which one pixel alone is no
light: measured PSFs have 0.43 and more, foci whose standard deviation is 0.5 or 0.3 pixels 0.47 and 0.31, and
noise none."""
DEPTHS = 0.5
"""Share of a stack's depths at more of which a pixel of the camera's stands alone; a focus does at one."""

WHOLE, MOST_LINES = 0.9, 8
"""Shares of a column or row at full scale, and of all such pixels in such lines, from which these are defects
of the sensor; and so many lines at most: more is a bright field."""


def mended_psf(pixels: Array) -> tuple[Array, int]:
    """Return a PSF image whose hot and dead pixels are filled by their neighbours, and how many those were.

    They are told by the PSF alone, however many there are: each differs from its neighbours, which do not
    differ from theirs. What is left has to be spread out, and wider than a pixel; else nothing is filled.

    Parameters
    ----------
    pixels : ndarray, (height, width[, n_channels])
        With any offset.

    Returns
    -------
    ndarray
        Shape and dtype of ``pixels``, which is it itself where nothing is filled.
    int
        Filled pixels, of all channels.
    """
    stack, count = mended_stack(pixels[None])
    return stack[0] if count else pixels, count


def mended_stack(stack: Array) -> tuple[Array, int]:
    """Fill hot and dead pixels of the PSFs of several depths: those that stand alone at most of them.

    A defect stays where it is, and is filled at every depth then; a point in focus at one of them is light.

    Parameters
    ----------
    stack : ndarray, (n_z, height, width[, n_channels])
        With any offset.

    Returns
    -------
    ndarray
        Shape and dtype of ``stack``, which is it itself where nothing is filled.
    int
        Filled pixels, of all depths and channels.
    """
    where = np.mean([_defective(plane) for plane in stack], axis=0) > DEPTHS
    count = len(stack) * int(np.count_nonzero(where))
    if not count:
        return stack, 0
    filled = stack.copy()
    chosen = where[..., None] if where.ndim == 2 else where
    for plane in filled.reshape(*stack.shape[:3], -1):
        for c in np.flatnonzero(chosen.any(axis=(0, 1))):
            values = _middle(plane[..., c].astype(np.float32))[chosen[..., c]]
            plane[..., c][chosen[..., c]] = np.round(values) if stack.dtype.kind in "ui" else values
    return filled, count


def _defective(pixels: Array) -> BoolArray:
    """Return which pixels of a PSF (height, width[, n_channels]) no light through it differs on alone."""
    channels = pixels[..., None] if pixels.ndim == 2 else pixels
    found = np.zeros(channels.shape, bool)
    for c in range(channels.shape[2]):
        plane = channels[..., c].astype(np.float32)
        middle = _middle(plane)
        where = _alone(plane, np.abs(plane - middle))
        if not where.any():
            continue
        mended = np.where(where, middle, plane)
        light = float(np.sum(mended - _level(mended), dtype=np.float64))
        alone = float(np.sum(np.abs(plane - mended), dtype=np.float64))
        if alone < MOST_LIGHT * (light + alone) and is_spread(mended) and _alikeness(mended) >= ALIKE:
            found[..., c] = where
    return found.reshape(pixels.shape)


def _alikeness(plane: FloatImage) -> float:
    """Return the correlation of neighbouring pixels, of rows or of columns, whichever is less."""
    from scipy.ndimage import gaussian_filter  # commands' helps do without it

    fine = plane - gaussian_filter(plane, FINE_PX)
    most = float(np.percentile(np.abs(fine), 99))
    fine = np.clip(fine, -most, most)  # defects that were missed
    power = float(np.mean(fine**2))
    both = np.mean(fine[1:] * fine[:-1]), np.mean(fine[:, 1:] * fine[:, :-1])
    return float(min(both)) / power if power else 0.0


def _alone(plane: FloatImage, odd: FloatImage) -> BoolArray:
    """Return where a pixel lies beyond its four neighbours by far more than its eight are ``odd``."""
    near = _four_neighbours(plane)
    beyond = np.maximum(plane - np.max(near, axis=0), np.min(near, axis=0) - plane)
    low, high = np.percentile(plane[::4, ::4], [1, 99])
    rows, columns = np.nonzero(beyond > max(LEAST_ODD * float(high - low), np.finfo(np.float32).tiny))
    padded = np.pad(odd, 1)
    most = np.zeros(rows.shape, np.float32)
    for row in range(3):
        for column in range(3):
            if (row, column) != (1, 1):
                np.maximum(most, padded[rows + row, columns + column], out=most)
    where = np.zeros(plane.shape, bool)
    where[rows, columns] = beyond[rows, columns] > ALONE * most
    return where


def whole_lines(saturated: BoolArray) -> str:
    """Name the whole columns or rows, from 0, that nearly all saturated pixels lie in; "" where they do not.

    Parameters
    ----------
    saturated : ndarray of bool, (height, width[, n_channels])
    """
    plane = saturated if saturated.ndim == 2 else saturated.any(axis=-1)
    for name, axis in (("column", 0), ("row", 1)):
        lines = np.flatnonzero(plane.mean(axis=axis) > WHOLE)
        held = np.count_nonzero(np.take(plane, lines, axis=1 - axis))
        if 0 < len(lines) <= MOST_LINES and held > WHOLE * np.count_nonzero(plane):
            return f"{name}{'s' if len(lines) > 1 else ''} {', '.join(map(str, lines))}"
    return ""


def is_spread(psf: Array) -> bool:
    """Tell whether the light of a PSF (height, width) is spread out: none of it is on one pixel alone."""
    level = _level(psf)
    return bool(np.mean(psf - level > (psf.max() - level) / 5) >= SPREAD)


def _level(psf: Array) -> float:
    return float(np.median(psf[[0, 0, -1, -1], [0, -1, 0, -1]]))


def defective_pixels(pixels: Array, psf: Array) -> BoolArray:
    """Return which pixels are hot or dead, in their shape: no light through this PSF differs so on one pixel.

    None where the PSF (height, width[, n_channels]) has spots as narrow, as sharp lenslets have.
    """
    channels = pixels[..., None] if pixels.ndim == 2 else pixels
    defective = np.zeros(channels.shape, bool)
    shape = psf if psf.ndim == 2 else psf.mean(axis=-1)
    if is_spread(shape):
        usual, tail = np.percentile(_oddness(shape), [99, TAIL])
        times = max(ODD, 2 * float(tail) / max(float(usual), 1e-30))
        for c in range(channels.shape[2]):
            odd = _oddness(channels[..., c])
            low, high = np.nanpercentile(channels[::4, ::4, c], [1, 99])
            if usual := float(np.percentile(odd, 99)):
                defective[..., c] = odd > max(times * usual, LEAST_ODD * (high - low))
    defective &= np.isfinite(channels)
    return defective.reshape(pixels.shape)


def _oddness(plane: Array) -> FloatImage:
    """Return how far pixels differ from the middle two of their four neighbours, (height, width)."""
    known = np.asarray(plane, np.float32)
    if np.isnan(known).any():  # holes
        known = np.where(np.isnan(known), np.float32(np.nanmedian(known)), known)
    middle = _middle(known)
    return np.abs(np.subtract(known, middle, out=middle), out=middle)


def _middle(known: FloatImage) -> FloatImage:
    """Return the mean of the middle two of every pixel's four neighbours, (height, width)."""
    above, below, left, right = _four_neighbours(known)
    middle = np.maximum(np.minimum(above, below), np.minimum(left, right))
    middle += np.minimum(np.maximum(above, below), np.maximum(left, right))
    middle /= 2
    return middle


def _four_neighbours(plane: FloatImage) -> tuple[FloatImage, ...]:
    """Return every pixel's neighbour above, below, on the left and on the right, each (height, width)."""
    padded = np.pad(plane, 1, mode="reflect")
    return padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
