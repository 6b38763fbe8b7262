"""Numbers only: optics, operators, priors, solvers, analysis. Knows no device, no file format, no window."""

from recon.base.noise import NoiseModel
from recon.camera.grid import Grid
from recon.errors import InputError
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import Options, ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import judged, reconstruct
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.selection import choose
from recon.reconstruction.solve import solve
from recon.types import Calibration, Geometry

__all__ = [
    "Calibration",
    "Geometry",
    "Grid",
    "InputError",
    "Measurement",
    "NoiseModel",
    "Options",
    "Problem",
    "Reconstruction",
    "ReconstructionOptions",
    "choose",
    "judged",
    "reconstruct",
    "solve",
]
