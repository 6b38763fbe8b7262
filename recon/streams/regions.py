"""Regions of a video whose pixels are active together, and what tells them from noise and motion.

Regions are found by how a pixel's time course resembles that of its neighbours. Camera noise is independent
from pixel to pixel, so that the correlation of neighbours shows where something happens, whatever its
brightness (local correlation image). Pixels around each of its peaks that follow the peak's time course make
up a candidate. What else makes neighbours go together tells itself:

* A reconstruction's noise is flat in patches, but flickers from frame to frame where activity lasts.
* Pictures of a scene that stands settle from the first frame of each of their blocks on: by less than the
  noise of bright places.
* What moves past changes neighbours one after the other, and dims one where it brightens the other. Activity
  has one course, by which all pixels about it brighten, if at all.
* A lamp, or the edge of a sheet, changes everything around as well.
* In frames that move, what follows the motion is motion.
* Beyond the outermost of PSFs that vary over the field nobody knows the PSF: light that is put there is what
  the camera's model does not explain.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float32Array, Float64Array
from recon.errors import InputError
from recon.streams.activity import brightness
from recon.streams.motion import Motion

LASTING = 0.6
"""Mean squared step from frame to frame relative to the variance (von Neumann's ratio) below which a course
is activity that lasts. White noise has 2; patches of reconstructed noise 1.6 in the median and 0.7 at the
first percentile; transients of half a second at ten frames a second 0.3 to 0.5 (benchmarks/activity.py).
What lasts for one frame cannot be told from noise."""
APART = 3
"""Frames between two by which what is left of one frame's noise in the next is gone: of a film by 4 warm
iterations a frame, away from its cells, noise is 1.9, 2.5, 2.7, 2.6 (1e-5) at 1 to 4 frames."""
PASSING = 0.2
"""What follows or precedes a region's course around it, relative to what goes with it, from which it is
something that moves past. Neurons have 0.00 to 0.13, those 6 pixels (three of their radii) apart 0.02 to
0.22; textured sheets that move by 0.03 to 1 pixel a frame 0.23 and more
(benchmarks/activity.py --nothing)."""
BESIDE_PX = 2.5
"""So far around a region of round shape is looked for what passes."""
LAGS = (1, 3, 5, 8, 12)
"""Frames by which that may be earlier or later, at most an eighth of all."""
LIKE_AROUND, HALF_AROUND = 0.5, 0.5
"""Correlation with a region's course, and share of the pixels at the largest radius that have it, from which
it is no place of its own. Of neurons none has it, of the edge of a sheet 0.53 and more."""
FOLLOWED = 0.5
"""Share of a course that the motion of the frames explains from which it is motion."""
ALIKE = 0.7
"""Correlation of a pixel's course with that of a region's core from which it belongs to it."""
LEAST_PIXELS = 4
"""Fewer that go together are taken for noise."""
AT_MOST = 200
"""Regions."""


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

    def trace(self, frames: Float32Array) -> Float32Array:
        """Return the mean over the region of each frame, (n_frames,)."""
        trace: Float32Array = (
            frames[:, self.rows, self.columns].mean(axis=1, dtype=np.float64).astype(np.float32)
        )
        return trace


def local_correlation(frames: Float32Array) -> Float32Array:
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


def _courses(frames: Float32Array) -> tuple[Float32Array, Array]:
    """Return each pixel's course over time less its mean, and the courses' norms."""
    courses = frames - frames.mean(axis=0)
    return courses, np.sqrt(np.sum(courses.astype(np.float64) ** 2, axis=0))


@dataclass(frozen=True, slots=True)
class Search:
    """What was found where neighbours go together."""

    regions: list[Region]
    """The most correlated first."""
    left_out: dict[str, int]
    """What the other places are, in words, and how many."""
    correlation: Float32Array
    """(height, width): of :func:`local_correlation`."""


FLICKERS = "flicker as noise does"
WEAK = "change by no more than the noise of bright places"
PASSES = "change as what moves past does"
WIDE = "change together with everything around"
FOLLOWS = "follow the motion of the frames"
BEYOND = "lie beyond the outermost calibration points"

Box = tuple[float, float, float, float]
"""Top, left, bottom and right of a part of the picture, pixels."""


def lasts(course: Array) -> bool:
    """Whether a course over time is activity that lasts longer than a frame, (n_frames,)."""
    variance = float(np.var(course))
    return variance > 0 and float(np.mean(np.diff(course) ** 2)) < LASTING * variance


def _own(change: Array) -> Array:
    """Return a change less what the whole field does: light that comes and goes is no noise."""
    return np.asarray(change - np.median(change))


def noise_of(frames: Float32Array) -> float:
    """Return the noise of frames, deviation of means of 3 x 3 pixels, where half of the light is.

    A prior or a bound at zero hides it where it is dark: a speckle there is noise all the same. Where
    frames are solved each from the one before, noise lasts: how much more of it there is between frames
    ``APART`` apart tells the rest of the field, where less is active.

    Parameters
    ----------
    frames : ndarray, (n_frames, height, width)
        Of fluorescence.
    """
    from scipy.ndimage import uniform_filter

    light: Array = np.zeros(frames.shape[1:])
    steps, apart = np.zeros_like(light), np.zeros_like(light)
    before: deque[Float32Array] = deque(maxlen=APART)
    for frame in frames:
        smooth = uniform_filter(frame, 3)
        if before:
            steps += np.square(_own(smooth - before[-1]))
        if len(before) == APART:
            apart += np.square(_own(smooth - before[0]))
        light += smooth
        before.append(smooth)
    bright = light >= brightness(light)
    variance = float(np.median(steps[bright])) / (2 * max(len(frames) - 1, 1))
    rest = ~bright & (steps > 0)
    if len(frames) > APART and rest.any():
        lasting = (
            float(np.median(apart[rest]) / np.median(steps[rest])) * (len(frames) - 1) / (len(frames) - APART)
        )
        variance *= max(lasting, 1.0)
    return float(np.sqrt(variance))


def find_regions(
    frames: Float32Array,
    *,
    least_correlation: float = 0.5,
    radius_px: float = 8.0,
    noise: float = 0.0,
    moved: Motion | None = None,
    field: Box | None = None,
) -> Search:
    """Find regions: places where neighbours go together, and nothing but activity explains it.

    Parameters
    ----------
    frames : ndarray, (n_frames, height, width)
        Fluorescence less its baseline.
    least_correlation : float
        Of a peak.
    radius_px : float
        As far from its peak as a region reaches.
    noise : float
        As of :func:`noise_of` the fluorescence.
    moved : Motion, optional
        Of frames that are not still, whether they were moved back or not: what follows it, and what it
        brings in at the borders, is no region.
    field : (top, left, bottom, right), optional
        Pixels between the outermost calibration points, where PSFs vary over the field.
    """
    from scipy import ndimage

    correlation = local_correlation(frames)
    height, width = correlation.shape
    courses, norm = _courses(frames)
    free = norm > 0
    if moved is not None:
        free &= _always_seen(free.shape, moved)
    peaks = (
        free & (ndimage.maximum_filter(correlation, 3) == correlation) & (correlation >= least_correlation)
    )
    places = np.argwhere(peaks)
    order = np.argsort(-correlation[peaks], kind="stable")
    regions: list[Region] = []
    left_out: Counter[str] = Counter()
    reach = int(radius_px) + 2
    for row, column in places[order]:
        if not free[row, column] or len(regions) == AT_MOST:
            continue
        box = np.s_[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        y, x = np.ogrid[box[0].start : min(box[0].stop, height), box[1].start : min(box[1].stop, width)]
        core = courses[:, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].mean(axis=(1, 2))
        around = _Around(courses[:, *box], norm[box], np.hypot(y - row, x - column))
        likeness = around.likeness(core)
        near = (likeness >= ALIKE) & (around.distance <= radius_px)
        labels, _ = ndimage.label(near & free[box])
        own = labels[row - box[0].start, column - box[1].start]
        mask = labels == own
        if own == 0 or int(mask.sum()) < LEAST_PIXELS:
            continue
        rows, columns = (places + side.start for places, side in zip(np.nonzero(mask), box, strict=True))
        free[rows, columns] = False
        weight = norm[rows, columns]
        centre = (float(np.average(rows, weights=weight)), float(np.average(columns, weights=weight)))
        if why := _not_active(around, mask, radius_px, noise, moved) or _beyond(centre, field):
            left_out[why] += 1
            continue
        free[box] &= ~near  # its halo is not another region
        regions.append(Region(rows, columns, centre, float(correlation[row, column])))
    return Search(regions, dict(left_out), correlation)


@dataclass(frozen=True, slots=True)
class _Around:
    """A candidate's surroundings."""

    courses: Float32Array
    """(n_frames, rows, columns): less their means."""
    norm: Array
    """(rows, columns): of the courses."""
    distance: Array
    """(rows, columns): from the candidate's peak, pixels."""

    def likeness(self, course: Array) -> Array:
        """Return the correlation of each pixel's course with one."""
        size = float(np.linalg.norm(course)) or 1.0
        product: Array = np.einsum("t,tyx->yx", course / size, self.courses)
        return product / np.where(self.norm > 0, self.norm, 1)

    def passing(self, mask: Array, course: Array) -> float:
        """Return what follows or precedes a candidate's course around it, relative to what goes with it.

        Taken off before is what brightens with it; a neighbour's course of its own is neither.
        """
        reach = float(np.sqrt(mask.sum() / np.pi)) + BESIDE_PX
        near = self.courses[:, mask | (self.distance <= reach)]
        with_it = np.maximum(course @ near / (course @ course), 0)
        rest = near - np.multiply.outer(course, with_it)
        lags = [lag for lag in LAGS if lag <= len(course) // 8]
        others = np.stack(
            [course, *(np.roll(course, sign * lag) for lag in lags for sign in (1, -1))], axis=1
        )
        base = np.linalg.qr(others - others.mean(axis=0))[0]
        own = float(_lasting(course)) * len(course) * float(with_it @ with_it)
        return float(np.sum(np.square(base.T @ rest))) / own if own > 0 else np.inf


def _not_active(
    around: _Around, mask: Array, radius_px: float, noise: float, moved: Motion | None
) -> str | None:
    """Return what a candidate is, if it is not active."""
    course = around.courses[:, mask].mean(axis=1, dtype=np.float64)
    if not lasts(course):
        return FLICKERS
    if float(course.std()) <= noise:
        return WEAK
    if moved is not None and _explained(course, moved.shifts) > FOLLOWED:
        return FOLLOWS
    rim = np.abs(around.distance - radius_px) < 1
    if float(np.mean(around.likeness(course)[rim] >= LIKE_AROUND)) >= HALF_AROUND:
        return WIDE
    return PASSES if around.passing(mask, course) > PASSING else None


def _beyond(centre: tuple[float, float], field: Box | None) -> str | None:
    """Return what a region is, if no PSF was measured about it."""
    if field is None:
        return None
    top, left, bottom, right = field
    return None if top <= centre[0] <= bottom and left <= centre[1] <= right else BEYOND


def _lasting(courses: Array) -> Array:
    """Return courses' variance less that of white noise, by the steps from frame to frame; not below 0."""
    rest: Array = courses.var(axis=0) - 0.5 * np.mean(np.diff(courses, axis=0) ** 2, axis=0)
    return np.maximum(rest, 0)


def _explained(course: Array, shifts: Float64Array) -> float:
    """Return the share of a course's variance that shifts explain, to the second order."""
    down, across = shifts.T
    terms = np.stack([down, across, down**2, across**2, down * across], axis=1)
    terms -= terms.mean(axis=0)
    fitted = terms @ np.linalg.lstsq(terms, course, rcond=None)[0]
    return float(fitted @ fitted) / float(course @ course)


def _always_seen(shape: tuple[int, ...], moved: Motion) -> BoolArray:
    """Return which pixels no frame has at a border, or beyond."""
    seen = np.zeros(shape, bool)
    down, across = (int(np.ceil(most)) + 1 for most in np.abs(moved.shifts).max(axis=0))
    seen[down : shape[0] - down, across : shape[1] - across] = True
    return seen
