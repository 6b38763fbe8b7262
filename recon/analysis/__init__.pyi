# What `import recon.analysis` offers: each name with its home, from which `__init__.py` imports it.

from recon.analysis.point_noise import AskedNoise as AskedNoise
from recon.analysis.point_noise import Noise as Noise
from recon.analysis.report import Analysis as Analysis
from recon.analysis.report import analyse as analyse
from recon.analysis.settings import AnalysisSettings as AnalysisSettings
