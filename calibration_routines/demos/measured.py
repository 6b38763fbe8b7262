"""What the camera's demo brings home from the bench."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration_routines.demos.settings import GREEN
from calibration_routines.optics.field_response import FieldResponse
from calibration_routines.optics.photograph import Photograph
from calibration_routines.psf.sweep import SweepCalibration
from recon.arrays import Float32Array


@dataclass(frozen=True, slots=True)
class Measured:
    """What the demo brings home from the bench."""

    calibration: SweepCalibration
    response: FieldResponse
    photos: tuple[Photograph, Photograph, Photograph]
    """Of the screen in red, green and blue, one after the other."""
    lights: Photograph
    """Of the second scene."""
    bench_label: str
    sensitivity: tuple[float, float, float]
    """Of the sensor to red, green and blue, from its data sheet."""

    @property
    def colours(self) -> Float32Array:
        """The three photographs as one measurement, (height, width, 3), each as if exposed as the green one.

        The colours are balanced by the sensor's sensitivity.
        """
        green = self.photos[GREEN].exposure_ms * self.sensitivity[GREEN]
        shares = zip(self.photos, self.sensitivity, strict=True)
        return np.stack(
            [photo.measurement * np.float32(green / (photo.exposure_ms * s)) for photo, s in shares], axis=-1
        )
