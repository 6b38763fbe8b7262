"""Which distance between points is stated: nine in ten are told apart at it, three in ten at 0.8 of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from recon.analysis.points import PointTrial
from recon.arrays import Float64Array

PROMISED, NEARER, AT_NEARER = 0.9, 0.8, 0.3
"""Share of the pairs that are told apart at the stated distance, and at ``NEARER`` of it at the most."""
ROUNDS, DRAWS = 3, 8
"""Rounds of two points, later ones about what earlier ones found; pairs of other distances in each."""
FARTHEST = 12.0
"""Pixels, or planes, between two points at most."""


@dataclass(frozen=True, slots=True)
class TriedPair:
    """A pair of points in a reconstruction."""

    px: float
    axis: int
    """0: along y, 1: along x."""
    told: bool
    place: float = 0.0
    """Of its first point along the axis: 0 in the middle of a pixel, up to 1 in the next one's."""


@dataclass(frozen=True, slots=True)
class Reached:
    """What the default reconstruction reaches, with the noise of the tests."""

    across_px: tuple[float | None, float | None]
    """Distance along y and along x at which 90 % of the pairs are told apart, and at 0.8 of it at most 30 %
    (:mod:`recon.analysis.told_apart`); at the least the smallest one tried; None: at none tried."""
    focus_um: tuple[float, float] | None
    """Nearest and farthest depth (possibly infinite) at which pairs half as far again apart are told apart in
    a picture focused at the depth analysed; None where no distance was found along an axis, or the sensor
    has no room for two pairs."""
    pairs: tuple[TriedPair, ...]
    method: str
    """Solver and prior."""
    part: float
    """Part of the sensor's pixels that was used."""
    shares: tuple[tuple[float, float] | None, tuple[float, float] | None] = (None, None)
    """Along y and along x: the share of the pairs told apart at the stated distance, and at 0.8 of it."""


@dataclass(frozen=True, slots=True)
class InVolumes:
    """What default volumes reach, with the noise of the tests."""

    along_per_um: float | None
    """Difference in 1/z of two points along the axis of which 90 % are told apart, and at 0.8 of it at most
    30 %; None: at none tried."""
    sixteen_factor: float | None
    """By how much the optics' two distances had to grow for 4 x 4 points in x and z; None: more than there is
    room for."""
    planes: int
    """Of the largest volume, half an axial step apart."""
    part: float
    """Part of the sensor's pixels that was used."""


def smallest_told(
    try_one: Callable[[float, int], PointTrial], least: float, most: float = FARTHEST
) -> tuple[list[PointTrial], float | None]:
    """Try points at separations, or multiples of them, from ``least`` to ``most``, each with its own seed.

    Returns
    -------
    list of PointTrial
        All that were made, the last one at the separation found.
    float or None
        The separation at which nine in ten of them are resolved, and at 0.8 of it at most three in ten.
    """
    trials: list[PointTrial] = []
    tried: list[TriedPair] = []
    about, wide, found = least * np.sqrt(3.0), np.sqrt(3.0), None
    rng = np.random.default_rng(0)
    for _ in range(ROUNDS):
        for share in (np.arange(DRAWS) + rng.uniform(0, 1, DRAWS)) / DRAWS:
            apart = min(float(about * wide ** (2 * share - 1)), most)
            trials.append(try_one(apart, len(tried)))
            tried.append(TriedPair(apart, 0, trials[-1].resolved))
        found, _ = stated_px(tried)
        about, wide = (found, 1.3) if found is not None else (1.5 * about, wide)
    if found is not None:
        trials.append(try_one(found, 0))
    return trials, found


def stated_px(tried: Sequence[TriedPair]) -> tuple[float | None, float | None]:
    """Return the distance stated by a logistic curve in the logarithm of the distance, along y and x.

    The middle of the distances at which it has :data:`PROMISED`, and at ``NEARER`` of which
    :data:`AT_NEARER` at most; the nearest with the first where none has both. Both axes share its slope.
    Never below the smallest distance tried; None where no pair of an axis was told apart, or none beyond.
    """
    from scipy.optimize import minimize  # late: importing recon stays light

    logs = np.log([one.px for one in tried])
    axes = np.array([one.axis for one in tried])
    told = np.array([one.told for one in tried])
    if not told.any():
        return None, None
    centre = float(logs.mean())

    def misfit(p: Float64Array) -> float:
        z = np.exp(p[0]) * (logs - centre - p[1 + axes])
        # A slope of ten to forty in log distance is usual; pairs told apart by luck do not flatten it.
        return float(
            np.logaddexp(0.0, np.where(told, -z, z)).sum() + 0.5 * ((p[0] - np.log(20.0)) / 0.5) ** 2
        )

    slope, *middles = minimize(misfit, np.array([np.log(20.0), 0.0, 0.0]), method="Nelder-Mead").x
    nearest, farthest = (np.log(share / (1 - share)) / np.exp(slope) for share in (PROMISED, AT_NEARER))
    beyond = (nearest + max(farthest - np.log(NEARER), nearest)) / 2
    stated = [float(np.exp(centre + middle + beyond)) for middle in middles]
    least, most = min(one.px for one in tried), max(one.px for one in tried)
    y, x = (max(px, least) if px <= most and axis in axes else None for axis, px in enumerate(stated))
    return y, x
