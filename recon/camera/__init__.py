"""Cameras as operators, and which camera a calibration gives."""
