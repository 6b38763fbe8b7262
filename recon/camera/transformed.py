"""PSFs moved, enlarged, turned, mirrored: of a camera that was, and decoys for one that was not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float32Array, Float64Array
from recon.errors import InputError

LEAST_BLUR_PX = 0.1
"""Deviation of a Gaussian that takes out nothing worth the time."""


@dataclass(frozen=True, slots=True)
class Transformation:
    """Where the points of a pattern go, about the optical centre: mirrored, turned, enlarged, then moved.

    Attributes
    ----------
    rows, columns : float
        Displacement, pixels.
    scale : float
        Size of the new pattern over that of the old one.
    rotation_deg : float
        From the image's right towards its bottom.
    mirrored : bool
        Whether left and right change places.

    Raises InputError when a number is not finite, or the scale not positive.
    """

    rows: float = 0.0
    columns: float = 0.0
    scale: float = 1.0
    rotation_deg: float = 0.0
    mirrored: bool = False

    def __post_init__(self) -> None:
        if not np.isfinite([self.rows, self.columns, self.rotation_deg]).all():
            raise InputError(f"A displacement and a rotation are finite numbers, not those of {self}.")
        if not 0 < self.scale < np.inf:
            raise InputError(f"A scale is a positive number, not {self.scale}.")

    @property
    def matrix(self) -> Float64Array:
        """The (2, 2) matrix that (row, column) from the centre is multiplied by before it is displaced."""
        turn = np.deg2rad(self.rotation_deg)
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        return self.scale * rotation @ np.diag([1.0, -1.0 if self.mirrored else 1.0])

    def __str__(self) -> str:
        """Say it in words."""
        said = ["mirrored"] if self.mirrored else []
        if self.rotation_deg:
            said.append(f"turned by {self.rotation_deg:+.3g} degrees")
        if self.scale != 1:
            said.append(f"{100 * abs(self.scale - 1):.2g} % {'larger' if self.scale > 1 else 'smaller'}")
        if self.rows or self.columns:
            said.append(f"moved by {self.rows:+.3g} rows and {self.columns:+.3g} columns")
        return ", ".join(said) or "as it is"


def transformed(psfs: npt.ArrayLike, how: Transformation) -> Float32Array:
    """Return PSFs whose pattern is moved, and enlarged, turned, mirrored about the middle; float32.

    Every PSF keeps its light, but for what leaves the image; zeros come in. Cubic splines, and where the
    pattern shrinks, a Gaussian first takes out what the new pixels cannot hold; no negative values that were
    not there.

    Parameters
    ----------
    psfs : array, (..., height, width)
        Background removed.
    how : Transformation
    """
    images = np.asarray(psfs, np.float32)
    middle = geometric_centre(images)
    back = np.linalg.inv(how.matrix)
    displaced = middle + np.array([how.rows, how.columns])
    return resampled(images, back, middle - back @ displaced) / np.float32(how.scale**2)


def geometric_centre(image: Array) -> Float64Array:
    """Return (row, column) of the middle of images (..., height, width)."""
    return (np.array(image.shape[-2:]) - 1) / 2


def resampled(images: Array, matrix: npt.ArrayLike, offset: Float64Array | list[float]) -> Float32Array:
    """Return ``image(matrix v + offset)`` at every pixel ``v`` of images (..., height, width); float32.

    Parameters
    ----------
    images : ndarray, (..., height, width)
    matrix : array, (2, 2) or (2,)
        Of (row, column); (2,) is a diagonal. With a determinant above 1 the pattern shrinks.
    offset : array, (2,)
    """
    from scipy import ndimage

    back = np.asarray(matrix, float)
    area = abs(float(np.prod(back) if back.ndim == 1 else np.linalg.det(back)))
    blur = 0.5 * np.sqrt(max(area - 1, 0.0))
    planes = np.asarray(images, np.float32).reshape(-1, *images.shape[-2:])
    result = np.empty_like(planes)
    for plane, out in zip(planes, result, strict=True):
        source = ndimage.gaussian_filter(plane, blur) if blur > LEAST_BLUR_PX else plane
        ndimage.affine_transform(source, back, offset, output=out, order=3)
        np.clip(out, min(float(plane.min()), 0.0), None, out=out)
    return result.reshape(images.shape)
