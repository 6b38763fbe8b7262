"""Linear operators: how an object becomes data, with exact adjoints."""

from recon.operators.background import BackgroundRemoval
from recon.operators.base import Composition, LinearOperator, estimate_norm
from recon.operators.convolution import PadCropConvolution
from recon.operators.convolution3d import Convolution3D
from recon.operators.erasures import Erasures
from recon.operators.local_convolution import FieldOfPsfs, local_convolution
from recon.operators.low_rank import PrincipalPsfs, low_rank, principal_psfs
from recon.operators.spatially_varying import SpatiallyVarying
from recon.operators.strips import Part, Strip
from recon.operators.two_part import two_part_field

__all__ = [
    "BackgroundRemoval",
    "Composition",
    "Convolution3D",
    "Erasures",
    "FieldOfPsfs",
    "LinearOperator",
    "PadCropConvolution",
    "Part",
    "PrincipalPsfs",
    "SpatiallyVarying",
    "Strip",
    "estimate_norm",
    "local_convolution",
    "low_rank",
    "principal_psfs",
    "two_part_field",
]
