"""Smooth functions over the field: what PSFs vary with (Kuo 2020, Eq. 5.7), here polynomials."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class FieldFunctions:
    """Polynomials of the field's coordinates up to a degree, orthonormal over the places of the beads.

    PSFs that are combinations of ``k`` images weighted with ``k`` functions have rank ``k`` at most (Kuo
    2020, Eq. 5.13), and vary over the field no faster than the functions do: 1, 3, 6 for degrees 0, 1, 2.
    Beyond the rectangle of the beads, where nothing was measured, they stay what they are at its border.

    Parameters
    ----------
    degree : int
    places : ndarray, (n, 2)
        ``(row, column)`` of the beads; at least as many as functions, not all on a line.
    """

    def __init__(self, degree: int, places: Floats) -> None:
        self.degree = degree
        self._low, self._high = places.min(axis=0), places.max(axis=0)
        _, upper = np.linalg.qr(self._monomials(places) / np.sqrt(len(places)))
        # QR leaves the signs open; like this the first function is 1, and its image the mean PSF.
        self._to_orthonormal = upper * np.sign(np.diag(upper))[:, None]
        self.count = len(upper)

    def at(self, places: Floats) -> Floats:
        """Return the functions' values at places (n, 2): (n, count)."""
        return np.asarray(np.linalg.solve(self._to_orthonormal.T, self._monomials(places).T).T)

    def _monomials(self, places: Floats) -> Floats:
        middle, half = (self._low + self._high) / 2, np.maximum((self._high - self._low) / 2, 1e-9)
        row, column = np.clip((places - middle) / half, -1, 1).T
        powers = [(n - m, m) for n in range(self.degree + 1) for m in range(n + 1)]
        return np.stack([row**i * column**j for i, j in powers], axis=1)
