"""Procedures: a plan, the analysis of its frames, a Calibration."""

from calibration_routines.errors import CalibrationError
from calibration_routines.optics.angular import AngularSweep, measure_angular_response
from calibration_routines.optics.angular_response import AngularResponse, load_response
from calibration_routines.optics.dpc import DiffuserSurface, DpcSetup, measure_diffuser
from calibration_routines.optics.photograph import Photograph, expose_scene, photograph
from calibration_routines.psf.exposure import (
    AutoExposure,
    ExposureOutcome,
    SweepExposures,
    auto_expose,
    expose_source,
    expose_sweep,
)
from calibration_routines.psf.field_response import FieldResponse, measure_field_response
from calibration_routines.psf.sampling import (
    GridSweep,
    Sampling,
    axial_planes,
    grid_sweep,
    lateral_spacing,
    planes_needed,
)
from calibration_routines.psf.sweep import SweepCalibration, calibrate_sweep, finish_sweep, watch_resumed
from calibration_routines.psf.sweep_options import AxialSweep, LateralSweep, PointSweep, Sweep, VolumeSweep
from calibration_routines.psf.sweep_plan import check_sweep, sweep_plan
from calibration_routines.psf.sweep_record import is_sweep
from calibration_routines.psf.sweep_watch import PointTaken, SourceVisit, SweepEvent

__all__ = [
    "AngularResponse",
    "AngularSweep",
    "AutoExposure",
    "AxialSweep",
    "CalibrationError",
    "DiffuserSurface",
    "DpcSetup",
    "ExposureOutcome",
    "FieldResponse",
    "GridSweep",
    "LateralSweep",
    "Photograph",
    "PointSweep",
    "PointTaken",
    "Sampling",
    "SourceVisit",
    "Sweep",
    "SweepCalibration",
    "SweepEvent",
    "SweepExposures",
    "VolumeSweep",
    "auto_expose",
    "axial_planes",
    "calibrate_sweep",
    "check_sweep",
    "expose_scene",
    "expose_source",
    "expose_sweep",
    "finish_sweep",
    "grid_sweep",
    "is_sweep",
    "lateral_spacing",
    "load_response",
    "measure_angular_response",
    "measure_diffuser",
    "measure_field_response",
    "photograph",
    "planes_needed",
    "sweep_plan",
    "watch_resumed",
]
