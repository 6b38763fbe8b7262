"""The eye's low-pass and the grid that an intensity needs so that the low-pass can be taken without aliasing.

The intensity's spectrum is the auto-correlation of the field behind the mask: it reaches lags up to the whole
aperture, twice what an FFT of the aperture's own size can tell apart. Zero-padding the aperture by the
radius at which the filter is cut keeps every lag inside the filter clean (lag ``l`` is mixed with
``l - P``, and ``P - A`` is at least the radius), without paying for the full double size.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi, sqrt
from typing import Literal

import numpy as np
import numpy.typing as npt

from recon.base.fft import fast_length
from recon.errors import InputError

Grid = Literal["alias-free", "dissertation"]

CUT = 1.58
"""Radius, in units of the cut-off, beyond which the filter (then 0.010) counts as zero."""
ORDER = 5


def cutoff_radius(slm_shape: tuple[int, int]) -> float:
    """Return ``r0 = sqrt(Nx Ny / pi)`` mask pixels: as many lags inside as the SLM has pixels (Eq. 7.18)."""
    return sqrt(slm_shape[0] * slm_shape[1] / pi)


@dataclass(frozen=True, slots=True)
class Band:
    """Field grid and kept lags.

    Attributes
    ----------
    aperture : (int, int)
        Mask pixels ``(height, width)``.
    shape : (int, int)
        Grid of the field, the aperture zero-padded.
    radius : (int, int)
        Largest lag kept along y and x, in mask pixels. Lags beyond count as filtered out.
    cutoff : float
        ``r0`` in mask pixels.
    """

    aperture: tuple[int, int]
    shape: tuple[int, int]
    radius: tuple[int, int]
    cutoff: float

    @property
    def full(self) -> bool:
        """Whether every lag of the grid is kept."""
        return 2 * self.radius[1] == self.shape[1]

    @property
    def kept(self) -> tuple[int, int]:
        """Shape of the half spectrum that is kept."""
        return (min(2 * self.radius[0] + 1, self.shape[0]), self.radius[1] + 1)

    @property
    def seen_shape(self) -> tuple[int, int]:
        """Smallest fast grid that holds the filtered image without loss."""
        if self.full:
            return self.shape
        return (fast_length(self.kept[0]), fast_length(2 * self.kept[1] - 1, real=True))

    def lags(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the lags of the kept rows (first the positive ones) and columns, mask pixels."""
        rows = self.kept[0]
        y = np.arange(rows, dtype=float)
        y[self.top :] -= rows
        return y, np.arange(self.kept[1], dtype=float)

    @property
    def top(self) -> int:
        """Number of kept rows at the start of the spectrum; the others are at its end."""
        return min(self.radius[0] + 1, self.kept[0])


def make_band(slm_shape: tuple[int, int], factor: int, grid: Grid, *, unfiltered: bool = False) -> Band:
    """Choose the grid for an SLM and a mask with ``factor`` pixels per SLM pixel along each axis.

    ``"alias-free"`` pads by the filter's radius; ``"dissertation"`` takes the aperture's own grid and keeps
    all of its (aliased) lags. ``unfiltered`` keeps every lag of the grid, for a loss without low-pass.
    """
    if factor < 1 or min(slm_shape) < 4:
        raise InputError(
            f"An SLM of {slm_shape} pixels with {factor} mask pixels per pixel cannot be modelled."
        )
    cutoff = cutoff_radius(slm_shape)
    aperture = (slm_shape[0] * factor, slm_shape[1] * factor)
    if grid == "dissertation":
        if aperture[1] % 2:
            raise InputError(f"The dissertation's grid needs an even width, not {aperture[1]} mask pixels.")
        return Band(aperture, aperture, (aperture[0] // 2, aperture[1] // 2), cutoff)
    reach = [min(ceil(CUT * cutoff), n - 1) for n in aperture]
    shape = (
        fast_length(aperture[0] + reach[0]),
        fast_length(aperture[1] + reach[1], real=True),
    )
    if unfiltered:
        return Band(aperture, shape, (shape[0] // 2, shape[1] // 2), cutoff)
    return Band(aperture, shape, (reach[0], reach[1]), cutoff)
