"""Sums of priors whose joint prox is known exactly."""

from __future__ import annotations

import numpy as np

from recon.priors.base import Array, Prior
from recon.priors.simple import L1, Box


def sum_of(*terms: Prior) -> Prior:
    """Return the sum of priors as one prior with an exact prox.

    Raises
    ------
    TypeError
        When the prox of the sum is not known in closed form; a splitting solver may still take the terms.
    """
    if len(terms) == 1:
        return terms[0]
    boxes = [t for t in terms if isinstance(t, Box)]
    others = [t for t in terms if not isinstance(t, Box)]
    if len(boxes) == 1 and len(others) == 1 and isinstance(others[0], L1):
        return L1InBox(others[0], boxes[0])
    raise TypeError(
        "No exact prox is known for the sum of " + ", ".join(type(t).__name__ for t in terms) + "."
    )


class L1InBox(Prior):
    """``weight * sum |x|`` inside a box: soft threshold, then clip.

    Exact because in one dimension the minimiser over an interval is the free minimiser, clipped.
    """

    def __init__(self, l1: L1, box: Box) -> None:
        self.l1 = l1
        self.box = box

    def terms(self) -> tuple[Prior, ...]:
        """Return the l1 term and the box."""
        return (self.l1, self.box)

    def value(self, x: Array) -> float:
        """Return ``weight * sum |x|`` inside the box, infinity outside."""
        inside = self.box.value(x)
        return inside if np.isinf(inside) else self.l1.value(x)

    def prox(self, x: Array, step: float, out: Array | None = None) -> Array:
        """Soft threshold, then clip."""
        out = self.l1.prox(x, step, out)
        return self.box.prox(out, step, out)
