"""Numbers only: optics, operators, priors, solvers, analysis. Knows no device, no file format, no window."""

from recon.errors import InputError
from recon.noise import NoiseModel
from recon.picture import reconstruct
from recon.result import ImageGrid, Reconstruction
from recon.types import Calibration, Geometry
from recon.volume.reconstruct import reconstruct_volume
from recon.volume.result import VolumeGrid, VolumeReconstruction

__all__ = [
    "Calibration",
    "Geometry",
    "ImageGrid",
    "InputError",
    "NoiseModel",
    "Reconstruction",
    "VolumeGrid",
    "VolumeReconstruction",
    "reconstruct",
    "reconstruct_volume",
]
