"""A volume's voxels, read when they are looked at: from a file, from memory, brought to equal sizes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from instrument.files.errors import FileError
from instrument.volumes.grid_facts import grid_facts
from recon.arrays import Array, Float32Array

if TYPE_CHECKING:
    from recon.camera.grid import Grid

Plane = Float32Array
_SIDE_PIXELS = 1 << 20
"""Slices along depth are read from the finest level whose planes are no larger: each touches every plane."""


class VolumeSource:
    """Voxels that are read when they are asked for; may be asked from any thread.

    Parameters
    ----------
    path : Path
        Where it lies, for messages.
    levels : sequence of callable
        ``read(z, y, x)`` takes slices or numbers and returns (..., n_channels); the finest level first.
    shapes : sequence of (int, int, int)
        ``(n_z, height, width)`` of each level.
    n_channels : int
    close : callable, optional
        Closes the files.
    facts : mapping
        What its file tells of its grid, as :func:`grid_facts` has it.
    """

    def __init__(
        self,
        path: Path,
        levels: list[Callable[[Any, Any, Any], Array]],
        shapes: list[tuple[int, int, int]],
        n_channels: int,
        close: Callable[[], object] | None = None,
        facts: Mapping[str, Any] | None = None,
    ) -> None:
        self.path = path
        self.facts = facts or {}
        self.shape = shapes[0]
        self.n_channels = n_channels
        self._levels = levels
        self._shapes = shapes
        self._close = close
        self._lock = threading.Lock()  # readers of files are not made for several threads

    @property
    def n_bytes(self) -> int:
        """Bytes of all voxels, were they in memory."""
        return 4 * int(np.prod(self.shape)) * self.n_channels

    def plane(self, z: int) -> Plane:
        """Return a plane, float32 (height, width) or (height, width, n_channels)."""
        return self._read(self._levels[0], z, slice(None), slice(None))

    def across_y(self, y: int) -> Plane:
        """Return the slice at row ``y``, float32 (n_z, width[, n_channels]); coarser for large planes."""
        level = self._side_level()
        rows = self._shapes[level][1]
        row = min(y * rows // self.shape[1], rows - 1)
        return self._read(self._levels[level], slice(None), row, slice(None))

    def across_x(self, x: int) -> Plane:
        """Return the slice at column ``x``, float32 (n_z, height[, n_channels]); coarser as above."""
        level = self._side_level()
        columns = self._shapes[level][2]
        column = min(x * columns // self.shape[2], columns - 1)
        return self._read(self._levels[level], slice(None), slice(None), column)

    def close(self) -> None:
        """Close the files; nothing can be read afterwards."""
        if self._close is not None:
            with self._lock:
                self._close()

    def _side_level(self) -> int:
        for level, (_, height, width) in enumerate(self._shapes):
            if height * width <= _SIDE_PIXELS:
                return level
        return len(self._shapes) - 1

    def _read(self, read: Callable[[Any, Any, Any], Array], z: Any, y: Any, x: Any) -> Plane:
        try:
            with self._lock:
                voxels = np.asarray(read(z, y, x), np.float32)
        except Exception as error:
            raise FileError(self.path, f"cannot be read at plane {z}: {error!s:.200}.") from error
        # A damaged voxel must not make the whole view blank.
        voxels = np.nan_to_num(voxels, nan=0.0, posinf=0.0, neginf=0.0)
        return voxels[..., 0] if self.n_channels == 1 else voxels


def volume_in_memory(voxels: Array, path: Path, facts: Mapping[str, Any] | None = None) -> VolumeSource:
    """Return a source of an array, (n_z, height, width) or (n_z, height, width, n_channels).

    ``path`` is what messages call it, ``facts`` as :class:`VolumeSource`. The array may be a memory map.

    Raises FileError when it has another number of axes, or no voxel.
    """
    if voxels.ndim not in (3, 4) or 0 in voxels.shape or voxels.dtype.kind not in "uif":
        raise FileError(
            path,
            f"holds {voxels.dtype} {voxels.shape}; a volume of real numbers is expected: planes, rows, "
            "columns, and perhaps channels.",
        )
    view = voxels[..., None] if voxels.ndim == 3 else voxels
    shape = (view.shape[0], view.shape[1], view.shape[2])
    return VolumeSource(path, [lambda z, y, x: view[z, y, x]], [shape], view.shape[3], facts=facts)


def metric_source(source: VolumeSource, grid: Grid, voxel_um: float | None = None) -> VolumeSource:
    """Return a volume on voxels of equal size; its planes are made when they are looked at.

    ``grid`` is that of ``source``, ``voxel_um`` the edge of a cube (default: see
    :func:`recon.camera.grid.metric_grid`). Closing the one closes the other.

    Raises InputError where the grid is not known or has one plane.
    """
    from recon.camera.grid import metric_grid, metric_planes

    metric = metric_grid(grid, voxel_um)
    made = metric_planes(source.plane, grid, metric)

    def read(z: Any, y: Any, x: Any) -> Array:
        if isinstance(z, int):
            plane: Array = made(z)
            return plane[y, x] if plane.ndim == 3 else plane[y, x, None]
        return np.stack([read(k, y, x) for k in range(*z.indices(metric.shape[0]))])

    facts = grid_facts(metric)
    return VolumeSource(source.path, [read], [metric.shape], source.n_channels, source.close, facts)
