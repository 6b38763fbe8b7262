"""Rows and columns at a photograph's edges in which no light was measured: frames, halves that were not read.

A camera's pixels differ at least by their noise. Where whole outer lines have one value each up to a step, a
file has a frame or the sensor was covered; to a reconstruction that says that no light fell there, which
light through no PSF does beside so much.
"""

from __future__ import annotations

import numpy as np

from recon.arrays import BoolArray, Float32Array
from recon.base.noise import estimate_deviation

STEP, BESIDE = 6.0, 0.5
"""How far pixels beside such lines are from their value, in deviations of the noise, and the share that is:
photographs of little light whose darkest lines are all zero fade into them."""


def seen_window(image: Float32Array) -> tuple[slice, slice]:
    """Return the rows and columns of an image, (height, width), within outer ones of one value each.

    All of them where nothing else is there.
    """
    rows, columns = slice(0, image.shape[0]), slice(0, image.shape[1])
    for _ in range(2):  # columns of a frame may have another value than its rows, whose corners they share
        rows = _varied(image[:, columns], rows)
        columns = _varied(image[rows].T, columns)
    return rows, columns


def unseen_lines(channels: Float32Array, valid: BoolArray) -> BoolArray:
    """Return which pixels lie in outer lines of one value up to a step, or in the one beside such.

    That one is an average with the picture's where a file was binned or resized.

    Parameters
    ----------
    channels : ndarray, (n_channels, height, width)
        Counts.
    valid : ndarray of bool, the same shape
        Pixels that are not erased.
    """
    return np.stack([_unseen(image, known) for image, known in zip(channels, valid, strict=True)])


def _varied(lines: Float32Array, within: slice) -> slice:
    """Return which lines lie between the first and the last one of several values."""
    varied = np.flatnonzero(np.any(lines[within] != lines[within, :1], axis=1)) + within.start
    return slice(int(varied[0]), int(varied[-1]) + 1) if varied.size else within


def _unseen(image: Float32Array, valid: BoolArray) -> BoolArray:
    unseen = np.zeros(image.shape, bool)
    # A line with an erased pixel has no one value: a colour of a mosaic has none at all in every other one.
    rows, columns = seen_window(np.where(valid, image, np.float32(np.nan)))
    if (rows, columns) == tuple(slice(0, n) for n in image.shape):
        return unseen
    noise = estimate_deviation(image[rows, columns], valid[rows, columns])
    inside = np.s_[:, columns], np.s_[:, rows]
    sides = (
        (lines[::way], known[::way], first)
        for lines, known, at in (
            (image[inside[0]], valid[inside[0]], rows),
            (image.T[inside[1]], valid.T[inside[1]], columns),
        )
        for way, first in ((1, at.start), (-1, len(lines) - at.stop))
    )
    if any(_ends_at_a_step(lines, known, first, noise) for lines, known, first in sides if first):
        unseen[:] = True
        unseen[_within(rows, len(image)), _within(columns, image.shape[1])] = False
    return unseen & valid


def _within(lines: slice, n: int) -> slice:
    """Return a window less a line beside what was cut off."""
    return slice(lines.start + (lines.start > 0), lines.stop - (lines.stop < n))


def _ends_at_a_step(lines: Float32Array, known: BoolArray, first: int, noise: float) -> bool:
    """Whether lines stand out of the last of one value, the second and third of them: before ``first``."""
    beside = slice(first + 1, first + 3)
    away = np.abs(lines[beside] - lines[first - 1, :1])[known[beside]]
    return away.size > 0 and float(np.mean(away > STEP * noise)) > BESIDE
