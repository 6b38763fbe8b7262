"""What is shown of a frame: 8-bit indices, histogram, levels, profiles, a region dragged on it."""

from __future__ import annotations

import functools
import threading
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from drivers.camera import Roi
from drivers.frame import FrameMetadata
from recon.arrays import Array, Float32Array, Float64Array
from recon.optics.jit import compiled

SATURATED = 255
"""Index of saturated pixels; signal uses 0 to 254."""
_SIGNAL = SATURATED - 1
_PARTS = 64
_LEAST_SPAN = 16

Counts = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def index_table(
    dtype: npt.DTypeLike, low: float, high: float, full_scale: int | None = None
) -> npt.NDArray[np.uint8]:
    """Return the 8-bit index of every count of a type: 0 to 254 from ``low`` to ``high``, 255 saturated.

    Parameters
    ----------
    dtype
        uint8 or uint16.
    low, high : float
        Counts shown darkest and brightest.
    full_scale : int, optional
        Counts from here on are saturated.
    """
    counts = np.arange(np.iinfo(np.dtype(dtype)).max + 1)
    span = max(float(high) - float(low), 1e-12)
    table: npt.NDArray[np.uint8] = np.clip((counts - low) * (_SIGNAL / span), 0, _SIGNAL).astype(np.uint8)
    if full_scale is not None:
        table[full_scale:] = SATURATED
    return table


@compiled
def fill_indices(image: Array, table: npt.NDArray[np.uint8], step: int, out: npt.NDArray[np.uint8]) -> None:
    """Look counts up in a table, taking one pixel of each ``step`` x ``step``.

    A block with a saturated pixel is saturated as a whole: shrinking an image must not hide saturation.

    Parameters
    ----------
    image : ndarray, (height, width), uint8 or uint16
    table : ndarray, uint8
        From :func:`index_table`.
    out : ndarray, (height // step, width // step), uint8
    """
    height, width = out.shape
    if step == 1:
        for y in range(height):
            for x in range(width):
                out[y, x] = table[image[y, x]]
        return
    for y in range(height):
        for x in range(width):
            highest = image[y * step, x * step]
            for dy in range(step):
                for dx in range(step):
                    highest = max(highest, image[y * step + dy, x * step + dx])
            index = table[highest]
            out[y, x] = index if index == 255 else table[image[y * step, x * step]]


_compiled = threading.Event()


def compile_for_frames() -> None:
    """Compile, or load, what shows a frame as cameras give it, and one that is turned; in any thread."""
    for dtype in (np.uint8, np.uint16):
        blank = np.zeros((2, 2), dtype)
        blank.flags.writeable = False
        for turned in (blank, blank.T, blank[::-1]):
            fill_indices(turned, index_table(dtype, 0, 1), 1, np.zeros((2, 2), np.uint8))
    _compiled.set()


def show_indices(image: Array, table: npt.NDArray[np.uint8], step: int, out: npt.NDArray[np.uint8]) -> None:
    """Do what :func:`fill_indices` does, by NumPy as long as that is not compiled: who waited would hang.

    The image is read only, as a frame is: of another kind it would be compiled anew.
    """
    if _compiled.is_set():
        fill_indices(image, table, step, out)
        return
    height, width = out.shape
    parts = [
        image[dy : height * step : step, dx : width * step : step] for dy in range(step) for dx in range(step)
    ]
    np.take(table, parts[0], out=out, mode="clip")
    if step > 1:
        out[table[functools.reduce(np.maximum, parts)] == SATURATED] = SATURATED


def histogram(image: Counts) -> Float32Array:
    """Return how many pixels (of all channels) have each count: of all of the raw data, at its full depth."""
    flat = image.reshape(image.shape[0], -1)
    n = np.iinfo(image.dtype).max + 1
    return np.asarray(cv2.calcHist([flat], [0], None, [n], [0, n]), np.float32).ravel()


