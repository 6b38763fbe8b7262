"""Priors: what is known about an object before the measurement, as value and proximal map."""

from recon.priors.base import Prior
from recon.priors.simple import L1, Box, NonNegativity, Zero
from recon.priors.sums import L1InBox

__all__ = ["L1", "Box", "L1InBox", "NonNegativity", "Prior", "Zero"]
