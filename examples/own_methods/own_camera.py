"""A camera model of one's own: PSFs alike over the field, and a sensor that sees less towards its corners."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.base import LinearOperator
from recon.camera.camera_model import Depths, OfferedCamera
from recon.camera.convolution import Convolution

Array = npt.NDArray[Any]

CORNER = 0.5
"""Light that is left in the corners: measure it with a flat field."""


class Vignetting(LinearOperator):
    """``A x = gain * (C x)``: a gain for every pixel after another camera."""

    def __init__(self, camera: LinearOperator, gain: Array) -> None:
        super().__init__(camera.domain_shape, camera.range_shape, camera.dtype)
        self.camera, self.gain = camera, np.asarray(gain, camera.dtype)

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return what the sensor sees."""
        return np.multiply(self.camera.forward(x), self.gain, out=out)

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Return the camera's adjoint of the weighted data."""
        return self.camera.adjoint(y * self.gain, out)

    @property
    def norm_bound(self) -> float:
        """The camera's, times the largest gain."""
        return float(self.gain.max()) * self.camera.norm_bound


def make(central: Convolution, _depths: Depths) -> Vignetting:
    """Return the camera of one channel; the gain falls with the square of the distance from the middle."""
    y, x = (np.linspace(-1, 1, n) for n in central.range_shape[1:])
    return Vignetting(central, 1 - (1 - CORNER) * (y[:, None] ** 2 + x**2) / 2)


CAMERA = OfferedCamera(name="vignetting", help="One PSF a depth; darker towards the corners.", make=make)
