"""What a reconstruction holds: how much is lit, where, and how far it stands above the noise."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

LIT = 0.05
"""Share of the brightest voxels' value (their 99.5th percentile) from which a voxel counts as lit, and a
difference between neighbours as an edge."""
MOST_SAMPLES = 4_000_000
SMOOTH_PX = 0.7
"""A point between pixels is shared by up to four: smoothed so far before peaks are looked for."""
FOUND = 0.1
STRONG = 0.5
"""Height from which a peak counts as found and as strong, relative to the height at which the light lies
(``sum y^2 / sum y``, which empty space around it does not change)."""


def lit_and_edges(volume: Array) -> tuple[float, float]:
    """Return the shares of lit voxels and of edges, plane by plane: volumes may be as large as the memory."""
    sample = volume.reshape(-1)[:: max(volume.size // MOST_SAMPLES, 1)]
    white = float(np.percentile(sample, 99.5))
    if white <= 0:
        white = float(volume.max())
    if white <= 0:
        return 0.0, 0.0
    level = LIT * white
    lit = edges = 0
    for z, plane in enumerate(volume):
        step = np.zeros(plane.shape, bool)
        step[:-1] |= np.abs(np.diff(plane, axis=0)) > level
        step[:, :-1] |= np.abs(np.diff(plane, axis=1)) > level
        if z + 1 < len(volume):
            step |= np.abs(volume[z + 1] - plane) > level
        lit += int(np.count_nonzero(plane > level))
        edges += int(np.count_nonzero(step))
    return lit / volume.size, edges / volume.size


@dataclass(frozen=True, slots=True)
class Points:
    """The bright points of a volume.

    Attributes
    ----------
    height : float
        Median height of the peaks found, as the camera sees them: a voxel's value times its PSF's norm, over
        the noise. That is how far a single point stands above the noise of all pixels which it lights.
    peaks : float
        Strong peaks for each thousand measured pixels.
    ends : float
        Mean light of the two outermost planes over the mean plane's: above 1 where light that fits nowhere
        gathers, or where the scene goes on beyond the calibrated depths.
    """

    height: float
    peaks: float
    ends: float


def points_of(volume: Array, norms: npt.NDArray[np.float64], count: int) -> Points:
    """Measure the bright points of a volume, three planes in memory at a time.

    Parameters
    ----------
    volume : ndarray, (n_z, rows, columns)
    norms : ndarray, (n_z,)
        Norms of the planes' PSFs over the noise.
    count : int
        Measured pixels.
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    light = np.zeros(len(volume))
    squares = 0.0
    heights = []
    window: deque[tuple[Array, Array]] = deque(maxlen=3)  # planes, smoothed, each with its local maxima
    for z in range(len(volume) + 1):
        if z < len(volume):
            seen = np.maximum(volume[z], 0) * np.float32(norms[z])
            plane = gaussian_filter(seen, SMOOTH_PX)
            window.append((plane, maximum_filter(plane, 3)))
            light[z] = float(np.sum(seen, dtype=np.float64))
            squares += float(np.sum(np.square(plane), dtype=np.float64))
        elif len(window) == 3:
            window.popleft()
        if z > 0:  # the plane before is known with both its neighbours
            middle = window[-2 if z < len(volume) else -1][0]
            highest = np.max([maxima for _, maxima in window], axis=0)
            heights.append(middle[(middle == highest) & (middle > 0)])
    total = float(light.sum())
    if total <= 0:
        return Points(0.0, 0.0, 1.0)
    found = np.concatenate(heights)
    level = squares / total
    strong = int(np.count_nonzero(found > STRONG * level))
    above = found[found > FOUND * level]
    return Points(
        height=float(np.median(above)) if len(above) else 0.0,
        peaks=1000 * strong / max(count, 1),
        ends=float((light[0] + light[-1]) / 2 / light.mean()),
    )
