"""How alike two point spread functions are, over shift and scale (Kuo 2020, Eq. 3.11, Figs. 3.4, A.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.camera.refocus import rescaled
from recon.errors import InputError

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

RESOLUTION_LEVEL = 0.7
"""Autocorrelation at which two directions are told apart by most sensors (Kuo 2020, sec. 3.2)."""
INNER_PRODUCT = 0.8
"""Inner product below which two points were told apart in the microscope (sec. 6.4)."""


def similarity(first: Array, second: Array) -> float:
    """Return the inner product of two images of one shape, each divided by its norm (Eq. 3.11)."""
    a, b = (np.asarray(image, np.float64).ravel() for image in (first, second))
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0


@dataclass(frozen=True)
class Correlation:
    """Inner products of two images at every shift in whole pixels.

    Attributes
    ----------
    values : ndarray, float64, (2 height - 1, 2 width - 1)
        Divided by both norms: 1 is identity. The middle is no shift.
    """

    values: Floats

    @property
    def peak(self) -> tuple[int, int]:
        """Rows and columns by which the second image must be shifted to be most like the first."""
        row, column = np.unravel_index(int(np.argmax(self.values)), self.values.shape)
        height, width = self.values.shape
        return int(row) - height // 2, int(column) - width // 2

    @property
    def maximum(self) -> float:
        """The largest inner product at any shift."""
        return float(self.values.max())

    def profile(self, axis: int) -> Floats:
        """Cut through the peak along ``axis`` (0: rows, 1: columns)."""
        row, column = (p + n // 2 for p, n in zip(self.peak, self.values.shape, strict=True))
        return self.values[:, column] if axis == 0 else self.values[row]

    def half_width(self, axis: int, level: float, *, relative: bool = True) -> float:
        """Return the distance from the peak at which a cut falls to ``level``, pixels.

        Linear between pixels, mean of both sides; infinite where it never falls so low.

        Parameters
        ----------
        axis : int
            0: rows, 1: columns.
        level : float
        relative : bool
            Whether ``level`` is relative to the peak (else an inner product).
        """
        cut = self.profile(axis)
        middle = int(np.argmax(cut))
        bar = level * float(cut[middle]) if relative else level
        return float(np.mean([_crossing(side, bar) for side in (cut[middle:], cut[middle::-1])]))


def correlate(first: Array, second: Array) -> Correlation:
    """Correlate two images (height, width) of one shape, without wrap-around."""
    if first.shape != second.shape or first.ndim != 2:
        raise InputError(f"Two images of one shape are correlated, not {first.shape} and {second.shape}.")
    shape = fft.fast_shape([2 * n - 1 for n in first.shape])
    spectra, norm = [], 1.0
    for image in (first, second):
        padded = np.zeros(shape, np.float64)
        padded[: image.shape[0], : image.shape[1]] = image
        norm *= float(np.linalg.norm(padded))
        spectra.append(fft.rfft(padded))
    circular = fft.irfft(spectra[0] * np.conj(spectra[1]), shape[1])
    height, width = first.shape
    rows, columns = np.arange(1 - height, height), np.arange(1 - width, width)
    return Correlation(circular[np.ix_(rows, columns)] / (norm or 1.0))


def autocorrelate(psf: Array) -> Correlation:
    """Correlate a PSF (height, width) with itself: 1 in the middle (Kuo 2020, Fig. 3.4a)."""
    return correlate(psf, psf)


def critical_scale(psf: Array, level: float, *, largest: float = 2.0) -> float:
    """Return the enlargement at which a PSF is only ``level`` similar to itself; infinite beyond ``largest``.

    Doubled from a tenth of a pixel at the PSF's edge until it is less similar, then bisected twice; linear
    between what is left.
    """
    light = cut_to_light(psf)
    centre = centre_of_light(light)

    def seen(by: float) -> float:
        return similarity(light, rescaled(light, 1.0 / (1.0 + by), centre=centre))

    low, at_low = 0.0, 1.0
    high = 0.1 / (0.5 * max(light.shape))
    while (at_high := seen(high)) > level:
        low, at_low = high, at_high
        high *= 2
        if high > largest - 1:
            return float("inf")
    for _ in range(2):
        middle = 0.5 * (low + high)
        if (at_middle := seen(middle)) > level:
            low, at_low = middle, at_middle
        else:
            high, at_high = middle, at_middle
    return float(1.0 + low + (high - low) * (at_low - level) / (at_low - at_high))


def cut_to_light(image: Array, margin: int = 8) -> Array:
    """Cut an image (height, width) to the rows and columns with light: above a hundredth of the peak.

    ``margin`` pixels are kept around it, as far as there are any.
    """
    cut = []
    for axis in (0, 1):
        profile = image.max(axis=1 - axis)
        used = np.flatnonzero(profile > 0.01 * float(profile.max()))
        if not used.size:
            raise InputError("The PSF holds no light.")
        cut.append(slice(max(int(used[0]) - margin, 0), int(used[-1]) + 1 + margin))
    return image[cut[0], cut[1]]


def centre_of_light(psf: Array) -> tuple[float, float]:
    """Return the centroid ``(row, column)`` of an image (height, width), in pixels from its first pixel."""
    light = np.maximum(np.asarray(psf, np.float64), 0)
    total = float(light.sum())
    if total <= 0:
        raise InputError("The PSF holds no light.")
    row = float(light.sum(axis=1) @ np.arange(light.shape[0])) / total
    column = float(light.sum(axis=0) @ np.arange(light.shape[1])) / total
    return row, column


def _crossing(cut: Floats, level: float) -> float:
    below = np.flatnonzero(cut < level)
    if not below.size:
        return float("inf")
    k = int(below[0])
    if k == 0:
        return 0.0
    return float(k - 1 + (cut[k - 1] - level) / (cut[k - 1] - cut[k]))
