"""Spectra of sources as a few wavelengths with weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Spectrum = tuple[tuple[float, float], ...]
"""``(wavelength_nm, weight)`` pairs."""


@dataclass(frozen=True, slots=True)
class Band:
    """A Gaussian emission line: centre wavelength and full width at half maximum, nanometres."""

    center_nm: float
    fwhm_nm: float = 0.0

    def samples(self, count: int) -> Spectrum:
        """Wavelengths with weights that sum to 1 (Gauss-Hermite quadrature)."""
        if count == 1 or self.fwhm_nm == 0:
            return ((self.center_nm, 1.0),)
        nodes, weights = np.polynomial.hermite_e.hermegauss(count)
        sigma_nm = self.fwhm_nm / (2 * np.sqrt(2 * np.log(2)))
        weights = weights / weights.sum()
        return tuple(
            (self.center_nm + sigma_nm * float(node), float(weight))
            for node, weight in zip(nodes, weights, strict=True)
        )


RED = Band(630.0, 20.0)
GREEN = Band(515.0, 35.0)
BLUE = Band(460.0, 25.0)
BANDS: tuple[Band, Band, Band] = (RED, GREEN, BLUE)
"""The dissertation's LED array (Kuo 2020, A.2)."""


def mixed_spectrum(weights: tuple[float, float, float], count: int) -> Spectrum:
    """Red, green and blue in given proportions, ``count`` wavelengths each; dark bands are left out."""
    return tuple(
        (wavelength_nm, weight * part)
        for band, weight in zip(BANDS, weights, strict=True)
        if weight > 0
        for wavelength_nm, part in band.samples(count)
    )
