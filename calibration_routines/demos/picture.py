"""The demo's picture as it is judged and shown: brightness corrected, cut to the screen, the right way up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from drivers.simulated.world import SimulatedWorld
from recon.arrays import Float32Array
from recon.base.metrics import psnr, scale_to, ssim

if TYPE_CHECKING:
    from calibration_routines.demos.measured import Measured
    from calibration_routines.demos.settings import DemoSettings

Float = Float32Array


@dataclass(frozen=True, slots=True)
class Field:
    """The rows and columns of a reconstruction that show the scene."""

    rows: slice
    columns: slice

    def of(self, image: Float) -> Float:
        """Cut the field out of an image on the reconstruction's grid."""
        return image[self.rows, self.columns]


@dataclass(frozen=True, slots=True)
class Comparison:
    """How close a picture is to the truth, inside a field."""

    psnr_db: float
    ssim: float
    """With the truth's maximum as peak."""
    scale: float
    """The one factor by which the picture was multiplied: least squares, no offset."""


def scene_field(
    shape: tuple[int, int], centre: tuple[int, int], size_um: tuple[float, float], object_pitch_um: float
) -> Field:
    """Return the pixels that lie wholly inside a scene centred on the axis.

    Parameters
    ----------
    shape, centre : (int, int)
        Of the reconstruction's grid; ``centre`` is the pixel on the axis.
    size_um : (float, float)
        Height and width of the scene.
    object_pitch_um : float
        Pitch of the reconstruction in the scene's plane.
    """
    slices = []
    for n, middle, size in zip(shape, centre, size_um, strict=True):
        reach = int(np.floor(size / 2 / object_pitch_um - 0.5))
        slices.append(slice(max(0, middle - reach), min(n, middle + reach + 1)))
    return Field(slices[0], slices[1])


def compare(image: Float, truth: Float, field: Field) -> Comparison:
    """Compare a reconstruction with the truth on the same grid, inside ``field``."""
    seen, true = field.of(image), field.of(truth)
    scale = scale_to(seen, true)
    return Comparison(psnr(scale * seen, true), ssim(scale * seen, true), scale)


class Viewer:
    """Knows the reconstruction's grid, the truth on it, and the response over the field.

    Attributes
    ----------
    truth : ndarray, float32, (height, width, 3)
        The scene's radiance on the reconstruction's grid, upside down as the reconstruction is.
    collected : ndarray, float32, (height, width)
        What of its green light the camera collects from every direction: the object of one convolution (Kuo
        2020, Eq. 4.3).
    field : Field
        The pixels that show the screen.
    object_pitch_um : float
        Pitch of the reconstruction in the scene's plane.
    """

    def __init__(self, world: SimulatedWorld, settings: DemoSettings, measured: Measured) -> None:
        geometry = measured.calibration.calibration.geometry
        height, width = measured.lights.measurement.shape[:2]
        shape = (height, width)
        pitch, d_mm = geometry.pixel_pitch_um, geometry.diffuser_distance_mm
        if pitch is None or d_mm is None:
            raise ValueError("The demo's bench knows its pixel pitch and the distance d.")
        z_um = settings.scene_z_um
        self.object_pitch_um = pitch * z_um / (1e3 * d_mm)
        world.set_scene(settings.scene())
        self.truth = np.asarray(world.ground_truth(shape, pitch, color=True), np.float32)
        self.collected = np.asarray(world.ground_truth(shape, pitch, color=True, collected=True)[..., 1])
        self.field = scene_field(
            shape, (shape[0] // 2, shape[1] // 2), settings.scene_size_um, self.object_pitch_um
        )
        response = measured.response.on_grid(shape, pitch, 1e3 * d_mm, lambertian=True)
        self._response = response[..., None]

    def picture(self, image: Float) -> Float:
        """Return a reconstruction with the brightness lost off the axis restored."""
        corrected: Float = image / self._response
        return corrected

    def upright(self, image: Float, margin: int = 0) -> Float:
        """Return the field of an image, and ``margin`` pixels around it, the right way up."""
        rows, columns = (
            slice(max(0, part.start - margin), part.stop + margin)
            for part in (self.field.rows, self.field.columns)
        )
        return np.ascontiguousarray(image[rows, columns][::-1, ::-1])
