"""Procedures: a plan, the analysis of its frames, a Calibration."""

from calibration_routines.optics.angular import AngularProcedure, AngularSweep
from calibration_routines.optics.angular_response import AngularResponse, load_response
from calibration_routines.optics.dpc import DiffuserSurface, DpcProcedure, DpcSetup
from calibration_routines.optics.photograph import Photograph, photograph
from calibration_routines.procedure import CalibrationError, Listener
from calibration_routines.psf.exposure import (
    AutoExposure,
    ExposureOutcome,
    auto_expose,
    expose_scene,
    expose_source,
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
from calibration_routines.psf.sweep_options import AxialSweep, LateralSweep, PointSweep, VolumeSweep
from calibration_routines.psf.sweep_plan import SweepExposures, check_sweep, expose_sweep, sweep_plan
from calibration_routines.psf.sweep_procedure import SweepProcedure
from calibration_routines.psf.sweep_watch import PointTaken, SourceVisit, SweepEvent

__all__ = [
    "AngularProcedure",
    "AngularResponse",
    "AngularSweep",
    "AutoExposure",
    "AxialSweep",
    "CalibrationError",
    "DiffuserSurface",
    "DpcProcedure",
    "DpcSetup",
    "ExposureOutcome",
    "FieldResponse",
    "GridSweep",
    "LateralSweep",
    "Listener",
    "Photograph",
    "PointSweep",
    "PointTaken",
    "Sampling",
    "SourceVisit",
    "SweepCalibration",
    "SweepEvent",
    "SweepExposures",
    "SweepProcedure",
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
    "lateral_spacing",
    "load_response",
    "measure_field_response",
    "photograph",
    "planes_needed",
    "sweep_plan",
    "watch_resumed",
]
