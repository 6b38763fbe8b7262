"""Fluorescence over time (Kuo 2020, Sec. 6.4): fading, the baseline and the change relative to it."""

from __future__ import annotations

import numpy as np

from recon.arrays import Array, Float32Array, Float64Array
from recon.errors import InputError

PERCENTILE = 20.0
"""Of a pixel's values that its baseline is (Kuo 2020, Fig. 6.5)."""
FLOOR_SHARE = 0.1
"""Least baseline that a change is divided by, relative to how bright light is: where there is next to
nothing, a relative change means nothing."""
SURE = 3.0
"""Standard errors from which a fading is one."""
LEAST_FRAMES = 30
"""Fewer cannot tell what lasts from what merely varies."""
MOST_COMPARED = 500
"""Frames whose light is compared, each with each, to find how it fades; of longer videos every so many."""

_ANCHORS_A_WINDOW = 4


def fading(frames: Float32Array) -> Float64Array:
    """Return how the whole field's light fades, relative to the first frame, (n_frames,): an exponential.

    Its rate is the median slope of the logarithm of a frame's light between any two frames (Sen 1968):
    activity, which comes and goes, does not tell on it; a step that stays does in part. What bleaches
    otherwise than the whole is left to the sliding baseline. A slope within three standard errors, by the
    scatter about it, is none.

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
    error = float(np.std(level - slope * at) / (np.sqrt(len(at)) * at.std()))
    relative: Float64Array = np.exp(slope * (abs(slope) > SURE * error) * np.arange(len(frames)))
    return relative


def baseline(
    frames: Float32Array,
    window: int,
    percentile: float = PERCENTILE,
    fade: Float64Array | None = None,
) -> Float32Array:
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


def smoothed(frames: Float32Array, deviation_px: float) -> Float32Array:
    """Return frames (n_frames, height, width) smoothed by a Gaussian, which weighs a cell's light together.

    A cell that a reconstruction shows in one or two pixels hops among them as it sways: neighbours do not
    brighten together, their sum does.
    """
    from scipy.ndimage import gaussian_filter

    result = np.empty_like(frames)
    for frame, smooth in zip(frames, result, strict=True):
        gaussian_filter(frame, deviation_px, output=smooth)
    return result


def brightness(image: Float32Array) -> float:
    """Return the value above which half of an image's light lies; empty space around it changes nothing."""
    values = np.sort(np.maximum(image, 0), axis=None)[::-1]
    light = np.cumsum(values, dtype=np.float64)
    return float(values[np.searchsorted(light, light[-1] / 2)])


def floor_of(frames: Float32Array) -> float:
    """Return the least baseline that a change is divided by: a tenth of how bright the pictures' light is.

    Raises InputError when the pictures, (n_frames, height, width), hold no light.
    """
    floor = FLOOR_SHARE * brightness(frames.mean(axis=0))
    if not floor > 0:
        raise InputError("The video is dark: it holds no light anywhere.")
    return floor


def change(frames: Float32Array, base: Float32Array, floor: float) -> Float32Array:
    """Return dF/F, ``(F - F0) / max(F0, floor)``; the floor keeps what hardly shines from looking active.

    Parameters
    ----------
    frames, base : ndarray, (n_frames, height, width)
    floor : float
        Of :func:`floor_of`.
    """
    return ((frames - base) / np.maximum(base, np.float32(floor))).astype(np.float32)
