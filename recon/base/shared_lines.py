"""Offsets that whole rows or columns of a photograph share: a camera's noise that is no pixel's own.

Sensors read a row at once, or a column by one converter: what disturbs that is shared by all of its pixels. A
stencil in two directions does not see it. Light through a broad PSF hardly differs from a row's mean to the
next; what does, alike in all quarters of the row and from each row anew, is the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.filling import fill_smoothly

Floats = npt.NDArray[np.float64]

QUARTERS = 4
"""Parts of each line, which have to agree."""
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
CAST = 1.25
"""Deviation of an object's lines relative to its mean (black and white bars 1), of which a PSF lets some
through."""
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

    rows: Floats
    columns: Floats

    @property
    def image(self) -> npt.NDArray[np.float32]:
        """Offsets of the pixels, (height, width)."""
        return np.asarray(self.rows[:, None] + self.columns, np.float32)

    @property
    def deviations(self) -> dict[str, float]:
        """By ``rows`` and ``columns`` the offsets' standard deviation, counts, where they have any."""
        both = {"rows": float(self.rows.std()), "columns": float(self.columns.std())}
        return {name: deviation for name, deviation in both.items() if deviation > 0}


def shared_lines(
    data: npt.NDArray[Any], valid: npt.NDArray[np.bool_], noise: float, psfs: npt.NDArray[Any]
) -> SharedLines | None:
    """Return the offsets of rows and columns of one channel; None where the lines have none.

    Parameters
    ----------
    data : ndarray, (height, width)
        Counts.
    valid : ndarray of bool, the same shape
    noise : float
        Standard deviation of a pixel's own, counts.
    psfs : ndarray, (..., height, width)
        All that light comes through.
    """
    image = np.array(data, np.float64)
    if not valid.all():
        fill_smoothly(image, valid.astype(np.float64))
    rows = _offsets(image, noise, psfs)
    columns = _offsets((image - rows[:, None]).T, noise, np.swapaxes(psfs, -1, -2))
    return SharedLines(rows, columns) if rows.any() or columns.any() else None


def _offsets(image: Floats, noise: float, psfs: npt.NDArray[Any]) -> Floats:
    """Return what each row has by itself; 0 where that may be light."""
    own, coarse = _deviation(image, FINE), _deviation(image, COARSE)
    none = np.zeros(len(image))
    if own < LEAST * noise or not WHITE[0] * coarse <= own <= WHITE[1] * coarse:
        return none
    if own < CAST * _cast(psfs) * abs(float(image.mean())):
        return none
    means = image.mean(axis=1)
    offsets = means - _smooth(means)
    return np.asarray(offsets - offsets.mean())


def _deviation(image: Floats, order: int) -> float:
    """Return the deviation of what the quarters of rows share, by differences of neighbours, counts."""
    if len(image) <= 2 * order or image.shape[1] < QUARTERS:
        return 0.0
    means = np.stack([part.mean(axis=1) for part in np.array_split(image, QUARTERS, axis=1)])
    steps = np.diff(means, n=order, axis=1) / comb(2 * order, order) ** 0.5
    both = [float(np.mean(steps[i] * steps[j])) for i in range(QUARTERS) for j in range(i)]
    return float(np.sqrt(max(float(np.median(both)), 0.0)))


def _cast(psfs: npt.NDArray[Any]) -> float:
    """Return how much of an object's lines PSFs let into the finer differences, at most."""
    most = 0.0
    for psf in psfs.reshape(-1, *psfs.shape[-2:]):
        line = psf.sum(axis=1, dtype=np.float64)
        passed = np.abs(np.fft.rfft(line, 2 * len(line))) / max(float(line.sum()), 1e-30)
        weight = (2 * np.sin(np.linspace(0, np.pi / 2, len(passed)))) ** (2 * FINE) / comb(2 * FINE, FINE)
        most = max(most, float(np.sqrt(np.mean(weight * passed**2))))
    return most


def _smooth(line: Floats) -> Floats:
    """Return the smooth curve through values with noise, as stiff as cross-validation asks for."""
    from scipy.fft import dct, idct

    n, spectrum = len(line), dct(line, norm="ortho")
    bending = (2 - 2 * np.cos(np.pi * np.arange(n) / n)) ** 2
    kept = 1 / (1 + STIFFNESS[:, None] * bending)
    left = ((1 - kept) ** 2) @ spectrum**2
    best = int(np.argmin(left / (n - kept.sum(axis=1)) ** 2))
    return np.asarray(idct(kept[best] * spectrum, norm="ortho"))
