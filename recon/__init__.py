"""Numbers only: optics, operators, priors, solvers, analysis. Knows no device, no file format, no window."""

from recon.base.noise import NoiseModel
from recon.errors import InputError
from recon.reconstruction.picture import reconstruct
from recon.reconstruction.result import ImageGrid, Reconstruction
from recon.reconstruction.volume import reconstruct_volume
from recon.reconstruction.volume_result import VolumeGrid, VolumeReconstruction
from recon.types import Calibration, Geometry

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
