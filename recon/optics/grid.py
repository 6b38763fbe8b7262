"""What light is sampled on: square pixels at continuous places, area-true resampling; wavelengths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from recon.arrays import Float32Array, Float64Array

if TYPE_CHECKING:
    from scipy import sparse

FloatArray = Float64Array


@dataclass(frozen=True, slots=True)
class PixelGrid:
    """A rectangular grid of square pixels.

    Attributes
    ----------
    shape : tuple of int
        ``(height, width)`` in pixels.
    pitch_um : float
        Pixel pitch.
    center_um : tuple of float
        ``(x, y)`` of the grid's geometric centre: the middle of the centre pixel where a side is odd, the
        border between the two middle pixels where it is even.
    """

    shape: tuple[int, int]
    pitch_um: float
    center_um: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if min(self.shape) < 1 or not self.pitch_um > 0:
            raise ValueError(
                f"A pixel grid needs pixels of positive pitch, not {self.shape}, {self.pitch_um} um."
            )

    @property
    def x_um(self) -> FloatArray:
        """Centres of the columns, ``(width,)``."""
        return self._places(0, self.shape[1])

    @property
    def y_um(self) -> FloatArray:
        """Centres of the rows, ``(height,)``."""
        return self._places(1, self.shape[0])

    @property
    def x_edges_um(self) -> FloatArray:
        """Edges of the columns, ``(width + 1,)``."""
        return self._places(0, self.shape[1] + 1)

    @property
    def y_edges_um(self) -> FloatArray:
        """Edges of the rows, ``(height + 1,)``."""
        return self._places(1, self.shape[0] + 1)

    def _places(self, axis: int, count: int) -> FloatArray:
        """Return places a pixel apart with the centre in their middle; axis 0 is x."""
        return np.asarray(self.center_um[axis] + (np.arange(count) - (count - 1) / 2) * self.pitch_um)

    def refined(self, factor: int) -> PixelGrid:
        """Return the grid with every pixel cut into ``factor`` x ``factor``."""
        height, width = self.shape
        return PixelGrid((height * factor, width * factor), self.pitch_um / factor, self.center_um)


def overlap_matrix(source_edges: FloatArray, target_edges: FloatArray) -> sparse.csr_array:
    """Fraction of every source cell that falls into every target cell, along one axis.

    Parameters
    ----------
    source_edges, target_edges : ndarray, float64, (n + 1,), (m + 1,)
        Cell borders, both ascending or both descending.

    Returns
    -------
    csr_array, float32, (m, n)
        ``overlap_matrix(...) @ v`` moves the content ``v`` of the source cells (energy, not density) into the
        target cells; columns of source cells that lie wholly inside the target sum to 1.
    """
    if source_edges[0] > source_edges[-1]:
        source_edges, target_edges = -source_edges, -target_edges
    n = len(source_edges) - 1
    m = len(target_edges) - 1
    # Every piece between two successive borders of either grid belongs to one cell of each.
    borders = np.unique(np.concatenate([source_edges, target_edges]))
    middles = (borders[1:] + borders[:-1]) / 2
    lengths = np.diff(borders)
    i = np.searchsorted(source_edges, middles) - 1
    j = np.searchsorted(target_edges, middles) - 1
    inside = (i >= 0) & (i < n) & (j >= 0) & (j < m)
    i, j, lengths = i[inside], j[inside], lengths[inside]
    fractions = lengths / np.diff(source_edges)[i]
    from scipy import sparse  # late: importing recon stays light

    return sparse.csr_array((fractions.astype(np.float32), (j, i)), shape=(m, n))


def resample_energy(
    energy: Float32Array,
    y_edges: FloatArray,
    x_edges: FloatArray,
    target_y_edges: FloatArray,
    target_x_edges: FloatArray,
    shifts: FloatArray | None = None,
) -> Float32Array:
    """Move the content of one rectangular grid's cells into another's by overlapping area.

    Parameters
    ----------
    energy : ndarray, float32, (h, w)
        Content of the source cells, spread evenly over each.
    y_edges, x_edges, target_y_edges, target_x_edges : ndarray, float64
        Cell borders of both grids in common coordinates.
    shifts : ndarray, float64, optional
        Displacements along both axes over whose pairs the mean is taken.

    Returns
    -------
    ndarray, float32, (H, W)
        What falls outside the target is lost; inside, the sum is kept.
    """
    rows, columns = (
        _mean_overlap(edges, target, np.zeros(1) if shifts is None else shifts)
        for edges, target in ((y_edges, target_y_edges), (x_edges, target_x_edges))
    )
    down = rows @ energy
    return np.ascontiguousarray((columns @ down.T).T)


def _mean_overlap(edges: FloatArray, target_edges: FloatArray, shifts: FloatArray) -> sparse.csr_array:
    total = overlap_matrix(edges, target_edges - shifts[0])
    for shift in shifts[1:]:
        total += overlap_matrix(edges, target_edges - shift)
    return total if len(shifts) == 1 else total * np.float32(1 / len(shifts))


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
