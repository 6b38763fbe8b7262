"""Points lost or made up: whether the peaks of a reconstruction are where the true points are.

Points on their own are judged one by one: each has a peak within reach or is lost, and a peak far from every
point is made up. Where points are crowded too few are on their own for a share of a tenth to be told, and
peaks so many that one lies within reach of any place. There three things differ:

* A point is asked for where its neighbours are farther than the nominal resolution, and where the truth
  itself, put through the same search for peaks, shows it: no method separates what is nearer, and no method
  shows on this grid what the truth on it does not.
* Of the places that are as far from all points as those that are asked for are from the others, a share ``c``
  has a peak within reach. Were a share ``q`` of the points truly lost, a point would have no peak with the
  probability ``q (1 - c)``: the share without one is divided by ``1 - c``. So a reconstruction that has
  nothing to do with the points loses all of them, however many of its peaks lie near one.
* Likewise with peaks that are near no point: a share ``v`` of all places is, so the share of peaks there is
  divided by ``v``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]
Chosen = npt.NDArray[np.bool_]

LOST_SHARE = 0.1
REACH_PX = 1.5
APART_PX = 5.0
"""Nearer points need not be told apart to be found, where enough others are on their own."""
ENOUGH = round(1 / LOST_SHARE)
"""With fewer points a single one that is lost exceeds the share. Half of all are enough, too: a scene of few
points has no others."""
PEAK_SHARE = 0.25
"""A peak counts from this share of the median height at the true points."""
SMOOTHING_PX = 0.7
"""A point between pixels is shared by up to four: smooth before peaks are looked for."""


def spot_severity(
    found: Image,
    truth: Image,
    places: Floats,
    *,
    resolved_px: float,
    reach_planes: float = REACH_PX,
) -> float:
    """Return the larger share of points lost and of peaks made up, over :data:`LOST_SHARE`; not bounded.

    Parameters
    ----------
    found, truth : ndarray, (n_z, height, width)
        The truth on the same grid is looked at where points are crowded.
    places : ndarray, (n, 3)
        True points: plane, row, column. Those off the grid do not count.
    resolved_px : float
        Nominal resolution across, pixels.
    reach_planes : float
        Planes by which a peak may be off: the axial resolution, where that is more than the lateral reach.

    Returns
    -------
    float
        0 also where no point can be asked for.
    """
    # In depth as across: a reach is a reach.
    scale = np.array([REACH_PX / reach_planes, 1.0, 1.0])
    inside = ((places > -0.5) & (places < np.array(found.shape) - 0.5)).all(axis=1)
    peaks, heights = _peaks(found)
    if not len(peaks):
        return 1 / LOST_SHARE
    alone = inside & _apart(places, APART_PX, np.inf)
    if alone.sum() >= min(ENOUGH, inside.sum() / 2):
        return _on_their_own(peaks * scale, heights, places * scale, alone)
    asked = inside & _apart(places, resolved_px, reach_planes)
    at, height = _peaks(truth)
    nearest = _highest_within_reach(at * scale, height, places * scale)
    asked &= (nearest > 0) & (nearest >= _least(nearest, asked))
    if not asked.any():
        return 0.0
    field = _field(places[inside])
    nominal = np.array([resolved_px / reach_planes, 1.0, 1.0])
    clear = _distance(field * nominal, places * nominal) > resolved_px
    return _crowded(peaks * scale, heights, places * scale, asked, field * scale, clear)


def _on_their_own(peaks: Floats, heights: Floats, places: Floats, asked: Chosen) -> float:
    if not asked.any():
        return 0.0
    nearest = _highest_within_reach(peaks, heights, places)
    least = _least(nearest, asked)
    high = peaks[heights >= least]
    if least <= 0 or not len(high):
        return 1 / LOST_SHARE
    lost = float(np.mean(nearest[asked] < least))
    made_up = float(np.mean(_distance(high, places) > 2 * REACH_PX))
    return max(lost, made_up) / LOST_SHARE


def _crowded(
    peaks: Floats, heights: Floats, places: Floats, asked: Chosen, field: Floats, clear: Chosen
) -> float:
    """Return the same where points are crowded, less what chance would give.

    ``field`` are all places, and ``clear`` those among them at which a point could have been asked for.
    """
    nearest = _highest_within_reach(peaks, heights, places)
    least = _least(nearest, asked)
    high = peaks[heights >= least]
    if least <= 0 or not len(high):
        return 1 / LOST_SHARE
    by_chance = float(np.mean(_distance(field[clear] if clear.any() else field, high) <= REACH_PX))
    empty = float(np.mean(_distance(field, places) > REACH_PX))
    lost = float(np.mean(nearest[asked] < least))
    made_up = float(np.mean(_distance(high, places) > REACH_PX))
    # Where peaks are everywhere it proves nothing that points have one.
    lost = lost / (1 - by_chance) if by_chance < 1 else 1.0
    return max(lost, made_up / empty if empty > 0 else 0.0) / LOST_SHARE


def _peaks(image: Image) -> tuple[Floats, Floats]:
    """Return places (n, 3) and heights of the local maxima."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    smooth = gaussian_filter(np.asarray(image, np.float64), SMOOTHING_PX)
    at = np.argwhere((smooth == maximum_filter(smooth, 3)) & (smooth > 0))
    return at.astype(np.float64), smooth[tuple(at.T)]


def _highest_within_reach(peaks: Floats, heights: Floats, places: Floats) -> Floats:
    """Return the height of every place's highest peak within reach; 0 for none."""
    distance = np.abs(places[:, None, :] - peaks[None]).max(axis=2)
    return np.asarray(np.where(distance <= REACH_PX, heights[None], 0).max(axis=1))


def _least(nearest: Floats, asked: Chosen) -> float:
    """Return the height from which a peak counts; 0 where most points have none."""
    return PEAK_SHARE * float(np.median(nearest[asked])) if asked.any() else 0.0


def _distance(places: Floats, others: Floats) -> Floats:
    """Return the distance of every place from the nearest of the others, the largest along any axis."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(others).query(places, p=np.inf)
    return np.asarray(distance)


def _field(places: Floats) -> Floats:
    """Return the voxels, (n, 3), of the box that holds all points."""
    low, high = np.floor(places.min(axis=0)), np.ceil(places.max(axis=0))
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _apart(places: Floats, across_px: float, planes: float) -> Chosen:
    """Points without another one nearer than both distances."""
    if len(places) < 2:
        return np.ones(len(places), bool)
    between = np.abs(places[:, None] - places[None])
    across = between[..., 1:].max(axis=2)
    np.fill_diagonal(across, np.inf)
    return np.asarray(~((across <= across_px) & (between[..., 0] <= planes)).any(axis=1))
