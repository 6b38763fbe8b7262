"""Fast solvers for depth stacks, where one plane's worth of data meets many planes of unknowns."""

from recon.volume.douglas_rachford import DouglasRachford
from recon.volume.lean_tv import LeanTotalVariation
from recon.volume.literal import LiteralAdmm
from recon.volume.operator_admm import OperatorAdmm

__all__ = ["DouglasRachford", "LeanTotalVariation", "LiteralAdmm", "OperatorAdmm"]
