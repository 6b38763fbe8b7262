"""Offsets that whole rows or columns of a photograph share: a camera's noise that is no pixel's own.

Sensors read a row at once, or a column by one converter: what disturbs that is shared by all of its pixels. A
stencil in two directions does not see it. The means of light in rows are sums, none below zero, of what a PSF
has in its rows; what such sums leave, alike in all quarters of a row, from each row anew, is the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float32Array, Float64Array
from recon.base.filling import fill_smoothly

QUARTERS = 4
"""Parts of each line, which have to agree."""
LEAST_LINES = 13
"""Fewer do not tell."""
FINE, COARSE = 6, 2
"""Orders of differences between neighbouring lines: white noise has as much of both, light less of the
finer."""
WHITE = (0.9, 1.2)
"""Ratio of the deviations by both, of noise that each line has by itself. Without any the measured pairs have
up to 0.91 where there is as much of it at all, the hand's alternating rows (its sensor's colours) 1.29;
noise of 60 counts put on the hand's rows 0.91, of 100 and more 0.95 to 0.96."""
LEAST = 1.0
"""Deviation of lines from which they are levelled, in units of a pixel's noise. Measured sets at bins 1 to 24
have up to 0.99 by the finer differences (a pair at bin 6), simulated scenes of 64 to 192 pixels 0.53."""
UNEXPLAINED = 0.35
"""Share of the lines' finer deviation that light through the PSF leaves, from which lines are levelled. Of
white noise of each row of the hand 0.75 to 0.87 (100 to 1000 counts, bin 8), 0.53 to 0.77 (bin 16); of slits
through measured PSFs 0.10 to 0.18, of emission lines 0.03 to 0.05, of a point through a depth's neighbour
0.18."""
LEAST_LEFT = 0.5
"""Deviation of the offsets that are taken off, in units of a pixel's noise."""
STEPS = 10
"""Of the fit of light, in lines."""
DEPTHS = 5
"""PSFs that light may have come through, evenly among those there are."""
BLOCK = 256
"""Lines that light is fitted to at once."""
STIFFNESS = 10.0 ** np.arange(-4, 9, 0.25)
"""Of the smooth curve that is light's."""


@dataclass(frozen=True, slots=True)
class SharedLines:
    """What whole rows and columns share.

    Attributes
    ----------
    rows, columns : ndarray, (height,) and (width,)
        Offsets, counts; 0 where the lines have none of their own.
    """

    rows: Float64Array
    columns: Float64Array

    @property
    def image(self) -> Float32Array:
        """Offsets of the pixels, (height, width)."""
        return np.asarray(self.rows[:, None] + self.columns, np.float32)

    @property
    def deviations(self) -> dict[str, float]:
        """By ``rows`` and ``columns`` the offsets' standard deviation, counts, where they have any."""
        both = {"rows": float(self.rows.std()), "columns": float(self.columns.std())}
        return {name: deviation for name, deviation in both.items() if deviation > 0}


def shared_lines(data: Array, valid: BoolArray, noise: float, psfs: Array) -> SharedLines | None:
    """Return the offsets of rows and columns of one channel; None where the lines have none.

    Parameters
    ----------
    data : ndarray, (height, width)
        Counts.
    valid : ndarray of bool, the same shape
        Lines without any valid pixel get no offset: a colour of a mosaic has those of its own lattice.
    noise : float
        Standard deviation of a pixel's own, counts; no less is taken than rounding to the counts' step makes.
    psfs : ndarray, (..., height, width)
        All that light comes through.
    """
    image = np.array(data, np.float64)
    noise = max(noise, _step(image[valid]) / 12**0.5)
    rows = _offsets(image, valid, noise, psfs)
    columns = _offsets((image - rows[:, None]).T, valid.T, noise, np.swapaxes(psfs, -1, -2))
    return SharedLines(rows, columns) if rows.any() or columns.any() else None


