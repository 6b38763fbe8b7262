"""Separable priors: l1, non-negativity, box, and their sums."""

from __future__ import annotations

import numpy as np

from recon.priors.base import Array, Prior


class Separable(Prior):
    """``weight * sum |x|`` for ``lower <= x <= upper``, infinite elsewhere.

    The sum of separable priors is separable. Its prox is the soft threshold, then the clip: exact, because in
    one dimension the minimiser over an interval is the free minimiser, clipped.
    """

    def __init__(self, weight: float = 0.0, lower: float = -np.inf, upper: float = np.inf) -> None:
        if not weight >= 0:
            raise ValueError(f"A prior's weight must not be negative; got {weight}.")
        if not lower <= upper:
            raise ValueError(f"The box's lower limit {lower:g} is above its upper limit {upper:g}.")
        self.weight = float(weight)
        self.lower = float(lower)
        self.upper = float(upper)

    @property
    def is_zero(self) -> bool:
        """Whether it asks for nothing."""
        return self.weight == 0 and self.lower == -np.inf and self.upper == np.inf

    def value(self, x: Array) -> float:
        """Return ``weight * sum |x|`` inside the box, infinity outside."""
        if x.min() < self.lower or x.max() > self.upper:
            return np.inf
        return self.weight * float(np.sum(np.abs(x), dtype=np.float64)) if self.weight else 0.0

    def prox(self, x: Array, step: float) -> Array:
        """Soft threshold at ``weight * step``, then clip to the box."""
        threshold = x.dtype.type(self.weight * step)
        # x - clip(x, -t, t) is the soft threshold without a sign or a branch.
        result: Array = x - np.clip(x, -threshold, threshold)
        return np.clip(result, self.lower, self.upper, out=result)

    def joined(self, other: Prior) -> Separable | None:
        """Return the sum with another separable prior."""
        return self.with_separable(other) if isinstance(other, Separable) else None

    def with_separable(self, other: Separable) -> Separable:
        """Return the sum with another separable prior."""
        return Separable(
            self.weight + other.weight, max(self.lower, other.lower), min(self.upper, other.upper)
        )


class Zero(Separable):
    """No prior."""

    def __init__(self) -> None:
        super().__init__()


class L1(Separable):
    """``weight * sum |x|``."""

    def __init__(self, weight: float) -> None:
        super().__init__(weight)


class Box(Separable):
    """Zero for ``lower <= x <= upper``, infinite elsewhere."""

    def __init__(self, lower: float = -np.inf, upper: float = np.inf) -> None:
        super().__init__(0.0, lower, upper)


class NonNegativity(Separable):
    """Zero for ``x >= 0``, infinite elsewhere."""

    def __init__(self) -> None:
        super().__init__(lower=0.0)
