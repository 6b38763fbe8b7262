"""How pictures are turned and mirrored to be looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from recon.arrays import Array

Kind = Literal["frames", "results"]
"""Pictures of a camera, and reconstructed ones: all of a kind are turned alike."""


@dataclass(frozen=True, slots=True)
class Orientation:
    """First mirrored, left for right, where it is; then turned counter-clockwise.

    Attributes
    ----------
    quarters : int
        Quarter turns, 0 to 3.
    mirrored : bool
    """

    quarters: int = 0
    mirrored: bool = False

    @classmethod
    def of(cls, kept: Any) -> Orientation:
        """Return what was kept in a file; as the picture is where that makes no sense."""
        values = kept if isinstance(kept, Mapping) else {}
        quarters, mirrored = values.get("quarters", 0), values.get("mirrored", False)
        return cls(quarters % 4 if isinstance(quarters, int) else 0, mirrored is True)

    def turned(self, quarters: int) -> Orientation:
        """Return this one and so many quarters counter-clockwise after it."""
        return Orientation((self.quarters + quarters) % 4, self.mirrored)

    def flipped(self, *, upright: bool) -> Orientation:
        """Return this one, then mirrored as it is seen: left for right; ``upright``: top for bottom."""
        return Orientation((2 * upright - self.quarters) % 4, not self.mirrored)

    def apply(self, picture: Array) -> Array:
        """Return a view of a picture, (height, width) or (height, width, 3), as it is looked at."""
        return np.rot90(picture[:, ::-1] if self.mirrored else picture, self.quarters)

    @property
    def matrix(self) -> tuple[int, int, int, int]:
        """Return ``(a, b, c, d)``: a step ``(x, y)`` of the picture is ``(a x + b y, c x + d y)`` as seen."""
        a, b, c, d = (-1 if self.mirrored else 1), 0, 0, 1
        for _ in range(self.quarters):  # right becomes up: (x, y) becomes (y, -x), y downwards
            a, b, c, d = c, d, -a, -b
        return a, b, c, d

    def step_of(self, across: float, down: float) -> tuple[float, float]:
        """Return the step of the picture that is one across and down as seen."""
        a, b, c, d = self.matrix  # orthogonal: its inverse is its transpose
        return a * across + c * down, b * across + d * down

    @property
    def words(self) -> str:
        """How it is looked at, for people; empty where it is as it is."""
        words = ["mirrored"] if self.mirrored else []
        return ", ".join([*words, f"turned {90 * self.quarters}°"] if self.quarters else words)


AS_IT_IS = Orientation()
