"""The scattering mask: a known height map of square pixels, and what it does to one wavelength."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.errors import InputError


@dataclass(frozen=True, slots=True)
class ScatteringMask:
    """A thin phase mask with square pixels, ``m(u) = exp(j alpha(u))`` (Kuo 2020, Sec. 7.3).

    Attributes
    ----------
    levels : ndarray, uint8, (height, width)
        Height level of each mask pixel.
    phases_rad : ndarray, float64, (n_levels,)
        Phase of each level at the design wavelength.
    design_wavelength_nm : float
        The phase at another wavelength is scaled by the ratio (same height; no dispersion of the index).
    """

    levels: npt.NDArray[np.uint8]
    phases_rad: npt.NDArray[np.float64]
    design_wavelength_nm: float = 660.0

    def __post_init__(self) -> None:
        if self.levels.ndim != 2 or self.levels.dtype != np.uint8 or not self.levels.size:
            raise InputError(
                f"Mask levels must be uint8 (height, width), not {self.levels.dtype} {self.levels.shape}."
            )
        if int(self.levels.max()) >= len(self.phases_rad):
            raise InputError(
                f"The mask has level {int(self.levels.max())}, but {len(self.phases_rad)} phases are given."
            )

    @property
    def shape(self) -> tuple[int, int]:
        """``(height, width)`` in mask pixels."""
        height, width = self.levels.shape
        return (height, width)

    def response(self, wavelength_nm: float | None = None) -> npt.NDArray[np.complex128]:
        """Return ``exp(j alpha)`` of each level at a wavelength (default: the design wavelength)."""
        scale = 1.0 if wavelength_nm is None else self.design_wavelength_nm / wavelength_nm
        response: npt.NDArray[np.complex128] = np.exp(1j * scale * self.phases_rad)
        return response

    def field(self, wavelength_nm: float | None = None) -> npt.NDArray[np.complex128]:
        """Return ``m`` of every mask pixel, complex128 (height, width)."""
        field: npt.NDArray[np.complex128] = self.response(wavelength_nm)[self.levels]
        return field


def random_mask(
    shape: tuple[int, int], *, seed: int = 0, design_wavelength_nm: float = 660.0
) -> ScatteringMask:
    """Return a binary mask whose pixels are 0 or pi at random: white, so its far field is flat (Sec. 7.3)."""
    levels = np.random.default_rng(seed).integers(0, 2, shape, dtype=np.uint8)
    return ScatteringMask(levels, np.array([0.0, np.pi]), design_wavelength_nm)
