"""Depth planes that are left out because they are empty, and the condition that says they may be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

PATIENCE = 10
"""Iterations that a plane is empty before it is left out; twice as many each time it had to come back."""
REVIEW = 10
"""Iterations between looks at which planes may be left out: each changes the problem that is being solved."""
EXCESS = 0.01
"""How far above tau the residual's correlation with a plane may be for it to count as rightly empty."""


@dataclass(frozen=True, slots=True)
class EmptyPlanes:
    """Planes that took no part at the end, and whether they could be spared.

    The optimality condition of l1 on a plane that is zero is ``A_z^H e <= tau`` at every voxel, with ``e``
    the data's residual (both ways where voxels may be negative).

    Attributes
    ----------
    planes : tuple of int
    worst : float
        Largest ``A_z^H e / tau`` on these planes; 0 where there are none.
    """

    planes: tuple[int, ...] = ()
    worst: float = 0.0

    @property
    def certified(self) -> bool:
        """Whether the condition holds, but for ``EXCESS``."""
        return self.worst <= 1 + EXCESS


class PlaneWatch:
    """Keeps count of how long planes have been empty.

    Attributes
    ----------
    active : ndarray of bool, (n_z,)
        Planes that take part.
    empty_for : ndarray of int, (n_z,)
        Iterations since a plane last held light.
    patience : ndarray of int, (n_z,)
        Iterations after which each plane is left out.
    """

    def __init__(self, n_z: int) -> None:
        self.active = np.ones(n_z, bool)
        self.empty_for = np.zeros(n_z, np.int64)
        self.patience = np.full(n_z, PATIENCE)

    def note(self, light: npt.NDArray[np.float64]) -> None:
        """Take down each plane's sum of magnitudes after an iteration."""
        self.empty_for = np.where(light > 0, 0, self.empty_for + 1)

    def due(self) -> npt.NDArray[np.bool_]:
        """Return which active planes may be left out, at least one plane staying in."""
        due = self.active & (self.empty_for >= self.patience)
        if due.sum() == self.active.sum():
            due[np.flatnonzero(due)[0]] = False
        return due

    def bring_back(self, planes: npt.NDArray[np.intp]) -> None:
        """Let planes take part again."""
        self.active[planes] = True
        self.empty_for[planes] = 0
        self.patience[planes] *= 2
