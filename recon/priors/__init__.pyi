# What `import recon.priors` offers: each name with its home, from which `__init__.py` imports it.

from recon.priors.base import L1 as L1
from recon.priors.base import Box as Box
from recon.priors.base import NonNegativity as NonNegativity
from recon.priors.base import Prior as Prior
from recon.priors.base import Separable as Separable
from recon.priors.base import Sum as Sum
from recon.priors.base import Zero as Zero
from recon.priors.named import PRIORS as PRIORS
from recon.priors.named import NamedPrior as NamedPrior
from recon.priors.total_variation import Differences as Differences
from recon.priors.total_variation import HaarTotalVariation as HaarTotalVariation
from recon.priors.total_variation import TotalVariation as TotalVariation
