"""Procedures: a plan, the analysis of its frames, a Calibration."""

from calibration_routines.auto_exposure import AutoExposure, ExposureOutcome, auto_expose
from calibration_routines.axial import AxialCalibration, calibrate_axial
from calibration_routines.axial_exposure import SweepExposures, expose_source, expose_sweep
from calibration_routines.axial_plan import AxialSweep, axial_plan, check_sweep, planes_needed
from calibration_routines.errors import CalibrationError
from calibration_routines.field_response import FieldResponse, measure_field_response
from calibration_routines.photograph import Photograph, expose_scene, photograph

__all__ = [
    "AutoExposure",
    "AxialCalibration",
    "AxialSweep",
    "CalibrationError",
    "ExposureOutcome",
    "FieldResponse",
    "Photograph",
    "SweepExposures",
    "auto_expose",
    "axial_plan",
    "calibrate_axial",
    "check_sweep",
    "expose_scene",
    "expose_source",
    "expose_sweep",
    "measure_field_response",
    "photograph",
    "planes_needed",
]
