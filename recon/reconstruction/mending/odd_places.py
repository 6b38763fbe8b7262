"""Places of a photograph that nothing explains: dust, hairs, reflections of a lamp.

Light through a PSF of any extent is everywhere or nowhere. Where a reconstruction leaves far more in a few
places than anywhere else, and leaves no more than calibrated cameras do once it is made without them, they
are left out. What a wrong calibration leaves is everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recon.arrays import BoolArray, Float64Array
from recon.base.blocks import blocks_about_axis
from recon.reconstruction.pilot import pilot
from recon.reconstruction.problem import Problem

LONGEST_PX = 100
"""Of the copies that places are looked for on, about: a speck of dust has a block or two there. On 64 pixels
twenty specks are more than may be left out."""
FAR = 3.0
"""How much more is left in a place than as a rule (by the median), and than calibrated cameras leave, in
deviations."""
GAUSSIAN = 1.4826
"""Deviation over median magnitude."""
MOST = 0.15
"""Share of the pixels that may be left out."""
LEFT = 0.7
"""Mean square that is left without them, in units of what calibrated cameras leave, noise included, up to
which they were all that is wrong. The hand under dust, a lamp, a reflection: 0.33 to 0.52 (2 to 32 with them;
as it is 0.19); through a PSF cut to 70 % 1.8, raised to a power of 0.7 and 0.45 1.1, in bands 5.0, mirrored
21. A second round would explain gamma-coded ones as well."""


def odd_places(channels: Sequence[Problem], usual2: Float64Array, iterations: int) -> BoolArray | None:
    """Return the blocks that nothing explains, (height, width); None where they are not all that is wrong.

    Parameters
    ----------
    channels : sequence of Problem
        One channel each on blocks of pixels, a picture through one PSF.
    usual2 : ndarray, (n_channels,)
        Mean square that a calibrated camera leaves of each as a rule, noise included, in units of the noise.
    iterations : int
        Iterations of each reconstruction.
    """
    odd = np.zeros(channels[0].sensor_shape, bool)
    seen = np.stack([channel.valid[0] for channel in channels])
    for _ in range(2):
        known = seen & ~odd
        left = [_left(c, k, iterations) for c, k in zip(channels, known, strict=True)]
        each = [float(np.mean(r[k] ** 2)) / u for r, k, u in zip(left, known, usual2, strict=True)]
        if np.mean(each) <= LEFT:
            return odd if odd.any() else None
        found = [_far(r, k, u) for r, k, u in zip(left, known, usual2, strict=True)]
        odd = odd | _grown(np.any(found, axis=0))
        if not np.any(found) or np.mean(odd & seen.any(axis=0)) > MOST * np.mean(seen):
            break
    return None


def on_pixels(blocks: BoolArray, factor: int, shape: tuple[int, int]) -> BoolArray:
    """Return blocks about the axis (:mod:`recon.base.blocks`) as pixels; a rest belongs to the outermost."""
    for axis, n in enumerate(shape):
        first, count = blocks_about_axis(n, factor)
        at = np.clip((np.arange(n) - first) // factor, 0, count - 1)
        blocks = np.take(blocks, at, axis=axis)
    return blocks


def _left(channel: Problem, known: BoolArray, iterations: int) -> Float64Array:
    """Return what a reconstruction from some pixels leaves, (height, width), in units of the noise."""
    seen = replace(channel, valid=known[None], data=np.where(known, channel.data, 0))
    left: Float64Array = pilot(seen, iterations).left[0].astype(np.float64)
    return left


def _far(left: Float64Array, known: BoolArray, usual2: float) -> BoolArray:
    """Return where far more is left than elsewhere."""
    as_a_rule = GAUSSIAN * float(np.median(np.abs(left[known])))
    return np.asarray(known & (np.abs(left) > FAR * max(as_a_rule, usual2**0.5)))


def _grown(places: BoolArray) -> BoolArray:
    """Return places with the blocks beside them, into which their edges reach."""
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(places))
