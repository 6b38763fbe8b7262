"""The mask's pose relative to the SLM's image: as parameters, as a displacement field, as a vector to fit."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields, replace

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the mask is relative to the SLM's image.

    The mask cell at ``X`` (mask pixels from the centre) sees the SLM's image at::

        (1 + scale) R(roll) X + shift + cubic (|X|^2 - c) X,   z + yaw x + pitch y downstream of it

    where ``c`` makes the cubic term orthogonal to ``scale`` over the mask.

    Attributes
    ----------
    shift_x, shift_y : float
        Mask pixels.
    roll_mrad, scale : float
        Rotation about the axis; relay magnification less one.
    cubic : float
        Third-order radial distortion: ``cubic |X|^3`` at the mask's corners, mask pixels.
    z_um, pitch_mrad, yaw_mrad : float
        Distance on the axis; tilts about x and y.
    """

    shift_x: float = 0.0
    shift_y: float = 0.0
    roll_mrad: float = 0.0
    scale: float = 0.0
    cubic: float = 0.0
    z_um: float = 0.0
    pitch_mrad: float = 0.0
    yaw_mrad: float = 0.0

    def vector(self) -> npt.NDArray[np.float64]:
        """Return the parameters as a vector, in the order of :data:`NAMES`."""
        return np.array(astuple(self))

    def plus(self, change: npt.NDArray[np.float64]) -> Pose:
        """Return the pose with a vector of changes added."""
        return Pose(*(float(v) for v in self.vector() + change))

    def with_(self, **values: float) -> Pose:
        """Return the pose with some parameters replaced."""
        return replace(self, **values)

    def displacement(self, mask_shape: tuple[int, int]) -> npt.NDArray[np.float64]:
        """Return the displacement field for :class:`recon.holography.Display`.

        It is (*NODES, 2), in mask pixels.
        """
        height, width = mask_shape
        y, x = nodes_of(mask_shape)
        c, s = np.cos(self.roll_mrad * 1e-3), np.sin(self.roll_mrad * 1e-3)
        corner = 0.5 * np.hypot(height, width)
        r2 = x**2 + y**2
        radial = self.cubic * (r2 - (r2**2).mean() / r2.mean()) / corner**3
        sx = (1 + self.scale) * (c * x - s * y) + self.shift_x + radial * x
        sy = (1 + self.scale) * (s * x + c * y) + self.shift_y + radial * y
        return np.stack([sy - y, sx - x], axis=-1)


NODES = (13, 23)
"""Of displacement fields, from edge to edge of the mask; they hold a third-order field to a few per mille."""


def nodes_of(mask_shape: tuple[int, int]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return y and x of the nodes of displacement fields, mask pixels from the centre."""
    y, x = ((np.linspace(0, 1, n) - 0.5) * size for n, size in zip(NODES, mask_shape, strict=True))
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    return grid_y, grid_x


NAMES = tuple(field.name for field in fields(Pose))


def natural_steps(
    mask_shape: tuple[int, int], factor: int, pitch_um: float, depth_um: float
) -> npt.NDArray[np.float64]:
    """Return changes of each parameter that cost a spot a third to a half of its light.

    Parameters
    ----------
    mask_shape : (int, int)
    factor : int
        Mask pixels per SLM pixel: a spot is lost when the mask is off by this much.
    pitch_um : float
        Of the mask's pixels.
    depth_um : float
        Distance at which an SLM pattern has lost half of a spot (:func:`recon.holography.spots.depth_um`).
    """
    half_y, half_x = 0.5 * mask_shape[0], 0.5 * mask_shape[1]
    move, edge, depth = 0.4 * factor, 0.7 * factor, 0.7 * depth_um
    tilts = [1e3 * depth / (half * pitch_um) for half in (half_y, half_x)]
    return np.array([move, move, 1e3 * edge / half_x, edge / half_x, 4.0 * factor, depth, *tilts])