def _step(values: Float64Array) -> float:
    """Return what values are multiples of, as some of them tell: a pixel's least difference, counts."""
    steps = np.diff(np.unique(values[:: max(1, values.size // 4096)]))
    return float(steps.min()) if steps.size else 0.0


def _offsets(image: Float64Array, valid: BoolArray, noise: float, psfs: Array) -> Float64Array:
    """Return what each row has by itself; 0 where that may be light."""
    offsets = np.zeros(len(image))
    seen, across = valid.any(axis=1), valid.any(axis=0)
    if np.count_nonzero(seen) < LEAST_LINES or np.count_nonzero(across) < QUARTERS:
        return offsets
    quarters = _quarters(image[np.ix_(seen, across)], valid[np.ix_(seen, across)])
    own, coarse = _deviation(quarters, FINE), _deviation(quarters, COARSE)
    if own <= LEAST * noise or not WHITE[0] * coarse <= own <= WHITE[1] * coarse:
        return offsets
    means = quarters.mean(axis=0)
    left = _left_by_light(means, np.flatnonzero(seen), psfs)
    if left is None or _fine(left) < UNEXPLAINED * _fine(means):
        return offsets
    found = means - _smooth(means)
    if found.std() >= LEAST_LEFT * noise:
        offsets[seen] = found
    return offsets


def _quarters(image: Float64Array, valid: BoolArray) -> Float64Array:
    """Return the means of each row's parts, (n, height); missing pixels are filled, in place."""
    if not valid.all():
        fill_smoothly(image, valid.astype(np.float64))
    return np.stack([part.mean(axis=1) for part in np.array_split(image, QUARTERS, axis=1)])


def _deviation(quarters: Float64Array, order: int) -> float:
    """Return the deviation of what the quarters of rows share, by differences of neighbours, counts."""
    steps = np.diff(quarters, n=order, axis=1) / comb(2 * order, order) ** 0.5
    both = [float(np.mean(steps[i] * steps[j])) for i in range(QUARTERS) for j in range(i)]
    return float(np.sqrt(max(float(np.median(both)), 0.0)))


def _fine(line: Float64Array) -> float:
    """Return the size of a line's finer differences."""
    return float(np.linalg.norm(np.diff(line, n=FINE)))


def _left_by_light(means: Float64Array, rows: npt.NDArray[np.intp], psfs: Array) -> Float64Array | None:
    """Return what light through the PSFs leaves of rows' means; None where that is unknown.

    Light of each row of the scene, none below zero, on the sensor and beyond.
    """
    from scipy.optimize import nnls

    flat = psfs.reshape(-1, *psfs.shape[-2:])
    picked = flat[np.unique(np.linspace(0, len(flat) - 1, DEPTHS).round().astype(int))]
    lines = picked.sum(axis=-1, dtype=np.float64)
    lines = [line / line.max() for line in lines if line.max() > 0]
    left = np.empty_like(means)
    lit = means - min(float(means.min()), 0.0)
    for block in np.array_split(np.arange(len(means)), -(-len(means) // BLOCK)):
        at = rows[block]
        light = np.hstack([_cast(line, at) for line in lines])
        light = light[:, light.any(axis=0)]
        try:
            found, _ = nnls(light, lit[block], maxiter=STEPS * len(at))
        except RuntimeError:
            return None
        left[block] = lit[block] - light @ found
    return left


def _cast(line: Float64Array, rows: npt.NDArray[np.intp]) -> Float64Array:
    """Return what rows of the sensor get of each row of the scene by a PSF's sums, (rows, scene)."""
    n = len(line)
    at = rows[:, None] - np.arange(rows[0] - n + 1, rows[-1] + 1)
    return np.where((at >= 0) & (at < n), line[np.clip(at, 0, n - 1)], 0)


def _smooth(line: Float64Array) -> Float64Array:
    """Return the smooth curve through values with noise, as stiff as cross-validation asks for."""
    from scipy.fft import dct, idct

    n, spectrum = len(line), dct(line, norm="ortho")
    bending = (2 - 2 * np.cos(np.pi * np.arange(n) / n)) ** 2
    kept = 1 / (1 + STIFFNESS[:, None] * bending)
    left = ((1 - kept) ** 2) @ spectrum**2
    best = int(np.argmin(left / (n - kept.sum(axis=1)) ** 2))
    return np.asarray(idct(kept[best] * spectrum, norm="ortho"))
