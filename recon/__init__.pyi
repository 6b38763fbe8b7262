# What `import recon` offers: each name with its home, from which `__init__.py` imports it.

from recon.base.noise import NoiseModel as NoiseModel
from recon.camera.grid import Grid as Grid
from recon.errors import InputError as InputError
from recon.reconstruction.measurement import Measurement as Measurement
from recon.reconstruction.options import Options as Options
from recon.reconstruction.options import ReconstructionOptions as ReconstructionOptions
from recon.reconstruction.problem import Problem as Problem
from recon.reconstruction.reconstruct import judged as judged
from recon.reconstruction.reconstruct import reconstruct as reconstruct
from recon.reconstruction.result import Reconstruction as Reconstruction
from recon.reconstruction.selection import choose as choose
from recon.reconstruction.solve import solve as solve
from recon.types import Calibration as Calibration
from recon.types import Geometry as Geometry
