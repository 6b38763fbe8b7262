"""The priors that can be asked for by name, in options, windows and charts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from recon.base.registry import Registry
from recon.errors import InputError
from recon.priors.base import L1, NonNegativity, Prior, Zero
from recon.priors.total_variation import HaarTotalVariation, TotalVariation


@dataclass(frozen=True)
class NamedPrior:
    """A prior to choose.

    Attributes
    ----------
    name : str
        In options and records.
    help : str
        One line: what the scene is like.
    make : callable
        ``make(weight)`` returns the prior, in units of the scaled problem.
    kind : "tv" or "l1"
        What it counts, which its default weight follows: differences, or light.
    weighted : bool
        Whether it has a weight at all; bounds have none.
    pictures_only : bool
        Whether it holds too little for volumes, PSFs that vary and backgrounds.
    accepts : callable
        ``accepts(problem)`` returns why the prior does not fit a problem, in words; None where it does.
    """

    name: str
    help: str
    make: Callable[[float], Prior]
    kind: Literal["tv", "l1"] = "tv"
    weighted: bool = True
    pictures_only: bool = False
    accepts: Callable[[object], str | None] = lambda _: None

    def __call__(self, weight: float) -> Prior:
        """Return the prior of a weight.

        Raises InputError where what was registered makes none.
        """
        try:
            made = self.make(weight)
        except TypeError as error:  # as of a class without prox
            raise InputError(f"The prior {self.name!r} cannot be made: {error}.") from error
        if not isinstance(made, Prior):
            raise InputError(
                f"The prior {self.name!r} is made as a {type(made).__name__}: a subclass of "
                "recon.priors.Prior with value and prox is expected."
            )
        return made

    @cached_property
    def exact(self) -> bool:
        """Whether its prox is: a splitting with another would settle elsewhere."""
        return all(term.exact for term in self(1.0).terms())


def _own() -> Iterable[NamedPrior]:
    return (
        NamedPrior(
            "tv",
            "Piecewise smooth: total variation, |dx| + |dy|; non-negative.",
            lambda weight: TotalVariation(weight) + NonNegativity(),
        ),
        NamedPrior(
            "tv-isotropic",
            "Piecewise smooth: total variation, the gradient's length; non-negative.",
            lambda weight: TotalVariation(weight, isotropic=True) + NonNegativity(),
        ),
        NamedPrior(
            "tv-haar",
            "Total variation with a cheap, inexact prox (Kuo 2020, A.1); non-negative.",
            lambda weight: HaarTotalVariation(weight) + NonNegativity(),
        ),
        NamedPrior(
            "l1",
            "Points on black: sum of magnitudes; non-negative.",
            lambda weight: L1(weight) + NonNegativity(),
            kind="l1",
        ),
        NamedPrior(
            "nonnegative",
            "No light is negative; nothing else.",
            lambda _: NonNegativity(),
            kind="l1",
            weighted=False,
        ),
        NamedPrior(
            "none", "Nothing is known.", lambda _: Zero(), kind="l1", weighted=False, pictures_only=True
        ),
    )


PRIORS: Registry[NamedPrior] = Registry("prior", "diffuserbench.priors", _own)
"""Priors by name. One's own: ``PRIORS.register(NamedPrior(...))``, or as an entry point of the group."""
