"""How far frames lie off one another as a whole: those of a recording, and a stream's from the one before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.arrays import Array, BoolArray, Float32Array, Float64Array
from recon.base.blocks import block_mean
from recon.solvers.moving import move

LEAST_PX = 0.05
"""A frame that lies off the one before by less is taken for still."""
EXPLAINED = 0.5
"""Share of the change between two frames, beyond noise, that moving one of them must take away for the scene
to have moved as a whole."""
FARTHER = 0.8
"""The same share where details have moved farther than they are wide: few lights that go on and off come to
0.5 at times."""
SMOOTHED = 0.3
"""Share of the noise of a difference that interpolation takes away at most: half a pixel along both axes."""
SHORT_SIDE, MOST_BINNED = 128, 4
"""Frames are registered on pixels binned to about this many along the short side, by this much at most: a
twentieth of a solver's iteration, and right to 0.04 pixels for half a pixel at 270 x 480."""
COARSER = 2
"""Binning of these on which a change is told from noise."""


class Panning:
    """Tells by how much a stream's frames move as a whole, each against the one before."""

    def __init__(self) -> None:
        self._before: tuple[Array, Array] | None = None

    def forget(self) -> None:
        """Take the next frame for the first."""
        self._before = None

    def next(self, frame: Array, valid: BoolArray) -> tuple[float, float]:
        """Return (rows, columns) by which a frame lies off the one before; zeros where that explains little.

        Parameters
        ----------
        frame : ndarray, (n_channels, height, width)
            In units of its noise.
        valid : ndarray of bool, as ``frame``
            Pixels that were measured: others take the mean.
        """
        if not valid.all():
            frame = np.where(valid, frame, frame.mean(axis=(1, 2), keepdims=True, where=valid))
        binning = int(np.clip(min(frame.shape[1:]) // SHORT_SIDE, 1, MOST_BINNED))
        image = block_mean(frame, binning, about_axis=True).sum(axis=0)
        window = _window(image)
        spectrum = _spectrum(image, window)
        before, self._before = self._before, (image, spectrum)
        if before is None or before[0].shape != image.shape or min(image.shape) < 2 * COARSER:
            return 0.0, 0.0  # of a few rows edges fade out all
        by = _shift(spectrum, before[1], image.shape)
        rows, columns = (binning * float(d) for d in by)
        if np.hypot(rows, columns) < LEAST_PX:
            return 0.0, 0.0
        still, there, back = (
            self._change(image, before[0], sign * np.array(by), window) for sign in (0, 1, -1)
        )
        size = image.size // COARSER**2
        noise = 2 * len(frame) / (binning * COARSER) ** 2 * float(np.mean(window**2)) * size
        known = still - noise > 5 * noise * np.sqrt(2 / size)  # what noise alone may come to
        # Moved the other way it would lie off by twice as much, with the noise as interpolation leaves it.
        # What has moved farther than its details are wide lies off as much as that already.
        change = still - noise
        explained = (
            back - there > 4 * EXPLAINED * change or still - there > FARTHER * change + SMOOTHED * noise
        )
        return (rows, columns) if known and explained else (0.0, 0.0)

    @staticmethod
    def _change(image: Array, before: Array, by: Array, window: Array) -> float:
        """Return the squared difference to the image before, moved, on coarser pixels."""
        moved = before.copy()
        move(moved, *by)
        rest = block_mean(((image - moved) * window)[None], COARSER)
        return float(np.vdot(rest, rest))


@dataclass(frozen=True, slots=True)
class Motion:
    """How far each frame lies off the mean of all, less the median frame."""

    shifts: Float64Array
    """(n_frames, 2): rows and columns, pixels."""
    largest_px: float
    """Of the frames' distances from their median place."""

    @property
    def is_still(self) -> bool:
        """Whether dF/F of a pixel means the same place throughout: no frame is off by half a pixel."""
        return self.largest_px < 0.5


def motion(frames: Float32Array) -> Motion:
    """Register each frame to the mean of all, by cross-correlation refined to a fraction of a pixel.

    Means are taken off and edges faded out (Hann window); spectra are not whitened, so that what is bright
    counts most: a cell that is much brighter than all the rest tells the motion by itself.

    Parameters
    ----------
    frames : ndarray, (n_frames, height, width)
    """
    reference = np.mean(frames, axis=0)
    window = _window(reference)
    spectrum = _spectrum(reference, window)
    shifts = np.array([_shift(_spectrum(frame, window), spectrum, window.shape) for frame in frames])
    shifts -= np.median(shifts, axis=0)
    return Motion(shifts, float(np.hypot(*shifts.T).max(initial=0.0)))


def aligned(frames: Float32Array, found: Motion) -> Float32Array:
    """Return the frames moved back to their median place, cubic splines, float32."""
    from scipy import ndimage

    moved = np.empty(frames.shape, np.float32)
    for frame, shift, place in zip(frames, found.shifts, moved, strict=True):
        ndimage.shift(frame, -shift, output=place, order=3, mode="nearest")
    return moved


def _window(image: Array) -> Array:
    """Return what fades an image's edges out (Hann)."""
    return np.outer(*(np.hanning(n) for n in image.shape))


def _spectrum(image: Array, window: Array) -> Array:
    """Return the spectrum of an image less its mean, its edges faded out."""
    return np.fft.rfft2((image - image.mean()) * window)


def _shift(spectrum: Array, reference: Array, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return rows and columns by which an image lies off the reference, from their correlation's peak."""
    correlation = np.fft.irfft2(spectrum * np.conj(reference), s=shape)
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
