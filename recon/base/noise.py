"""How much noise to expect in a measurement."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np

from recon.arrays import Array, BoolArray, Float64Array
from recon.errors import InputError
from recon.types import plain_number


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Photon and read noise of a camera, in counts.

    Attributes
    ----------
    read_noise : float
        Standard deviation in the dark, counts.
    counts_per_electron : float
        Slope of the photon-transfer curve: variance of ``n`` counts of light is ``n * counts_per_electron``.
    """

    read_noise: float
    counts_per_electron: float

    def __post_init__(self) -> None:
        for name in ("read_noise", "counts_per_electron"):
            object.__setattr__(self, name, value := plain_number(getattr(self, name)))
            if not isinstance(value, Real):
                raise InputError(f"{name} must be a number, in counts, not {type(value).__name__}.")

    def deviation(self, measurement: Array) -> float:
        """Root mean square of the noise expected in a measurement (background subtracted, counts)."""
        signal = float(np.mean(np.maximum(measurement, 0), dtype=np.float64))
        return float(np.sqrt(self.read_noise**2 + self.counts_per_electron * signal))


def averaged_noise(noise: NoiseModel | float | None, count: float) -> NoiseModel | float | None:
    """Return the noise of the mean of ``count`` pixels or frames, from that of one; None where not known."""
    if isinstance(noise, NoiseModel):
        return NoiseModel(noise.read_noise / count**0.5, noise.counts_per_electron / count)
    return None if noise is None else noise / count**0.5


Stencil = tuple[tuple[int, int, float], ...]

_LINE = (1.0, -2.0, 1.0)
_PLANE: Stencil = tuple((i, j, _LINE[i] * _LINE[j]) for i in range(3) for j in range(3))
_ROW: Stencil = tuple((0, j, _LINE[j]) for j in range(3))
_PAIR: Stencil = ((0, 0, 1.0), (0, 1, -1.0))
ENOUGH = 256
"""Stencils from which a median is trusted as it is: with fewer, the one that says least, errors included, as
structure only ever adds."""
FEW = 12
"""Stencils below which nothing is said."""

TILE = 16
"""Side of the tiles within which noise is taken for even, pixels."""

GROUPS = 10
"""Groups of tiles of like brightness."""


def estimate_deviation(measurement: Array, valid: BoolArray | None = None) -> float:
    """Estimate the root mean square of white and photon noise from one image.

    The stencil ``[1, -2, 1] x [1, -2, 1]`` (Immerkær 1996) removes what is locally planar; the median of its
    magnitude over a tile is little moved by the sharp lines of a caustic. Photon noise makes the variance
    grow in proportion to brightness: a line is laid through the dimmest tiles and, of groups of like
    brightness, those with the least variance for their brightness, because structure only ever adds to it.
    Where erased pixels leave too few whole stencils, sparser ones (every second pixel as in a Bayer mosaic,
    three in a row, pairs) take its place.

    Parameters
    ----------
    measurement : ndarray, (height, width)
    valid : ndarray of bool, optional
        Stencils that touch a pixel which is not valid are left out.

    Returns
    -------
    float
        0 for an image too small or too erased to tell.
    """
    m = np.asarray(measurement, np.float64)
    v = np.ones(m.shape, bool) if valid is None else valid
    best, least, enough = None, np.inf, min(ENOUGH, m.size // 4)
    few = max(1, min(FEW, enough))
    for stencil, stride in ((s, n) for s in (_PLANE, _ROW, _PAIR) for n in (1, 2)):
        samples = np.abs(_apply(stencil, stride, m, v))
        found = int(np.count_nonzero(~np.isnan(samples)))
        # The median of a few may be next to nothing by chance.
        bound = float(np.nanmedian(samples)) * (1 + 2 / np.sqrt(found)) if found >= few else np.inf
        if bound < least:
            best, least = samples, bound
        if found >= enough:
            break
    if best is None:
        return 0.0
    # A Gaussian's median magnitude is 0.6745 deviations.
    overall = float(np.nanmedian(best)) / 0.6745
    mean = float(np.mean(m[v]))
    if overall == 0 and 0 < mean < 1 and np.array_equal(m[v], np.round(m[v])):
        return float(np.sqrt(mean))  # single photons, so few that most stencils are empty
    brightness, variance = _tiles(np.where(v, m, np.nan), best)
    if len(brightness) < 4 * GROUPS:
        return overall
    return float(np.sqrt(_mean_variance(brightness, variance)))


def _mean_variance(brightness: Float64Array, variance: Float64Array) -> float:
    """Return the mean over tiles of the variance that brightness alone explains."""
    order = np.argsort(brightness)
    groups = np.array_split(order, GROUPS)
    level = np.array([np.mean(brightness[g]) for g in groups])
    least = np.array([np.quantile(variance[g], 0.4) for g in groups])
    dark, rise = level[0], level - level[0]
    lit = rise > 0.2 * rise[-1]
    if not lit.any():
        return float(np.median(variance))
    slope = max(float(np.quantile((least[lit] - least[0]) / rise[lit], 0.25)), 0.0)
    return float(least[0] + slope * (np.mean(brightness) - dark))


def _tiles(m: Float64Array, magnitude: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return mean brightness and noise variance of the tiles at least half covered by stencils."""
    rows, columns = (n // TILE for n in magnitude.shape)

    def cut(image: Float64Array) -> Float64Array:
        tiles = image[: rows * TILE, : columns * TILE].reshape(rows, TILE, columns, TILE)
        return tiles.transpose(0, 2, 1, 3).reshape(rows * columns, TILE * TILE)

    m, magnitude = cut(m), cut(magnitude)
    known = np.count_nonzero(~np.isnan(magnitude), axis=1)
    whole = known > min(TILE * TILE // 8, int(known.max(initial=0)) // 2)
    if not whole.any():
        return np.empty(0), np.empty(0)
    m, magnitude = m[whole], magnitude[whole]
    median = np.nanmedian if np.isnan(magnitude).any() else np.median
    return np.nanmean(m, axis=1), (median(magnitude, axis=1) / 0.6745) ** 2


def _apply(stencil: Stencil, stride: int, m: Float64Array, valid: BoolArray) -> Float64Array:
    """Return a stencil's values, of unit gain for white noise; NaN where it touches a pixel not valid."""
    height = m.shape[0] - stride * max(i for i, _, _ in stencil)
    width = m.shape[1] - stride * max(j for _, j, _ in stencil)
    if height < 1 or width < 1:
        return np.full((1, 1), np.nan)
    total, whole = np.zeros((height, width)), np.ones((height, width), bool)
    for i, j, coefficient in stencil:
        part = (slice(i * stride, i * stride + height), slice(j * stride, j * stride + width))
        total += coefficient * m[part]
        whole &= valid[part]
    total /= np.sqrt(sum(c * c for _, _, c in stencil))
    total[~whole] = np.nan
    return total
