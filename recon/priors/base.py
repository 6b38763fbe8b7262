"""What every prior offers, what a sum of priors is, and the separable ones: l1, bounds, and their sums."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from copy import copy
from numbers import Real
from typing import Any, Self

import numpy as np

from recon.arrays import Array
from recon.base.arguments import require_argument
from recon.errors import InputError, StructureError
from recon.types import plain_number


def refuse_lookalike(prior: object) -> None:
    """Raise InputError for what has a prior's methods and is none, saying how it becomes one."""
    made = prior if isinstance(prior, type) else type(prior)
    has = [method for method in ("value", "prox") if hasattr(made, method)]
    if issubclass(made, Prior) or not has:
        return
    name = made.__name__
    which, lacks = ("value and prox", "") if len(has) == 2 else (f"{has[0]} alone", " with value and prox")
    raise InputError(
        f"prior must be a Prior, and {name}, which has {which}, is none: derive its class, "
        f"class {name}(db.Prior){lacks}, and give an object, {name}(...)."
    )


class Prior(ABC):
    """A convex function that is small for likely objects. One of your own needs ``value`` and ``prox``.

    Objects are whole: (n_channels, height, width) of a picture, (1, n_z, height, width) of one channel of a
    volume, on the grid of the camera's FFT. Proximal gradient methods take the ``prox`` of the whole prior;
    splitting methods take that of each of a sum's :meth:`terms` on its own.

    Attributes
    ----------
    memory : ndarray or None
        What an iterative prox starts from next time; part of the state of the solver that calls it.
    exact : bool
        Whether ``prox`` is that of ``value``, for every step. Splitting methods ask for it.
    """

    memory: Array | None = None
    exact: bool = True

    @abstractmethod
    def value(self, x: Array) -> float:
        """Return the prior's value at ``x``; infinity outside its domain."""

    @abstractmethod
    def prox(self, x: Array, step: float) -> Array:
        """Return ``argmin_p  step * value(p) + 1/2 ||p - x||^2``. ``x`` is left as it is."""

    def checked_prox(self, x: Array, step: float) -> Array:
        """Return ``prox``; InputError where a prior of one's own gives no real array like ``x``.

        A prior of one's own may write into what it is given: it is a copy of the solver's.
        """
        found = self.prox(x if type(self).__module__.startswith("recon.") else x.copy(), step)
        if getattr(found, "shape", None) != x.shape:
            given = f"an array {found.shape}" if hasattr(found, "shape") else type(found).__name__
            raise self._refused(f"its prox must return an array like its argument, {x.shape}, not {given}")
        if found.dtype.kind == "c" != x.dtype.kind:
            raise self._refused(f"its prox must return real numbers as its argument has, not {found.dtype}")
        return found

    def checked_value(self, x: Array) -> float:
        """Return ``value``; InputError where a prior of one's own gives no real number."""
        value: Any = self.value(x)
        shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", None)
        if isinstance(value, Real) or (shape == () and getattr(dtype, "kind", None) in {*"buif"}):
            return float(value)
        given = type(value).__name__
        if isinstance(value, np.ndarray):
            given = f"an array {shape}" if shape else f"an array of {dtype}"
        raise self._refused(f"its value must return a real number, not {given}")

    def _refused(self, problem: str) -> InputError:
        return InputError(f"The prior {type(self).__name__}: {problem}.")

    def for_a_run(self) -> Self:
        """Return the prior with a memory of its own: what a prox keeps belongs to one run."""
        own = copy(self)
        own.memory = None
        return own

    def terms(self) -> tuple[Prior, ...]:
        """Return the summands; a simple prior is its own only one."""
        return (self,)

    def joined(self, other: Prior) -> Prior | None:
        """Return the sum with one other term as one prior where its prox is known; None where it is not."""
        return None

    def __repr__(self) -> str:
        """Say what it is and its parameters: the same for the same prior, as records and checkpoints need."""
        own = {k: v for k, v in vars(self).items() if k != "memory" and not k.startswith("_")}
        shown = (f"{k}={v.tolist() if isinstance(v, np.ndarray) else v!r}" for k, v in own.items())
        return f"{type(self).__name__}({', '.join(shown)})"

    def __add__(self, other: Prior) -> Prior:
        """Return the sum of two priors: one prior where the prox of the sum is known, else a :class:`Sum`."""
        if not isinstance(other, Prior):
            return NotImplemented
        parts: list[Prior] = []
        for term in (*self.terms(), *other.terms()):
            for i, part in enumerate(parts):
                together = part.joined(term) or term.joined(part)
                if together is not None:
                    parts[i] = together
                    break
            else:
                parts.append(term)
        return parts[0] if len(parts) == 1 else Sum(*parts)


class Sum(Prior):
    """A sum of priors of which no common prox is known: for splitting solvers, which take its terms."""

    def __init__(self, *parts: Prior) -> None:
        self.parts = parts

    def terms(self) -> tuple[Prior, ...]:
        """Return the summands' terms."""
        return tuple(term for part in self.parts for term in part.terms())

    def value(self, x: Array) -> float:
        """Return the sum of the values."""
        return sum(part.value(x) for part in self.parts)

    def prox(self, x: Array, step: float) -> Array:
        """Raise StructureError: the prox of a sum is not the proxes one after the other."""
        names = ", ".join(type(part).__name__ for part in self.parts)
        raise StructureError(
            f"The prox of this sum is not known: {names}. Splitting solvers (admm) take its terms one by one."
        )


def require_weight(weight: float) -> float:
    """Return a prior's weight; raises InputError for a negative one, and for what is no number."""
    return _number("A prior's weight", weight, least=0)


def _number(name: str, given: Any, least: float = -math.inf) -> float:
    """Return a number from ``least`` on, or an infinity; raises InputError for anything else."""
    number = plain_number(given)
    endless = isinstance(number, float) and math.isinf(number) and number >= least
    limits = {} if least == -math.inf else {"least": least}
    return float(number if endless else require_argument(name, number, float, "", **limits))


class Separable(Prior):
    """``weight * sum |x|`` for ``lower <= x <= upper``, infinite elsewhere.

    The sum of separable priors is separable. Its prox is the soft threshold, then the clip: exact, because in
    one dimension the minimiser over an interval is the free minimiser, clipped.
    """

    def __init__(self, weight: float = 0.0, lower: float = -np.inf, upper: float = np.inf) -> None:
        self.weight = require_weight(weight)
        self.lower, self.upper = _number("The lower limit", lower), _number("The upper limit", upper)
        if not self.lower <= self.upper:
            raise InputError(f"The box's lower limit {lower:g} is above its upper limit {upper:g}.")

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
