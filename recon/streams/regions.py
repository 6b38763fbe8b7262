"""Regions that are active together: by how a pixel's time course resembles that of its neighbours.

Camera noise is independent from pixel to pixel, so that the correlation of neighbours shows where something
happens, whatever its brightness (local correlation image). Pixels around each of its peaks that follow the
peak's time course make up a region. A reconstruction's noise is not independent: a prior on differences makes
it flat in patches, whose pixels go together. But it flickers from frame to frame where activity lasts, and
that tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.errors import InputError

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]


LASTING = 0.6
"""Mean squared step from frame to frame relative to the variance (von Neumann's ratio) below which a course
is activity that lasts. White noise has 2; patches of reconstructed noise 1.6 in the median and 0.7 at the
first percentile; transients of half a second at ten frames a second 0.3 to 0.5 (benchmarks/activity.py).
What lasts for one frame cannot be told from noise."""


@dataclass(frozen=True, slots=True)
class Region:
    """Pixels that are active together.

    Attributes
    ----------
    rows, columns : ndarray of int
        Its pixels.
    centre : (float, float)
        Row and column, weighted with the activity.
    correlation : float
        Local correlation at its peak.
    """

    rows: npt.NDArray[np.intp]
    columns: npt.NDArray[np.intp]
    centre: tuple[float, float]
    correlation: float

    def trace(self, frames: Floats) -> Floats:
        """Return the mean over the region of each frame, (n_frames,)."""
        trace: Floats = frames[:, self.rows, self.columns].mean(axis=1, dtype=np.float64).astype(np.float32)
        return trace


def local_correlation(frames: Floats) -> Floats:
    """Return each pixel's mean correlation over time with its eight neighbours, (height, width).

    Parameters
    ----------
    frames : ndarray, (n_frames, height, width)
        Of dF/F, or of fluorescence less its baseline.
    """
    if len(frames) < 3:
        raise InputError(f"Correlation over time needs three frames at least, not {len(frames)}.")
    courses = frames - frames.mean(axis=0)
    norm = np.sqrt(np.sum(courses.astype(np.float64) ** 2, axis=0))
    courses = (courses / np.where(norm > 0, norm, 1)).astype(np.float32)
    height, width = norm.shape
    total, count = np.zeros(norm.shape), np.zeros(norm.shape)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = np.s_[: height - dy, max(0, -dx) : width - max(0, dx)]
        there = np.s_[dy:, max(0, dx) : width - max(0, -dx)]
        product = np.einsum("tyx,tyx->yx", courses[:, *here], courses[:, *there])
        for part in (here, there):
            total[part] += product
            count[part] += 1
    return (total / np.maximum(count, 1)).astype(np.float32)


def lasts(course: Array) -> bool:
    """Whether a course over time is activity that lasts longer than a frame, (n_frames,)."""
    variance = float(np.var(course))
    return variance > 0 and float(np.mean(np.diff(course) ** 2)) < LASTING * variance


def find_regions(
    frames: Floats,
    *,
    least_correlation: float = 0.5,
    radius_px: float = 8.0,
    least_pixels: int = 4,
    alike: float = 0.7,
    at_most: int = 200,
) -> list[Region]:
    """Find regions, the most correlated first.

    Parameters
    ----------
    frames : ndarray, (n_frames, height, width)
        As :func:`local_correlation`.
    least_correlation : float
        Of a peak.
    radius_px : float
        As far from its peak as a region reaches.
    least_pixels : int
        Fewer are taken for noise.
    alike : float
        Correlation of a pixel's course with that of the region's core from which it belongs to it.
    at_most : int
    """
    from scipy import ndimage

    correlation = local_correlation(frames)
    height, width = correlation.shape
    courses = frames - frames.mean(axis=0)
    norm = np.sqrt(np.sum(courses.astype(np.float64) ** 2, axis=0))
    free = norm > 0
    peaks = (ndimage.maximum_filter(correlation, 3) == correlation) & (correlation >= least_correlation)
    places = np.argwhere(peaks)
    order = np.argsort(-correlation[peaks], kind="stable")
    regions: list[Region] = []
    for row, column in places[order]:
        if not free[row, column] or len(regions) == at_most:
            continue
        reach = int(radius_px)
        box = np.s_[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        y, x = np.ogrid[box[0].start : min(box[0].stop, height), box[1].start : min(box[1].stop, width)]
        core = courses[:, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].mean(axis=(1, 2))
        size = float(np.linalg.norm(core))
        if size == 0:
            continue
        likeness = np.einsum("t,tyx->yx", core / size, courses[:, *box]) / np.where(
            norm[box] > 0, norm[box], 1
        )
        belongs = (likeness >= alike) & free[box] & (np.hypot(y - row, x - column) <= radius_px)
        labels, _ = ndimage.label(belongs)
        own = labels[row - box[0].start, column - box[1].start]
        if own == 0:
            continue
        mask = labels == own
        if int(mask.sum()) < least_pixels:
            continue
        rows, columns = np.nonzero(mask)
        rows, columns = rows + box[0].start, columns + box[1].start
        if not lasts(frames[:, rows, columns].mean(axis=1, dtype=np.float64)):
            free[rows, columns] = False
            continue
        weight = norm[rows, columns]
        centre = (float(np.average(rows, weights=weight)), float(np.average(columns, weights=weight)))
        free[rows, columns] = False
        # Its halo is not another region.
        free[box] &= ~((likeness >= alike) & (np.hypot(y - row, x - column) <= radius_px))
        regions.append(Region(rows, columns, centre, float(correlation[row, column])))
    return regions
