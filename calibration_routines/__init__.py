"""Procedures: a plan, the analysis of its frames, a Calibration.

The names that scripts use are imported when they are asked for: ``--help`` needs declarations only.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "optics.angular": "AngularProcedure AngularSweep",
    "optics.angular_response": "AngularResponse load_response",
    "optics.dpc": "DiffuserSurface DpcProcedure DpcSetup",
    "optics.field_response": "FieldResponse field_response_of measure_field_response",
    "optics.photograph": "Photograph photograph",
    "procedure": "Listener",
    "psf.exposure": "AutoExposure ExposureOutcome auto_expose expose_scene expose_source",
    "psf.sampling": "GridSweep Sampling axial_planes grid_sweep lateral_spacing",
    "psf.sweep": "SweepCalibration calibrate_sweep finish_sweep watch_sweep",
    "psf.sweep_options": "AxialSweep LateralSweep PointSweep VolumeSweep",
    "psf.sweep_plan": "SweepExposures check_sweep expose_sweep sweep_plan",
    "psf.sweep_procedure": "SweepProcedure",
    "psf.sweep_watch": "PointTaken SourceVisit SweepEvent",
    "purpose": "CalibrationError",
}


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names.split():
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(" ".join(_HOMES.values()).split())
