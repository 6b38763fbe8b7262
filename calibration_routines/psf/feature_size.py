"""How fine a PSF's structure is, and how far its image can be binned without losing any of it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage

FEATURE_PX = 2.0
"""Binned pixels that the finest structure must still cover: Nyquist (Kuo 2020, Sec. 4.3)."""
_LOCAL_MEAN_PX = 16.0  # structure coarser than this does not count
_REACH_PX = 24


def feature_size_px(first: npt.NDArray[np.floating], second: npt.NDArray[np.floating]) -> float:
    """Full width at half maximum of a PSF's finest structure, pixels.

    The half width of the correlation of two frames of the same light (their noise does not correlate), less
    their local mean; a Gaussian's auto-correlation is wider than itself by the square root of two.

    Parameters
    ----------
    first, second : ndarray, (height, width)
        Two frames of the same light, dark frame subtracted. The same frame twice overrates noise as
        structure.
    """
    spectra = []
    for image in (first, second):
        fine = image - ndimage.gaussian_filter(image, _LOCAL_MEAN_PX)
        spectra.append(fft.rfft2(fine.astype(np.float32)))
    correlation = fft.irfft2(spectra[0] * np.conj(spectra[1]), s=first.shape)
    lags = np.arange(-_REACH_PX, _REACH_PX + 1)
    near = correlation[np.ix_(lags, lags)]
    radius = np.hypot(lags[:, None], lags)
    rings = [float(near[(radius > r - 0.5) & (radius <= r + 0.5)].mean()) for r in range(_REACH_PX)]
    profile = np.array(rings) / rings[0]
    below = int(np.argmax(profile < 0.5))
    if not profile[below] < 0.5:
        return float(2 * _REACH_PX)
    inner = below - 1
    half = inner + (profile[inner] - 0.5) / (profile[inner] - profile[below])
    return float(2 * half / np.sqrt(2))


def optical_binning(first: npt.NDArray[np.floating], second: npt.NDArray[np.floating]) -> int:
    """Return the largest binning that leaves the finest structure two pixels wide; arguments as above."""
    return max(1, int(feature_size_px(first, second) / FEATURE_PX))
