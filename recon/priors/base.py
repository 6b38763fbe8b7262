"""What every prior offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy.typing as npt

Array = npt.NDArray[Any]


class Prior(ABC):
    """A convex function that is small for likely objects.

    Solvers pick what they need: proximal gradient methods take ``prox``; splitting methods look at the
    structure of the sum (:meth:`terms`).

    Attributes
    ----------
    memory : ndarray or None
        What an iterative prox starts from next time; part of the state of the solver that calls it.
    """

    memory: Array | None = None

    @abstractmethod
    def value(self, x: Array) -> float:
        """Return the prior's value at ``x``; infinity outside its domain."""

    @abstractmethod
    def prox(self, x: Array, step: float, out: Array | None = None) -> Array:
        """Return ``argmin_p  step * value(p) + 1/2 ||p - x||^2``; ``out`` may be ``x``."""

    def terms(self) -> tuple[Prior, ...]:
        """Return the summands; a simple prior is its own only one."""
        return (self,)

    def __add__(self, other: Prior) -> Prior:
        """Sum of two priors; raises TypeError where no exact prox of the sum is known."""
        from recon.priors.sums import sum_of

        return sum_of(*self.terms(), *other.terms())
