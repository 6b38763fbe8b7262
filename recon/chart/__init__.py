"""Charts of cost against accuracy: reconstructions, holograms, calibrations.

A problem (:class:`~recon.chart.scored.Problem`) knows the settings that apply to it and runs one of them;
:mod:`instrument.chart.job` runs all of them, each in a process of its own.
"""

from recon.chart.reconstruction import ChartProblem, Setting, run_setting, settings_for
from recon.chart.scored import Curve, Point, Problem, pareto

__all__ = [
    "ChartProblem",
    "Curve",
    "Point",
    "Problem",
    "Setting",
    "pareto",
    "run_setting",
    "settings_for",
]
