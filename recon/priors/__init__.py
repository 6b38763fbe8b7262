"""Priors: what is known about an object before the measurement, as value and proximal map."""

from recon.priors.base import Prior, Sum
from recon.priors.differences import Differences
from recon.priors.named import PRIORS, NamedPrior
from recon.priors.simple import L1, Box, NonNegativity, Separable, Zero
from recon.priors.total_variation import HaarTotalVariation, TotalVariation

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
