"""Charts of cost against accuracy: reconstructions, holograms, calibrations.

A problem (:class:`recon.chart.scored.Problem`) knows the settings that apply to it and runs one of them;
:mod:`instrument.chart.job` runs all of them, each in a process of its own. There are three:
:class:`recon.chart.reconstruction.ChartProblem`, :class:`recon.chart.hologram.HologramProblem` and
:class:`recon.chart.calibration.CalibrationProblem`. To read a chart none of them need be imported.
"""
