"""Which share of pairs of points a picture tells apart, by their distance and their places between pixels.

Points of a picture are hardly wider than its pixels, so that where a pair lies between pixels decides as much
as its distance: at 1.7 pixels those are told apart whose points lie near the middles of two pixels with one
between them, up to 2 pixels not those that share their light with the pixel between them. A curve in the
distance alone does not have that shape. Here the place is part of the law: a point's light is shared linearly
between the two nearest pixels and blurred by a Gaussian of ``sigma`` pixels; the dip ``D`` that two of them
leave is found as in a picture, and they are told apart with the chance

    ``1 / (1 + exp(-(D + offset + slope * ln(px / 2) - 0.2) / softness))``.

``sigma``, ``offset``, ``slope`` (a prior or a bound at zero sharpens what lies farther apart) and
``softness`` (noise) are fitted to pairs that were tried. Averaged over all places, that is the share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from recon.analysis.points import DIP
from recon.analysis.stated_distance import AT_NEARER, FARTHEST, NEARER, PROMISED, TriedPair
from recon.arrays import Float64Array

_SIGMAS = np.concatenate([np.arange(0.0, 0.6, 0.05), np.geomspace(0.6, 4.5, 20)])
_USUAL = np.array([0.0, 0.55, np.log(0.03)])  # offset, slope, logarithm of the softness
_ABOUT = np.array([0.08, 0.4, 0.7])  # by which they differ from camera to camera
_SOFTNESSES = np.linspace(-2.0, 2.5, 10)  # standard deviations from the usual one
_NEWTON = 12
_NONE = -6.0  # logarithm of the odds where no pixel lies between the two
_PARTS = 20  # of a pixel, in the finest kernel
_PLACES = (np.arange(24) + 0.5) / 24
_DISTANCES = np.geomspace(1.2, FARTHEST, 180)


@dataclass(frozen=True)
class Told:
    """Share of pairs told apart along an axis."""

    sigma: float
    offset: float
    slope: float
    softness: float

    @property
    def law(self) -> tuple[float, float, float]:
        """Offset, slope and softness."""
        return self.offset, self.slope, self.softness

    @classmethod
    def of(cls, tried: Sequence[TriedPair]) -> Told | None:
        """Fit to pairs of one axis; None where none was told apart."""
        told = np.array([one.told for one in tried], bool)
        if not told.any():
            return None
        px, places = (np.array([getattr(one, name) for one in tried]) for name in ("px", "place"))
        dips = np.stack([_dips(float(sigma), px, places) for sigma in _SIGMAS])
        # For each width and softness a logistic regression in offset and slope: Newton's method, all at once.
        softness = np.exp(_USUAL[2] + _ABOUT[2] * _SOFTNESSES)
        factors = np.stack([np.ones(len(px)), np.log(px / 2)])
        law = np.tile(_USUAL[:2], (len(_SIGMAS), len(softness), 1))
        between, sides = dips[:, None] > 0, np.where(told, 1.0, -1.0)
        for _ in range(_NEWTON):
            odds = (dips[:, None] + law @ factors - DIP) / softness[:, None]
            chance = 1 / (1 + np.exp(-np.clip(odds, -30, 30)))
            wrong = np.where(between, chance - told, 0.0) / softness[:, None]
            weight = np.where(between, chance * (1 - chance), 0.0) / softness[:, None] ** 2
            slope = wrong @ factors.T + (law - _USUAL[:2]) / _ABOUT[:2] ** 2
            bent = np.einsum("swn,in,jn->swij", weight, factors, factors) + np.diag(_ABOUT[:2] ** -2.0)
            step = np.linalg.solve(bent, slope[..., None])[..., 0]
            law = law - np.clip(step, -0.1, 0.1)
        odds = np.where(between, (dips[:, None] + law @ factors - DIP) / softness[:, None], _NONE)
        misfit = np.logaddexp(0.0, -sides * np.clip(odds, -30, 30)).sum(axis=-1)
        misfit += 0.5 * np.square((law - _USUAL[:2]) / _ABOUT[:2]).sum(axis=-1) + 0.5 * _SOFTNESSES**2
        n, m = np.unravel_index(int(np.argmin(misfit)), misfit.shape)
        return cls(float(_SIGMAS[n]), float(law[n, m, 0]), float(law[n, m, 1]), float(softness[m]))

    def share(self, px: float) -> float:
        """Return which share of the pairs so far apart is told apart, over all places between pixels."""
        return float(np.interp(px, _DISTANCES, self._shares))

    @cached_property
    def _shares(self) -> Float64Array:
        apart, places = np.repeat(_DISTANCES, len(_PLACES)), np.tile(_PLACES, len(_DISTANCES))
        odds = _log_odds(_dips(self.sigma, apart, places), apart, *self.law)
        return np.asarray((1 / (1 + np.exp(-odds))).reshape(len(_DISTANCES), -1).mean(axis=1))

    @property
    def stated_px(self) -> float:
        """The distance with both shares, :data:`PROMISED` there and :data:`AT_NEARER` at ``NEARER`` of it.

        The middle of where both are; where both nowhere are, the nearest with the first.
        """
        few = np.flatnonzero(self._shares < PROMISED)
        nearest = _DISTANCES[min(few[-1] + 1, len(_DISTANCES) - 1)] if few.size else _DISTANCES[0]
        many = np.flatnonzero(self._shares > AT_NEARER)
        farthest = _DISTANCES[max(many[0] - 1, 0)] / NEARER
        return float(np.sqrt(nearest * max(farthest, nearest)))


def stated_apart(tried: Sequence[TriedPair]) -> tuple[Told | None, Told | None]:
    """Return the share told apart along y and along x; None where no pair of an axis was told apart."""
    y, x = (Told.of([one for one in tried if one.axis == axis]) for axis in (0, 1))
    return y, x


def _log_odds(
    dips: Float64Array, px: Float64Array, offset: float, slope: float, softness: float
) -> Float64Array:
    odds = (dips + offset + slope * np.log(px / 2) - DIP) / softness
    return np.asarray(np.where(dips > 0, np.clip(odds, -30, 30), _NONE))


def _dips(sigma: float, px: Float64Array, places: Float64Array) -> Float64Array:
    """Return the dip that two points of a Gaussian blur leave on pixels, the first at these places in one."""
    t, kernel = _kernel(sigma)
    first, second = (2.0 + places)[:, None], (2.0 + places + px)[:, None]
    pixels = np.arange(int(second.max()) + 4)[None]
    line = np.interp(pixels - first, t, kernel) + np.interp(pixels - second, t, kernel)
    # As smallest_dip has it: the largest pixel near each point, and the least between them.
    near = np.maximum(px / 3, 0.5)[:, None]
    left, right = (
        np.where(np.abs(pixels - point) <= near, line, -1.0).argmax(axis=1)[:, None]
        for point in (first, second)
    )
    lower = np.minimum(*(np.take_along_axis(line, peak, axis=1)[:, 0] for peak in (left, right)))
    valley = np.where((pixels > left) & (pixels < right), line, np.inf).min(axis=1)
    return np.where(np.isfinite(valley), 1 - np.minimum(valley, 1e9) / lower, 0.0)


def _kernel(sigma: float) -> tuple[Float64Array, Float64Array]:
    from scipy.ndimage import gaussian_filter1d

    reach = int(np.ceil(1 + 4 * sigma)) * _PARTS
    t = np.arange(-reach, reach + 1) / _PARTS
    triangle = np.maximum(1 - np.abs(t), 0.0)
    return t, np.asarray(gaussian_filter1d(triangle, max(sigma, 1e-3) * _PARTS, mode="constant"))
