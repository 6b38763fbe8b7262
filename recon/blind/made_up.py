"""What tells that PSFs and beads are made up, though they explain the images.

No misfit does: where spots are smaller than a pixel or there are too few images, beads are put beside those
that are there until all is explained. PSFs that are made up fit the images that they were made from, and no
others; beads that are made up are many.
"""

from __future__ import annotations

import numpy as np

from recon.arrays import Float32Array
from recon.blind.points import PointMixer, solve_smooth
from recon.blind.polish import Polished, highest_degree_for
from recon.camera.points import FieldFunctions

LEAST_ALIKE = 0.93
"""Likeness of both halves' PSFs below which PSFs are not to be relied on."""
_DIMMEST = 0.1
"""Share of the pixels from which noise is read."""
MOST_BEADS = 50
"""Beads of a slide beyond which they are hardly separate ones: of 40, found as 57 to 88 or as 22 to 32, PSFs
off the axis were wrong."""


def alike_by_halves(data: Float32Array, polished: Polished, iterations: int) -> float:
    """Return the cosine similarity of the mean PSFs that two halves of the images give, 1 at best.

    Each half is fitted where the PSFs have light, with the beads that all images together gave. What noise
    alone gives in the same fit is taken off the energy of either PSF: few and dim images of beads that are
    right agree no worse than many. Where it is more than half of that energy, nothing is taken off.

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
    noise = np.random.default_rng(0).normal(0, _deviation(data, polished), data.shape).astype(np.float32)
    found, energies = [], []
    for half, points in zip(halves, beads, strict=True):
        mixer = PointMixer(points, functions, (window[0], window[1]), (sensor[0], sensor[1]))
        start = np.zeros((functions.count, *window), np.float32)
        psf, of_noise = (
            solve_smooth(mixer, images[half], start, lit, iterations)[0][0].astype(np.float64)
            for images in (data, noise)
        )
        found.append(psf)
        energies.append((float(np.vdot(psf, psf)), float(np.vdot(of_noise, of_noise))))
    told = all(by_noise <= energy / 2 for energy, by_noise in energies)
    lengths = np.prod([np.sqrt(energy - by_noise * told) for energy, by_noise in energies])
    return min(float(np.vdot(*found) / lengths), 1.0) if lengths > 0 else 0.0


def _deviation(data: Float32Array, polished: Polished) -> float:
    """Return the noise where the model has least light, by the median: what is not explained there.

    Less than the noise where photons make most of it: too little is then taken off.
    """
    seen = polished.images((data.shape[1], data.shape[2]))
    left = (data - seen)[seen <= np.quantile(seen, _DIMMEST)]
    return float(np.median(np.abs(left))) / 0.6745  # a Gaussian's median magnitude, in deviations
