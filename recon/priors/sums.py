"""Sums of priors whose joint prox is known."""

from __future__ import annotations

from functools import reduce

from recon.priors.base import Prior
from recon.priors.simple import Separable
from recon.priors.total_variation import HaarTotalVariation, TotalVariation


def sum_of(*terms: Prior) -> Prior:
    """Return the sum of priors as one prior: any number of separable ones and at most one total variation.

    Raises
    ------
    TypeError
        When the prox of the sum is not known; a splitting solver may still take the terms one by one.
    """
    separable = reduce(Separable.together_with, [t for t in terms if isinstance(t, Separable)], Separable())
    variations = [t for t in terms if isinstance(t, TotalVariation | HaarTotalVariation)]
    known = sum(isinstance(t, Separable) for t in terms) + len(variations) == len(terms)
    if not known or len(variations) > 1:
        names = ", ".join(type(t).__name__ for t in terms if not isinstance(t, Separable))
        raise TypeError(f"The prox of this sum is not known: {names}.")
    return variations[0].with_separable(separable) if variations else separable
