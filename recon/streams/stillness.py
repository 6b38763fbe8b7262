"""Whether a video's frames hold light, and whether its scene stands still, told from the frames alone.

Camera noise is white, whether it comes from photons or from reading: the mean of ``s x s`` pixels of it has
``1 / s^2`` of the variance. What a moved scene changes is not: caustics are several pixels wide. The variance
of block means of a difference of frames, relative to what white noise would leave of it, is 1 while nothing
moves and grows from there, without a threshold in counts.
"""

from __future__ import annotations

import enum

import numpy as np

from recon.arrays import Array
from recon.base.blocks import block_mean
from recon.base.noise import estimate_deviation

BLOCKS = (2, 4, 8)
"""Sides of the blocks, pixels, each twice the one before: caustics are about as wide."""
LEAST_RATIO = 1.4
"""Block variance over that of white noise from which the scene is taken to have changed, where there are many
blocks; few make the ratio itself uncertain, and five deviations of that are allowed for."""
NEW_SCENE = 0.5
"""Share of a frame's variance that changed, from which nothing of the scene before helps. Measured: with a
picture panning by 3 x 6 pixels a frame (a share of about 0.3) a warm start is still as good as a cold one."""


LIT_BLOCKS = (8, 16, 32)
"""Pixels along a side over which light is averaged to tell it from noise: dim scenes show in large ones."""
LIT = 2.0
"""Variance of block means from which a frame has light, in units of what its pixels' noise makes of it."""


def has_light(frame: Array, deviation: Array) -> bool:
    """Tell whether there is more in a frame than noise.

    Noise of single pixels goes away where pixels are averaged, a scene through a diffuser does not: the
    variance of the means of 8 x 8 to 32 x 32 pixels is compared with what noise leaves of it. Noise grows
    with light: a frame dimmer than the one that ``deviation`` was found on has less, which it tells itself.

    Parameters
    ----------
    frame : ndarray, (height, width) or (height, width, n_channels)
        Counts less dark.
    deviation : ndarray, (n_channels,)
        Of the noise, counts; that of another frame of the same camera is enough.
    """
    channels = frame[None] if frame.ndim == 2 else np.moveaxis(frame, 2, 0)
    if min(channels.shape[1:]) < 2 * LIT_BLOCKS[0]:
        return True  # too few blocks to tell
    spreads = [_spread(channels, side) for side in LIT_BLOCKS if min(channels.shape[1:]) >= 2 * side]
    if _beyond_noise(spreads, np.asarray(deviation, np.float64).reshape(-1)):
        return True
    own = np.array([estimate_deviation(channel) for channel in channels])
    # 0 is no estimate: most pixels are alike.
    return _beyond_noise(spreads, np.where(own > 0, own, np.inf))


def _spread(channels: Array, side: int) -> tuple[int, Array]:
    """Return how many blocks there are, and the variance of their means if their pixels were independent."""
    means = block_mean(channels, side, dtype=np.float64)
    return means[0].size, means.var(axis=(1, 2)) * side**2


def _beyond_noise(spreads: list[tuple[int, Array]], deviation: Array) -> bool:
    return any((spread > _beyond_chance(LIT, n) * deviation**2).any() for n, spread in spreads)


class SceneState(enum.StrEnum):
    """How a frame's scene relates to those before."""

    NEW = "new"
    """Another scene, or the first."""
    MOVING = "moving"
    """The scene of before, changed."""
    STILL = "still"
    """As before, within the noise."""


def _beyond_chance(ratio: float, blocks: int) -> float:
    """Return the ratio of variances that counts: few blocks make it uncertain by itself."""
    return max(ratio, 1 + 5 * float(np.sqrt(2 / blocks)))


LARGEST_GAIN = 2.0
"""Factor by which the light may change at once and still be the same scene in another light."""


class SceneWatch:
    """Compares each frame with the mean of those since the scene last changed, and keeps that mean.

    Frames may come in another brightness: the factor between their sums is taken out.

    Parameters
    ----------
    average : int
        Frames that the mean reaches back, at most: a change too small to be seen in one is not held back for
        longer than these.

    Attributes
    ----------
    mean : ndarray, float32, (n_channels, height, width)
        Of the frames since the scene changed; the frame itself while it moves.
    count : int
        Frames in it.
    """

    def __init__(self, average: int = 8) -> None:
        if average < 1:
            raise ValueError(f"average must be 1 or more, not {average}.")
        self.average = average
        self.mean: Array = np.empty(0, np.float32)
        self.count = 0

    def see(self, frame: Array) -> SceneState:
        """Take note of the next frame, (n_channels, height, width), float32.

        Raises ValueError for a frame without pixels.
        """
        if frame.size == 0:
            raise ValueError(f"a frame has pixels; this one is {frame.shape}.")
        if self.count == 0 or self.mean.shape != frame.shape:
            self._begin(frame)
            return SceneState.NEW
        change = frame - self._gain(frame) * self.mean
        variance = float(np.vdot(change, change)) / change.size
        if not np.isfinite(variance):  # the mean is spoilt, or the frame: neither may reach those to come
            self._begin(frame)
            if not np.isfinite(frame).all():
                self.forget()
            return SceneState.NEW
        if self._is_white(change, variance):
            self.count = min(self.count + 1, self.average)
            self.mean += (frame - self.mean) / np.float32(self.count)
            return SceneState.STILL
        whole = float(np.var(frame, dtype=np.float64))
        self._begin(frame)
        return SceneState.NEW if variance > NEW_SCENE * whole else SceneState.MOVING

    def forget(self) -> None:
        """Take the next frame for that of a new scene."""
        self.count = 0

    def _begin(self, frame: Array) -> None:
        self.mean = frame.copy()
        self.count = 1

    def _gain(self, frame: Array) -> np.float32:
        # Of the sums: a regression would be drawn towards zero by the noise in the mean.
        before = float(np.sum(self.mean, dtype=np.float64))
        gain = float(np.sum(frame, dtype=np.float64)) / before if before > 0 else 1.0
        return np.float32(np.clip(gain, 1 / LARGEST_GAIN, LARGEST_GAIN))

    @staticmethod
    def _is_white(change: Array, variance: float) -> bool:
        if variance == 0:
            return True
        blocks = change
        for side in BLOCKS:
            if min(blocks.shape[1:]) < 2:
                break
            blocks = block_mean(blocks, 2)
            ratio = side**2 * float(np.vdot(blocks, blocks)) / blocks.size / variance
            if ratio > _beyond_chance(LEAST_RATIO, blocks.size):
                return False
        return True
