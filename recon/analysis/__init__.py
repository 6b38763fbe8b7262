"""Analysis: what the optics of a calibration can do (Kuo 2020, secs. 3.2, 4.4, 5.3)."""

from recon.analysis.points import AskedNoise, Noise
from recon.analysis.report import Analysis, analyse
from recon.analysis.settings import AnalysisSettings

__all__ = ["Analysis", "AnalysisSettings", "AskedNoise", "Noise", "analyse"]
