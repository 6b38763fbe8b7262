"""Procedures: a plan, the analysis of its frames, a calibration."""
