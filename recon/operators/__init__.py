"""Linear operators: how an object becomes data, with exact adjoints."""

from recon.operators.background import BackgroundRemoval
from recon.operators.base import Composition, LinearOperator, estimate_norm
from recon.operators.convolution import PadCropConvolution
from recon.operators.convolution3d import Convolution3D
from recon.operators.erasures import Erasures

__all__ = [
    "BackgroundRemoval",
    "Composition",
    "Convolution3D",
    "Erasures",
    "LinearOperator",
    "PadCropConvolution",
    "estimate_norm",
]
