"""Views of a volume as a whole: the brightest along each axis, and depth as colour, one plane at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from instrument.files.volumes import VolumeSource

Grey = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Projections:
    """Brightest voxels along each axis; of colour volumes, of the channels' mean.

    Attributes
    ----------
    front : ndarray, float32, (height, width)
        Over depth.
    deepest : ndarray, int32, (height, width)
        The plane in which the brightest voxel of ``front`` lies.
    top : ndarray, float32, (n_z, width)
        Over y.
    side : ndarray, float32, (n_z, height)
        Over x.
    """

    front: Grey
    deepest: npt.NDArray[np.int32]
    top: Grey
    side: Grey


def project(source: VolumeSource, advance: Callable[[int, int], object] | None = None) -> Projections:
    """Return the brightest voxels along each axis, with one plane in memory at a time.

    Parameters
    ----------
    source : VolumeSource
    advance : callable, optional
        ``advance(planes done, planes)`` after each plane; may raise to end the work.

    Raises
    ------
    FileError
        When the volume cannot be read.
    """
    n_z, height, width = source.shape
    front = np.full((height, width), -np.inf, np.float32)
    deepest = np.zeros((height, width), np.int32)
    top, side = np.empty((n_z, width), np.float32), np.empty((n_z, height), np.float32)
    for z in range(n_z):
        plane = grey(source.plane(z))
        nearer = plane > front
        np.maximum(front, plane, out=front)
        deepest[nearer] = z
        plane.max(axis=0, out=top[z])
        plane.max(axis=1, out=side[z])
        if advance is not None:
            advance(z + 1, n_z)
    return Projections(front, deepest, top, side)


def grey(plane: Grey) -> Grey:
    """Return the channels' mean of a colour plane; a grey one as it is."""
    return plane if plane.ndim == 2 else plane.mean(axis=-1, dtype=np.float32)


def in_colour_of_depth(
    front: Grey, deepest: npt.NDArray[np.integer], n_z: int, white: float
) -> npt.NDArray[np.float64]:
    """Return the brightest voxels over depth, (height, width, 3) in 0 to 1, their hue by their depth.

    Blue is the first plane, red the last. ``white`` is the value shown at full brightness.
    """
    from matplotlib import colormaps

    hue = colormaps["turbo"](0.1 + 0.8 * np.arange(n_z) / max(n_z - 1, 1))[:, :3]
    shown: npt.NDArray[np.float64] = hue[deepest] * (front / white).clip(0, 1)[..., None]
    return shown
