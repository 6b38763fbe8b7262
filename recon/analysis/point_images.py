"""Images of single points at continuous places, of PSFs on planes half an axial step apart."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from recon.arrays import Array, Float64Array
from recon.base import fft

PointImage = Callable[[float, float], Array]
"""Image (height, width) of one point ``columns`` sensor pixels off the axis at a place ``s`` on the depth
axis, in planes (0 is the first): ``image(columns, s)``."""
PLANES = 17
"""Planes of the window in depth, half an axial step (inner product 0.8) apart: the spacing of Sec. 4.4."""
HALF_WINDOW = (4, 24)
"""Rows and columns that the window reaches from the axis, voxels."""
_PARTS = 2  # of a plane, at which points' PSFs are made: between two of them 0.3 % of the light is blurred


def planes_about(z_um: float, step_per_um: float, count: int = PLANES) -> Float64Array:
    """Return ``1 / z`` of planes half an axial step apart about a depth, the nearest first."""
    return np.asarray(1 / z_um - step_per_um / 2 * (np.arange(count) - count // 2), np.float64)


class ShiftedPoints:
    """Images (height, width) of points: PSFs between planes, shifted between pixels by a linear phase."""

    def __init__(
        self, psf_at: Callable[[float], Array], inverse: Float64Array, shape: tuple[int, ...]
    ) -> None:
        self._psf_at, self._inverse, self._light = psf_at, inverse, shape
        self._spectra: dict[int, Array] = {}
        # Room on both sides for the shift, which otherwise would wrap around.
        self._shape = fft.fast_shape((shape[0], shape[1] + 4 * HALF_WINDOW[1]))

    def depth_um(self, s: float) -> float:
        """Return the depth of a place between planes, evenly in 1/z."""
        return float(1 / np.interp(s, np.arange(len(self._inverse)), self._inverse))

    def seen_by(self, image: Callable[[float, float], Array]) -> PointImage:
        """Return points between the planes by images of points at depths."""
        return lambda columns, s: image(columns, self.depth_um(s))

    def __call__(self, columns: float, s: float) -> Array:
        """Return the image of one point, as :data:`PointImage`."""
        return self.of(np.array([columns]), np.array([s]))

    def of(self, columns: Array, places: Array) -> Array:
        """Return the light of a point at each of ``columns`` in each of ``places``: one transform."""
        total = np.zeros((self._shape[0], self._shape[1] // 2 + 1), np.complex64)
        for s in places:
            part = int(_PARTS * s)
            share = np.float32(_PARTS * s - part if len(self._inverse) > 1 else 0.0)
            total += (1 - share) * self._spectrum(part)
            if share > 0:
                total += share * self._spectrum(part + 1)
        frequency = np.fft.rfftfreq(self._shape[1])
        total *= np.exp(-2j * np.pi * np.multiply.outer(columns, frequency)).sum(axis=0).astype(np.complex64)
        height, width = self._light
        light: Array = fft.irfft(total, self._shape[1])[:height, :width]
        return light

    def _spectrum(self, part: int) -> Array:
        """Return the PSF's at this part of a plane: between two of them the light hardly changes."""
        if part not in self._spectra:
            padded = np.zeros(self._shape, np.float32)
            padded[: self._light[0], : self._light[1]] = self._psf_at(self.depth_um(part / _PARTS))
            self._spectra[part] = fft.rfft(padded)
        return self._spectra[part]
