"""Priors: what is known about an object before the measurement, as value and proximal map."""

from recon.priors.base import L1, Box, NonNegativity, Prior, Separable, Sum, Zero
from recon.priors.named import PRIORS, NamedPrior
from recon.priors.total_variation import Differences, HaarTotalVariation, TotalVariation

__all__ = [
    "L1",
    "PRIORS",
    "Box",
    "Differences",
    "HaarTotalVariation",
    "NamedPrior",
    "NonNegativity",
    "Prior",
    "Separable",
    "Sum",
    "TotalVariation",
    "Zero",
]
