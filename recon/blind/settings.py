"""How images of beads are solved blindly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BlindSettings:
    """How the bead images are solved.

    Attributes
    ----------
    grid : (int, int)
        Rows and columns of PSFs over the field.
    ranks : sequence of int
        The rank of each round on the grid, rising (Kuo 2020: raised after each alternating solve).
    iterations : int
        Of each half-step (Kuo 2020: 100).
    degree : int
        Highest degree of the polynomials over the field with which PSFs vary in the end: 0, 1 or 2, and so
        rank 1, 3 or 6. It is lowered where the beads are too few.
    tau : float
        Weight of the beads' sparsity relative to ``max |A^H b|`` (Eq. 5.12).
    reach : float
        Part of the sensor that the outermost PSFs stand for: 0.8 puts them at 80 % of the way to its edge.
    improvement : float
        Relative decrease of the misfit below which a further round is not worth it.
    """

    grid: tuple[int, int] = (5, 5)
    ranks: Sequence[int] = (1, 2, 3)
    iterations: int = 60
    degree: int = 2
    tau: float = 0.01
    reach: float = 0.8
    improvement: float = 0.02
