"""What tells that PSFs and beads are made up, though they explain the images.

No misfit does: where spots are smaller than a pixel or there are too few images, beads are put beside those
that are there until all is explained. PSFs that are made up fit the images that they were made from, and no
others; beads that are made up are many.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.blind.points import PointMixer, solve_smooth
from recon.blind.polish import Polished, highest_degree_for
from recon.camera.points import FieldFunctions

Floats = npt.NDArray[np.float32]

LEAST_ALIKE = 0.93
"""Likeness of both halves' PSFs below which PSFs are not to be relied on."""
MOST_BEADS = 50
"""Beads of a slide beyond which they are hardly separate ones: of 40, found as 57 to 88 or as 22 to 32, PSFs
off the axis were wrong."""


def alike_by_halves(data: Floats, polished: Polished, iterations: int) -> float:
    """Return the cosine similarity of the mean PSFs that two halves of the images give, 1 at best.

    Each half is fitted where the PSFs have light, with the beads that all images together gave.

    Parameters
    ----------
    data : ndarray, float32, (n_images, height, width)
        Two or more images.
    polished : Polished
        Of these images.
    iterations : int
        Of each fit.
    """
    window, sensor = polished.psfs.shape[1:], data.shape[1:]
    lit = np.any(polished.psfs != 0, axis=0)
    halves = [slice(first, None, 2) for first in (0, 1)]
    beads = [polished.beads[half] for half in halves]
    fewest = min(sum(map(len, points)) for points in beads)
    degree = min(polished.functions.degree, highest_degree_for(fewest))
    functions = FieldFunctions(degree, np.concatenate([points.places for points in polished.beads]))
    found = []
    for half, points in zip(halves, beads, strict=True):
        mixer = PointMixer(points, functions, (window[0], window[1]), (sensor[0], sensor[1]))
        start = np.zeros((functions.count, *window), np.float32)
        psfs, _ = solve_smooth(mixer, data[half], start, lit, iterations)
        found.append(psfs[0].astype(np.float64))
    one, other = found
    lengths = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.vdot(one, other)) / lengths if lengths > 0 else 0.0
