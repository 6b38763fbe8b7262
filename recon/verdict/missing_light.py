"""What a PSF lacks because the sensor ended before its pattern did, as far as a picture asks for it.

A point beside the middle casts the pattern moved, and moves onto the sensor what lay beyond its edge when
the PSF was taken. No calibration holds that light. A pattern is taken to be as bright beyond an edge as along
it, above the PSF's darkest places, for want of knowledge; so each point found lacks a strip as wide as the
point is off the middle. That is the most that may lack: a pattern may end behind the edge.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from recon.arrays import Array, Float64Array

EDGE = 0.04
"""Width of a PSF's edges, whose mean is what lies beyond them, relative to the shorter side."""
DARK = 0.05
"""Share of a PSF's places that are its darkest: as much light lies along edges without any pattern there."""
MOST_DARK, BRIGHTEST = 0.03, 0.999
"""Of the brightest thousandth at most so much is taken for a pedestal: of a pattern that fills its frame the
darkest places are as bright as the rest, and a larger pedestal leaves no good picture."""
ABOVE = 3.0
"""Standard errors of its mean by which an edge has to be brighter than that: less may be noise."""
MUCH, MUCH_INSIDE = 0.28, 0.09
"""Light that lacks, relative to what the PSF casts on the sensor, of all that was found and of what was found
opposite to the sensor, from both of which a picture is doubtful. The second spares small scenes: with too
short a PSF light is found far outside the field that is not there."""


class Missing(NamedTuple):
    """Light that a calibration lacks, relative to the light on the sensor that it explains."""

    of_all: float
    """Of the points found anywhere."""
    inside: float
    """Of those within the field opposite to the sensor alone."""

    @property
    def much(self) -> bool:
        """Whether a picture has to suffer from it."""
        return self.of_all >= MUCH and self.inside >= MUCH_INSIDE


def missing_light(psfs: Array, found: Array, window: tuple[slice, slice], axis: tuple[int, int]) -> Missing:
    """Return what PSFs lack of a picture, of the channel that lacks most.

    Parameters
    ----------
    psfs : ndarray, (1 or n_channels, height, width)
        As large as the sensor.
    found : ndarray, (n_channels, grid height, grid width)
        The whole object, also beyond the field that is opposite to the sensor.
    window : (slice, slice)
        That field on the grid, rows and columns.
    axis : (int, int)
        Row and column of it where a point casts the PSF as it is.
    """
    each = [
        _missing(psfs[min(c, len(psfs) - 1)], np.maximum(one, 0), window, axis) for c, one in enumerate(found)
    ]
    return max(each, key=lambda one: (one.much, one.of_all))


def _missing(psf: Array, found: Array, window: tuple[slice, slice], axis: tuple[int, int]) -> Missing:
    height, width = psf.shape
    down, across = (
        np.arange(n) - (at.start + middle) for n, at, middle in zip(found.shape, window, axis, strict=True)
    )
    top, bottom, left, right = _edges(psf)
    lacks_down = np.where(down > 0, top, bottom) * np.minimum(np.abs(down), height) * width
    lacks_across = np.where(across > 0, left, right) * np.minimum(np.abs(across), width) * height
    lacking = found * (lacks_down[:, None] + lacks_across)
    cast = float(np.sum(found * _cast(psf, down, across)))
    inside = np.zeros(found.shape, bool)
    inside[window] = True
    unit = max(cast, 1e-30)
    return Missing(float(lacking.sum()) / unit, float(lacking[inside].sum()) / unit)


def _edges(psf: Array) -> tuple[float, float, float, float]:
    """Return a PSF's mean light along its top, bottom, left and right, above that of its darkest places."""
    wide = max(1, round(EDGE * min(psf.shape)))
    strips = psf[:wide], psf[-wide:], psf[:, :wide], psf[:, -wide:]
    most = MOST_DARK * float(np.quantile(psf, BRIGHTEST))
    dark = min(max(_darkest(psf, wide), 0.0), most)
    top, bottom, left, right = (_above(strip, dark) for strip in strips)
    return top, bottom, left, right


def _above(strip: Array, dark: float) -> float:
    light = float(strip.mean(dtype=np.float64)) - dark
    error = float(strip.std(dtype=np.float64)) / math.sqrt(strip.size)
    return light if light > ABOVE * error else 0.0


def _darkest(psf: Array, wide: int) -> float:
    """Return the mean light of a PSF's darkest places, found in every other row and read in those between.

    Noise that makes a place look dark in some rows is not in the others.
    """
    side = max(2, wide // 2 * 2)
    height, width = (n // side for n in psf.shape)
    places = psf[: height * side, : width * side].reshape(height, side, width, side)
    seen, read = (places[:, start::2].mean(axis=(1, 3), dtype=np.float64) for start in (0, 1))
    return float(read[seen <= np.quantile(seen, DARK)].mean()) if seen.size else 0.0


def _cast(psf: Array, down: Array, across: Array) -> Float64Array:
    """Return the light of a PSF that falls on the sensor, moved by whole pixels."""
    until = np.zeros((psf.shape[0] + 1, psf.shape[1] + 1))
    until[1:, 1:] = psf.cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
    (first, last), (begin, end) = (
        (np.clip(-by, 0, n), np.clip(n - by, 0, n)) for by, n in zip((down, across), psf.shape, strict=True)
    )
    corner = [until[np.ix_(r, c)] for r in (last, first) for c in (end, begin)]
    return np.asarray(np.maximum(corner[0] - corner[1] - corner[2] + corner[3], 0))
