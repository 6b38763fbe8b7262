"""Hold a reconstruction against the ground truth, where the truth is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.base.metrics import psnr, scale_to, ssim

Float = npt.NDArray[np.float32]


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
    """How close a picture is to the truth, inside a field.

    Attributes
    ----------
    psnr_db, ssim : float
        With the truth's maximum as peak.
    scale : float
        The one factor by which the picture was multiplied: least squares, no offset.
    """

    psnr_db: float
    ssim: float
    scale: float


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
