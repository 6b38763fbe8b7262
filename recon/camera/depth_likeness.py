"""How alike a PSF brought to another depth is to one measured there, by how alike the calibrated ones are.

Patterns scaled onto one another lose their likeness with their distance ``D`` in 1/z as
``c(D) = t (b + (1 - b) / (1 + (D / D0)^p))``: noise leaves ``t``, what all patterns have in common ``b``.
Two planes ``h`` apart, mixed as ``v a + w b``, agree with the pattern between them to
``(v c(D_a) + w c(D_b)) / sqrt(v^2 + w^2 + 2 v w c(h))``. Few planes do not tell all of the law: whatever
agrees with the calibrated pairs counts, and the answer is a range. A pattern between planes follows the law
no better than calibrated pairs are asked to: the range is as much wider.
"""

from __future__ import annotations

import numpy as np

from recon.arrays import Float64Array

_POWERS = (1.0, 1.5, 2.0)
"""Lenslets' patterns lose their likeness by about the first, smooth diffusers' by the second."""
_SCALES, _COMMON = 40, 21  # steps of D0 and of b
_KNOWN, _OF_LOST = 0.002, 0.1  # likenesses agree with the law to that, and that part of what is lost


def likeness_range(
    apart: Float64Array, alike: Float64Array, distances: Float64Array, weights: Float64Array, gap: float
) -> tuple[float, float]:
    """Return the least and the largest likeness that calibrated pairs allow.

    Parameters
    ----------
    apart, alike : ndarray, (n_pairs,)
        Distances of pairs of calibrated planes in 1/z, above 0, and their likenesses.
    distances, weights : ndarray, (1 or 2,)
        Of the planes that are mixed: distances from the wanted depth, and shares.
    gap : float
        Between them; 0 of one.
    """
    powers = np.array(_POWERS)[:, None, None, None]
    scales = np.geomspace(apart.min() / 30, 10 * apart.max(), _SCALES)[:, None, None]
    common = np.linspace(0, 1, _COMMON)[:, None]

    def law(distance: Float64Array | float) -> Float64Array:
        near: Float64Array = 1 / (1 + (np.asarray(distance) / scales) ** powers)
        return common + (1 - common) * near

    known = (_KNOWN + _OF_LOST * (1 - alike)) ** -2
    shape = law(apart)
    kept = np.minimum((shape * alike * known).sum(-1) / (shape**2 * known).sum(-1), 1.0)[..., None]
    misfit = ((kept * shape - alike) ** 2 * known).sum(-1)
    agreed = (kept * law(distances) * weights).sum(-1)
    if len(weights) > 1:
        mixed = (weights**2).sum() + 2 * weights[0] * weights[1] * (kept * law(gap))[..., 0]
        agreed = agreed / np.sqrt(mixed)
    possible = agreed[misfit <= max(misfit.min() + 1, 2 * misfit.min())]
    low, high = float(possible.min()), float(possible.max())
    loose = _KNOWN + _OF_LOST * (1 - (low + high) / 2) if len(weights) > 1 else 0.0
    return max(low - loose, 0.0), min(high + loose, 1.0)
