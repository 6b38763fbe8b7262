"""Fluorescence over time (Kuo 2020, Sec. 6.4): motion, the baseline, the change, and what is active together.

Regions are found by how a pixel's time course resembles that of its neighbours. Camera noise is independent
from pixel to pixel, so that the correlation of neighbours shows where something happens, whatever its
brightness (local correlation image). Pixels around each of its peaks that follow the peak's time course make
up a region. A reconstruction's noise is not independent: a prior on differences makes it flat in patches,
whose pixels go together. But it flickers from frame to frame where activity lasts, and that tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.errors import InputError

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

PERCENTILE = 20.0
"""Of a pixel's values that its baseline is (Kuo 2020, Fig. 6.5)."""
FLOOR_SHARE = 0.1
"""Least baseline that a change is divided by, relative to the bright part of the picture: where there is
next to nothing, a relative change means nothing."""
BRIGHT_PERCENTILE = 99.9
LEAST_FRAMES = 30
"""Fewer cannot tell what lasts from what merely varies."""
MOST_COMPARED = 500
"""Frames whose light is compared, each with each, to find how it fades; of longer videos every so many."""

_ANCHORS_A_WINDOW = 4


@dataclass(frozen=True, slots=True)
class Motion:
    """How far each frame lies off the mean of all, less the median frame."""

    shifts: npt.NDArray[np.float64]
    """(n_frames, 2): rows and columns, pixels."""
    largest_px: float
    """Of the frames' distances from their median place."""

    @property
    def is_still(self) -> bool:
        """Whether dF/F of a pixel means the same place throughout: no frame is off by half a pixel."""
        return self.largest_px < 0.5


def motion(frames: Floats) -> Motion:
    """Register each frame to the mean of all, by cross-correlation refined to a fraction of a pixel.

    Means are taken off and edges faded out (Hann window); spectra are not whitened, so that what is bright
    counts most: a cell that is much brighter than all the rest tells the motion by itself.

    Parameters
    ----------
    frames : ndarray, (n_frames, height, width)
    """
    reference = np.mean(frames, axis=0)
    window = np.outer(np.hanning(frames.shape[1]), np.hanning(frames.shape[2]))
    spectrum = np.fft.rfft2((reference - reference.mean()) * window)
    shifts = np.array([_shift(frame, window, spectrum) for frame in frames])
    shifts -= np.median(shifts, axis=0)
    return Motion(shifts, float(np.hypot(*shifts.T).max(initial=0.0)))


def aligned(frames: Floats, found: Motion) -> Floats:
    """Return the frames moved back to their median place, cubic splines, float32."""
    from scipy import ndimage

    moved = np.empty(frames.shape, np.float32)
    for frame, shift, place in zip(frames, found.shifts, moved, strict=True):
        ndimage.shift(frame, -shift, output=place, order=3, mode="nearest")
    return moved


