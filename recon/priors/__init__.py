"""Priors: what is known about an object before the measurement, as value and proximal map."""

from recon.priors.base import Prior
from recon.priors.differences import Differences
from recon.priors.simple import L1, Box, NonNegativity, Separable, Zero
from recon.priors.total_variation import HaarTotalVariation, TotalVariation

__all__ = [
    "L1",
    "Box",
    "Differences",
    "HaarTotalVariation",
    "NonNegativity",
    "Prior",
    "Separable",
    "TotalVariation",
    "Zero",
]
