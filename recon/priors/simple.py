"""Separable priors: non-negativity, box, l1."""

from __future__ import annotations

import numpy as np

from recon.priors.base import Array, Prior


class Zero(Prior):
    """No prior."""

    def value(self, x: Array) -> float:
        """Return 0."""
        return 0.0

    def prox(self, x: Array, step: float, out: Array | None = None) -> Array:
        """Return ``x`` itself."""
        if out is None:
            return x.copy()
        if out is not x:
            out[...] = x
        return out


class Box(Prior):
    """Zero for ``lower <= x <= upper``, infinite elsewhere."""

    def __init__(self, lower: float = -np.inf, upper: float = np.inf) -> None:
        if not lower <= upper:
            raise ValueError(f"The box's lower limit {lower:g} is above its upper limit {upper:g}.")
        self.lower = float(lower)
        self.upper = float(upper)

    def value(self, x: Array) -> float:
        """Return 0 inside, infinity outside."""
        return 0.0 if x.min() >= self.lower and x.max() <= self.upper else np.inf

    def prox(self, x: Array, step: float, out: Array | None = None) -> Array:
        """Project onto the box."""
        return np.clip(x, self.lower, self.upper, out=out)


class NonNegativity(Box):
    """Zero for ``x >= 0``, infinite elsewhere."""

    def __init__(self) -> None:
        super().__init__(lower=0.0)


class L1(Prior):
    """``weight * sum |x|``."""

    def __init__(self, weight: float) -> None:
        if not weight >= 0:
            raise ValueError(f"A prior's weight must not be negative; got {weight}.")
        self.weight = float(weight)

    def value(self, x: Array) -> float:
        """Return ``weight * sum |x|``."""
        return self.weight * float(np.sum(np.abs(x), dtype=np.float64))

    def prox(self, x: Array, step: float, out: Array | None = None) -> Array:
        """Soft threshold at ``weight * step``."""
        threshold = x.dtype.type(self.weight * step)
        # x - clip(x, -t, t) is the soft threshold without a sign or a branch.
        result: Array = np.subtract(x, np.clip(x, -threshold, threshold), out=out)
        return result