def _shift(frame: Floats, window: Array, reference: Array) -> tuple[float, float]:
    """Return rows and columns by which a frame lies off the reference, from the correlation's peak."""
    spectrum = np.fft.rfft2((frame - frame.mean()) * window)
    correlation = np.fft.irfft2(spectrum * np.conj(reference), s=window.shape)
    peak = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
    place = []
    for axis, n in enumerate(correlation.shape):
        index = list(peak)
        values = []
        for step in (-1, 0, 1):
            index[axis] = (peak[axis] + step) % n
            values.append(float(correlation[tuple(index)]))
        bend = values[0] - 2 * values[1] + values[2]
        offset = 0.5 * (values[0] - values[2]) / bend if bend < 0 else 0.0
        whole = int(peak[axis])
        place.append((whole - n if whole > n // 2 else whole) + float(np.clip(offset, -0.5, 0.5)))
    return place[0], place[1]


def fading(frames: Floats) -> npt.NDArray[np.float64]:
    """Return how the whole field's light fades, relative to the first frame, (n_frames,): an exponential.

    Its rate is the median slope of the logarithm of a frame's light between any two frames (Sen 1968):
    activity, which comes and goes, does not tell on it; a step that stays does in part. What bleaches
    otherwise than the whole is left to the sliding baseline.

    Parameters
    ----------
    frames : ndarray, (n_frames, height, width)
    """
    light: Array = np.asarray(np.mean(frames, axis=(1, 2), dtype=np.float64))
    at = np.arange(0, len(frames), max(-(-len(frames) // MOST_COMPARED), 1))
    at = at[light[at] > 0]
    if len(at) < 2:
        return np.ones(len(frames))
    first, later = np.triu_indices(len(at), 1)
    level = np.log(light[at])
    slope = float(np.median((level[later] - level[first]) / (at[later] - at[first])))
    relative: npt.NDArray[np.float64] = np.exp(slope * np.arange(len(frames)))
    return relative


def baseline(
    frames: Floats,
    window: int,
    percentile: float = PERCENTILE,
    fade: npt.NDArray[np.float64] | None = None,
) -> Floats:
    """Return each pixel's baseline F0: a sliding percentile, (n_frames, height, width), float32.

    The percentile is taken in windows centred on frames a quarter of a window apart and drawn linearly
    between them: it is smooth by nature, and this is many times faster. A window at the ends is as long as
    any other, shifted inwards.

    Parameters
    ----------
    frames : ndarray, (n_frames, height, width)
    window : int
        Frames that a baseline looks at. Much longer than activity.
    fade : ndarray, (n_frames,), optional
        As of :func:`fading`: taken out before the percentile and put back after. Without it, light that
        fades within a window pulls its percentile down, and the ends of the video up.
    """
    count = len(frames)
    if not 0 <= percentile <= 100:
        raise InputError(f"percentile must lie between 0 and 100, not {percentile:g}.")
    if window < 3:
        raise InputError(f"A baseline needs a window of at least 3 frames, not {window}.")
    window = min(window, count)
    step = max(window // _ANCHORS_A_WINDOW, 1)
    anchors = np.unique([*range(0, count, step), count - 1])
    levels = []
    for anchor in anchors:
        first = int(np.clip(anchor - window // 2, 0, count - window))
        part: Array = frames[first : first + window]
        if fade is not None:
            part = part / fade[first : first + window, None, None].astype(np.float32)
        levels.append(np.percentile(part, percentile, axis=0))
    # Where the shifted windows of the ends are centred, the level is their own.
    centres = np.clip(anchors, window // 2, count - window + window // 2)
    _, kept = np.unique(centres, return_index=True)
    known, where = np.stack(levels).astype(np.float32)[kept], centres[kept]
    result = np.empty(frames.shape, np.float32)
    for index in range(count):
        right = int(np.clip(np.searchsorted(where, index), 1, max(len(where) - 1, 1)))
        if len(where) == 1:
            result[index] = known[0]
            continue
        left = right - 1
        share = np.clip((index - where[left]) / (where[right] - where[left]), 0, 1)
        result[index] = (1 - share) * known[left] + share * known[right]
    if fade is not None:
        result *= fade.astype(np.float32)[:, None, None]
    return result


def floor_of(base: Floats) -> float:
    """Return the least baseline that a change is divided by: a tenth of the picture's bright part.

    Raises InputError when the baseline, (n_frames, height, width), is zero nearly everywhere.
    """
    floor = FLOOR_SHARE * float(np.percentile(base, BRIGHT_PERCENTILE))
    if not floor > 0:
        raise InputError("The video is dark: its baseline is zero nearly everywhere.")
    return floor


def change(frames: Floats, base: Floats, floor: float) -> Floats:
    """Return dF/F, ``(F - F0) / max(F0, floor)``; the floor keeps what hardly shines from looking active.

    Parameters
    ----------
    frames, base : ndarray, (n_frames, height, width)
    floor : float
        Of :func:`floor_of` the pictures' baseline.
    """
    return ((frames - base) / np.maximum(base, np.float32(floor))).astype(np.float32)


LASTING = 0.6
"""Mean squared step from frame to frame relative to the variance (von Neumann's ratio) below which a course
is activity that lasts. White noise has 2; patches of reconstructed noise 1.6 in the median and 0.7 at the
first percentile; transients of half a second at ten frames a second 0.3 to 0.5 (benchmarks/activity.py).
What lasts for one frame cannot be told from noise."""


@dataclass(frozen=True, slots=True)
class Region:
    """Pixels that are active together."""

    rows: npt.NDArray[np.intp]
    columns: npt.NDArray[np.intp]
    """``rows`` and ``columns``: its pixels."""
    centre: tuple[float, float]
    """Row and column, weighted with the activity."""
    correlation: float
    """Local correlation at its peak."""

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
    courses, norm = _courses(frames)
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


def _courses(frames: Floats) -> tuple[Floats, Array]:
    """Return each pixel's course over time less its mean, and the courses' norms."""
    courses = frames - frames.mean(axis=0)
    return courses, np.sqrt(np.sum(courses.astype(np.float64) ** 2, axis=0))


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
    """
    from scipy import ndimage

    correlation = local_correlation(frames)
    height, width = correlation.shape
    courses, norm = _courses(frames)
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
        near = (likeness >= alike) & (np.hypot(y - row, x - column) <= radius_px)
        labels, _ = ndimage.label(near & free[box])
        own = labels[row - box[0].start, column - box[1].start]
        mask = labels == own
        if own == 0 or int(mask.sum()) < least_pixels:
            continue
        rows, columns = (places + side.start for places, side in zip(np.nonzero(mask), box, strict=True))
        free[rows, columns] = False
        if not lasts(frames[:, rows, columns].mean(axis=1, dtype=np.float64)):
            continue
        weight = norm[rows, columns]
        centre = (float(np.average(rows, weights=weight)), float(np.average(columns, weights=weight)))
        free[box] &= ~near  # its halo is not another region
        regions.append(Region(rows, columns, centre, float(correlation[row, column])))
    return regions