def grouped(counts: Float32Array, first: int, last: int, bins: int = 256) -> tuple[Float32Array, int]:
    """Return a histogram from one count to another in ``bins`` equal steps, and a step's size in counts."""
    used = counts[first : last + 1]
    size = -(-len(used) // bins)
    padded = np.zeros(size * bins, np.float32)
    padded[: len(used)] = used
    return np.asarray(padded.reshape(bins, size).sum(axis=1)), size


@dataclass(frozen=True, slots=True)
class FrameFigures:
    """What a frame's counts are, in figures."""

    least: int
    largest: int
    mean: float
    full_scale: int
    saturated: float
    """Share of the pixels at full scale."""

    @classmethod
    def of(cls, counts: Float32Array, full_scale: int) -> FrameFigures:
        """Return the figures of a histogram of all counts."""
        there = np.flatnonzero(counts)
        total = float(counts.sum(dtype=np.float64))
        # Not by a dot product: BLAS wakes a thread for one of 65536, which then spins until the next frame.
        mean = float((there * counts[there].astype(np.float64)).sum()) / total
        saturated = float(counts[full_scale:].sum(dtype=np.float64)) / total
        return cls(int(there[0]), int(there[-1]), mean, full_scale, saturated)

    @property
    def share(self) -> float:
        """The largest count as a share of full scale."""
        return self.largest / self.full_scale

    @property
    def span(self) -> tuple[int, int]:
        """First and last count of a scale that the data fill: even parts of the sensor's range."""
        part = max(1, (self.full_scale + 1) // _PARTS)
        first = self.least // part * part
        return first, min(self.full_scale, (self.largest // part + 1) * part - 1)


def percentiles(counts: Float32Array, low: float, high: float) -> tuple[float, float]:
    """Return the counts below which ``low`` and ``high`` per cent of a histogram's pixels lie."""
    total = np.cumsum(counts, dtype=np.float64)
    at = np.searchsorted(total, np.array([low, high]) / 100 * total[-1])
    return float(at[0]), float(max(at[1], at[0] + 1))


def not_stretched(levels: tuple[float, float], full_scale: int) -> tuple[float, float]:
    """Return levels that span a sixteenth of the sensor's range at least: noise in the dark looks dark."""
    low, high = levels
    return low, max(high, low + full_scale / _LEAST_SPAN)


def line_profile(
    image: Array, start: tuple[float, float], end: tuple[float, float]
) -> tuple[Float64Array, Float64Array]:
    """Return distance in pixels and value along a line, about one sample a pixel, linear between pixels.

    Parameters
    ----------
    image : ndarray, (height, width) or (height, width, 3)
        Of colour the mean is taken.
    start, end : (x, y)
        In pixels; pixel ``(0, 0)`` reaches from 0 to 1. What lies outside is left out.
    """
    from scipy.ndimage import map_coordinates

    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    n = max(2, round(length) + 1)
    along = np.linspace(0.0, 1.0, n)
    x = start[0] + along * (end[0] - start[0]) - 0.5
    y = start[1] + along * (end[1] - start[1]) - 0.5
    height, width = image.shape[:2]
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    grey = image if image.ndim == 2 else image.mean(axis=2)
    values = map_coordinates(grey, [y[inside], x[inside]], order=1, mode="nearest", output=np.float64)
    return along[inside] * length, values


def sensor_roi(metadata: FrameMetadata, left: float, top: float, width: float, height: float) -> Roi:
    """Return the region of the sensor under a rectangle drawn on a frame, both as the frame was taken.

    Parameters
    ----------
    left, top, width, height : float
        In pixels of the frame; cut at its borders.
    """
    frame_top, frame_left, frame_height, frame_width = metadata.roi
    b = metadata.binning
    x0, y0 = max(0, round(left)), max(0, round(top))
    x1 = min(frame_width // b, round(left + width))
    y1 = min(frame_height // b, round(top + height))
    return Roi(frame_top + y0 * b, frame_left + x0 * b, max(0, y1 - y0) * b, max(0, x1 - x0) * b)
