"""How depth planes are shared among workers, and summed so that the number of workers does not show."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from recon.base.threads import in_blocks

GROUPS = 8
"""Partial sums a stack is summed in: the largest number of workers that a sum over depth can use."""


class PlaneGroups:
    """A fixed partition of ``n_planes`` depth planes into at most ``GROUPS`` runs.

    Sums over depth are taken within each run, plane after plane, and then over the runs in order: the result
    is the same to the last bit for any number of threads.
    """

    def __init__(self, n_planes: int) -> None:
        self.n_planes = n_planes
        self.count = min(GROUPS, n_planes)
        self.edges: npt.NDArray[np.int64] = np.arange(self.count + 1) * n_planes // max(self.count, 1)
        self.of_plane = np.repeat(np.arange(self.count), np.diff(self.edges))

    def run(self, job: Callable[[int, int, int], object]) -> None:
        """Call ``job(group, first_plane, last_plane + 1)`` for every group, on as many workers as allowed."""

        def block(start: int, stop: int) -> None:
            for group in range(start, stop):
                job(group, int(self.edges[group]), int(self.edges[group + 1]))

        if self.count:
            in_blocks(block, self.count)
