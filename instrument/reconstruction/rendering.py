"""A volume from any side: its brightest voxels, their depth as colour, at the rate of a film."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from instrument.reconstruction.result_figures import grey
from instrument.volumes.source import VolumeSource
from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_mean
from recon.base.threads import in_blocks

Voxels = npt.NDArray[np.uint16]
MOST_VOXELS = 512 * 512 * 64
"""Larger volumes are averaged laterally, by blocks, for this view."""
_FULL = 65535
_AXES = {0: (0, 1, 2), 1: (1, 0, 2), 2: (2, 0, 1)}
"""Order of the axes z, y, x for looking along one of them: slices, then down, then to the right."""


@dataclass(frozen=True, slots=True)
class Pose:
    """From where a volume is seen, in degrees; 0, 0: along depth, from the first plane."""

    azimuth_deg: float = 0.0
    """Turn about the vertical."""
    elevation_deg: float = 0.0
    """Then about the horizontal, at most 90 either way."""

    def turned(self, azimuth_deg: float, elevation_deg: float) -> Pose:
        """Return the pose turned further."""
        tilt = min(max(self.elevation_deg + elevation_deg, -90.0), 90.0)
        return Pose((self.azimuth_deg + azimuth_deg) % 360.0, tilt)

    @property
    def matrix(self) -> Float64Array:
        """Rotation, (3, 3), from the volume's z, y, x to depth, down and right of the view."""
        a, e = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        about_y = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]])
        about_x = np.array([[math.cos(e), math.sin(e), 0], [-math.sin(e), math.cos(e), 0], [0, 0, 1]])
        rotation: Float64Array = about_x @ about_y
        return rotation


class Renderer:
    """Draws a volume from any side by shear and warp (Lacroute and Levoy 1994), in parallel projection.

    For each of the three axes there is a copy of the voxels whose slices lie across it, so that the inner
    loop runs along memory. Of two voxels behind each other the brighter is seen.

    Parameters
    ----------
    voxels : ndarray, uint16, (n_z, height, width)
    step : float
        From plane to plane, in lateral voxels.
    white : float
        What the largest voxel, 65535, stands for.
    """

    def __init__(self, voxels: Voxels, step: float = 1.0, white: float = 1.0) -> None:
        self.shape: tuple[int, int, int] = voxels.shape
        self.white = white
        self.scale = np.array([step, 1.0, 1.0])
        self.reduced = 1
        """Side of the blocks of the volume that a lateral voxel is the mean of."""
        self._copies = {axis: np.ascontiguousarray(voxels.transpose(order)) for axis, order in _AXES.items()}

    @classmethod
    def of(
        cls,
        source: VolumeSource,
        step_voxels: float | None = None,
        advance: Callable[[int, int], object] | None = None,
    ) -> Renderer:
        """Read a volume; of colour volumes the channels' mean, of large ones block means.

        ``step_voxels`` is the distance of planes in lateral voxels; None, where it is not known: such that
        the volume is half as deep as wide. ``advance``: ``advance(planes done, planes)`` after each plane.

        Raises FileError when it cannot be read.
        """
        n_z, height, width = source.shape
        block = 1
        while n_z * (height // block) * (width // block) > MOST_VOXELS:
            block += 1
        read = np.empty((n_z, height // block, width // block), np.float32)
        for z in range(n_z):
            plane = grey(source.plane(z))[: height // block * block, : width // block * block]
            read[z] = np.nan_to_num(block_mean(plane, block) if block > 1 else plane)
            if advance is not None:
                advance(z + 1, n_z)
        white = max(float(read.max()), 1e-30)
        step = 0.5 * max(read.shape[1:]) / n_z if step_voxels is None else step_voxels / block
        np.multiply(read, _FULL / white, out=read)
        made = cls(np.clip(read, 0, _FULL, out=read).astype(np.uint16), step, white)
        made.reduced = block
        return made

    @property
    def extent(self) -> float:
        """Its diagonal, in lateral voxels: a view so large shows all of it from every side."""
        return float(np.linalg.norm(np.array(self.shape) * self.scale))

    def draw(
        self,
        pose: Pose,
        size: tuple[int, int],
        zoom: float,
        levels: tuple[float, float],
        shades: npt.NDArray[np.uint8],
    ) -> npt.NDArray[np.uint8]:
        """Return a view, uint8, (height, width, 3).

        Parameters
        ----------
        pose : Pose
        size : (int, int)
            Height and width of the view, pixels.
        zoom : float
            Pixels of the view for a lateral voxel.
        levels : (float, float)
            Values that are shown black and white.
        shades : ndarray, uint8, (n_planes or 1, 256, 3)
            Colours by plane, dark to bright.
        """
        from instrument.reconstruction import _render_kernels as kernels

        view = pose.matrix @ np.diag(self.scale)  # voxels to the view
        towards = np.linalg.solve(view, [1.0, 0.0, 0.0])
        axis = int(np.argmax(np.abs(towards)))
        order = _AXES[axis]
        slices = self._copies[axis]
        n = len(slices)
        slope = -towards[list(order[1:])] / towards[axis]
        shifts = np.rint(np.outer(np.arange(n) - (n - 1) / 2, slope)).astype(np.int64)
        least = shifts.min(axis=0)
        shifts -= least
        high_, wide = np.array(slices.shape[1:]) + shifts.max(axis=0)
        best, where = np.empty((high_, wide), np.uint16), np.empty((high_, wide), np.uint16)
        down, right = np.ascontiguousarray(shifts[:, 0]), np.ascontiguousarray(shifts[:, 1])
        in_blocks(
            lambda start, stop: kernels.brightest(start, stop, best, where, slices, down, right, axis == 0),
            len(best),
        )
        # The slice in the middle is not sheared: where its voxels are in the view, its copies' shears are.
        middle = (np.array(slices.shape[1:]) - 1) / 2 - least
        to_view = view[1:, list(order[1:])] * zoom
        warp = np.empty((2, 3))
        warp[:, :2] = np.linalg.inv(to_view)
        warp[:, 2] = middle - warp[:, :2] @ ((np.array(size) - 1) / 2)
        out = np.empty((*size, 3), np.uint8)
        low, high = (level / self.white * _FULL for level in levels)
        high = max(high, low + 1)
        in_blocks(
            lambda start, stop: kernels.draw(start, stop, out, best, where, warp, low, high, shades), len(out)
        )
        return out

    def along_depth(self, rows: slice, columns: slice) -> Float32Array:
        """Return the mean of a window of the volume in each plane, float32, (n_z,); rows of the volume."""
        b = self.reduced
        n_rows, n_columns = self._copies[0].shape[1:]
        top, left = min(rows.start // b, n_rows - 1), min(columns.start // b, n_columns - 1)
        bottom, right = max(-(-rows.stop // b), top + 1), max(-(-columns.stop // b), left + 1)
        inside = self._copies[0][:, top:bottom, left:right]
        means: Float32Array = inside.mean(axis=(1, 2), dtype=np.float32)
        return means * np.float32(self.white / _FULL)


def depth_shades(n_planes: int) -> npt.NDArray[np.uint8]:
    """Return the colours of planes by level, uint8, (n_planes, 256, 3): blue first, red last."""
    from matplotlib import colormaps

    hue = colormaps["turbo"](0.1 + 0.8 * np.arange(n_planes) / max(n_planes - 1, 1))[:, None, :3]
    return np.asarray(np.round(hue * np.arange(256)[:, None]), np.uint8)
