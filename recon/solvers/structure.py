"""The structures that fast solvers look for in an operator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.camera.base import Array, Composition, LinearOperator
from recon.camera.convolution import PadCropConvolution
from recon.camera.erasures import Erasures
from recon.errors import StructureError


@dataclass(frozen=True)
class CroppedConvolution:
    """``diag(weight) C F^-1 diag(H) F``: a circular convolution of which a window is measured.

    Attributes
    ----------
    convolution : PadCropConvolution
    weight : ndarray, ``range_shape``
        1 where the pixel was measured, 0 where it was erased.
    """

    convolution: PadCropConvolution
    weight: Array


def as_cropped_convolution(operator: LinearOperator) -> CroppedConvolution:
    """Return an operator's structure as a cropped convolution.

    Raises
    ------
    StructureError
        When it is something else.
    """
    weight = np.ones(operator.range_shape, operator.dtype)
    inner = operator
    while isinstance(inner, Composition) and isinstance(inner.outer, Erasures):
        weight *= inner.outer.valid
        inner = inner.inner
    if isinstance(inner, PadCropConvolution):
        return CroppedConvolution(inner, weight)
    raise StructureError(
        f"This solver needs a PadCropConvolution, with or without Erasures; got {type(inner).__name__}. "
        "Fista takes any operator."
    )
