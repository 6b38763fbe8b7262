"""A prior of one's own: colours of a pixel belong together; what is dark is dark in all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.priors import NamedPrior, Prior

Array = npt.NDArray[Any]


class ColourGroups(Prior):
    """``weight * sum_pixels |(x_1, ..., x_c)|`` of non-negative light; of one channel that is l1.

    Parameters
    ----------
    weight : float
        In units of the scaled problem.
    """

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def value(self, x: Array) -> float:
        """Return the sum of the groups' lengths; infinity where light is negative."""
        if np.min(x, initial=0.0) < 0:
            return float("inf")
        return self.weight * float(np.sqrt((x**2).sum(axis=0)).sum())

    def prox(self, x: Array, step: float) -> Array:
        """Return the light less ``step * weight`` of each group's length."""
        light = np.maximum(x, 0)
        length = np.sqrt((light**2).sum(axis=0))
        short = x.dtype.type(step * self.weight)
        kept = np.maximum(length - short, 0) / np.maximum(length, np.finfo(x.dtype).tiny)
        return np.asarray(light * kept, x.dtype)


PRIOR = NamedPrior(
    name="colour-groups",
    help="Points on black whose colours belong together; non-negative.",
    make=ColourGroups,
    kind="l1",
)
