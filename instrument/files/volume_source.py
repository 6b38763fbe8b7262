"""A stored volume to be looked at plane by plane: what is not looked at is not read."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.errors import FileError
from instrument.files.volume_zarr import is_zarr_name

Plane = npt.NDArray[np.float32]
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
    """

    def __init__(
        self,
        path: Path,
        levels: list[Callable[[Any, Any, Any], npt.NDArray[Any]]],
        shapes: list[tuple[int, int, int]],
        n_channels: int,
        close: Callable[[], object] | None = None,
    ) -> None:
        self.path = path
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

    def _read(self, read: Callable[[Any, Any, Any], npt.NDArray[Any]], z: Any, y: Any, x: Any) -> Plane:
        try:
            with self._lock:
                voxels = np.asarray(read(z, y, x), np.float32)
        except (OSError, ValueError) as error:
            raise FileError(self.path, f"cannot be read at plane {z}: {error}.") from error
        # A damaged voxel must not make the whole view blank.
        voxels = np.nan_to_num(voxels, nan=0.0, posinf=0.0, neginf=0.0)
        return voxels[..., 0] if self.n_channels == 1 else voxels


def open_volume(path: Path | str) -> VolumeSource:
    """Open a volume: OME-Zarr (``z, y, x`` or ``c, z, y, x``), TIFF (``ZYX``, ``ZCYX``, or pages), .npy.

    Raises
    ------
    FileError
        When it is no volume, or the file is damaged; it names the shape that was found.
    """
    path = Path(path)
    if not path.exists():
        raise FileError(path, "there is no such file.")
    if is_zarr_name(path) or (path / "zarr.json").is_file():
        return _open_zarr(path)
    if path.suffix.lower() == ".npy":
        return _open_npy(path)
    if path.suffix.lower() in (".tif", ".tiff"):
        return _open_tiff(path)
    raise FileError(path, "is no volume: an OME-Zarr folder, a TIFF or a .npy file is expected.")


def volume_in_memory(voxels: npt.NDArray[Any], path: Path) -> VolumeSource:
    """Return a source of an array, (n_z, height, width) or (n_z, height, width, n_channels).

    ``path`` is what messages call it. The array may be a memory map.

    Raises
    ------
    FileError
        When it has another number of axes, or no voxel.
    """
    if voxels.ndim not in (3, 4) or 0 in voxels.shape or voxels.dtype.kind not in "uif":
        raise FileError(
            path,
            f"holds {voxels.dtype} {voxels.shape}; a volume of real numbers is expected: planes, rows, "
            "columns, and perhaps channels.",
        )
    view = voxels[..., None] if voxels.ndim == 3 else voxels
    shape = (view.shape[0], view.shape[1], view.shape[2])
    return VolumeSource(path, [lambda z, y, x: view[z, y, x]], [shape], view.shape[3])


def _open_zarr(path: Path) -> VolumeSource:
    import zarr

    try:
        group: Any = zarr.open_group(path, mode="r")
        multiscale = group.attrs["ome"]["multiscales"][0]
        names = [axis["name"] for axis in multiscale["axes"]]
        arrays = [group[dataset["path"]] for dataset in multiscale["datasets"]]
    except (OSError, KeyError, IndexError, TypeError, ValueError) as error:
        raise FileError(path, f"is no OME-Zarr 0.5 image: {error!r}.") from error
    if names not in (["z", "y", "x"], ["c", "z", "y", "x"]):
        raise FileError(path, f"has the axes {', '.join(names)}; a volume has z, y, x, or c before them.")

    def reader(array: Any) -> Callable[[Any, Any, Any], npt.NDArray[Any]]:
        if len(names) == 3:
            return lambda z, y, x: np.asarray(array[z, y, x])[..., None]
        return lambda z, y, x: np.moveaxis(np.asarray(array[:, z, y, x]), 0, -1)

    shapes = [(a.shape[-3], a.shape[-2], a.shape[-1]) for a in arrays]
    n_channels = 1 if len(names) == 3 else int(arrays[0].shape[0])
    return VolumeSource(path, [reader(a) for a in arrays], shapes, n_channels)


def _open_npy(path: Path) -> VolumeSource:
    try:
        return volume_in_memory(np.load(path, mmap_mode="r", allow_pickle=False), path)
    except (ValueError, EOFError, OSError) as error:
        raise FileError(path, f"is no plain .npy array: {error}.") from error


def _open_tiff(path: Path) -> VolumeSource:
    """Map the file where it lies in one piece, else read it page by page."""
    import tifffile

    try:
        tiff = tifffile.TiffFile(path)
    except (OSError, tifffile.TiffFileError) as error:
        raise FileError(path, f"is no TIFF: {error}.") from error
    series: Any = tiff.series[0]
    axes = series.axes.replace("S", "C")
    if len(axes) == 3 and axes.endswith("YX"):
        axes = "ZYX"  # a stack of pages from elsewhere: whatever its axis is called, it is the depth
    shape = dict(zip(axes, series.shape, strict=True))
    if axes not in ("ZYX", "ZCYX", "ZYXC"):
        tiff.close()
        raise FileError(
            path, f"holds {series.axes} {series.shape}; a volume (ZYX, with or without C) is expected."
        )
    if series.dataoffset is not None and series.dtype.byteorder in ("=", "|", "<"):
        tiff.close()
        mapped = tifffile.memmap(path, mode="r")
        return volume_in_memory(np.moveaxis(mapped, 1, -1) if axes == "ZCYX" else mapped, path)
    per_plane = shape.get("C", 1) if axes == "ZCYX" else 1

    def read(z: Any, y: Any, x: Any) -> npt.NDArray[Any]:
        numbers = [z] if isinstance(z, int) else list(range(*z.indices(shape["Z"])))
        planes = []
        for number in numbers:
            pages = [series[number * per_plane + c].asarray() for c in range(per_plane)]
            whole = np.stack(pages, axis=-1) if axes != "ZYXC" else pages[0]
            planes.append(whole[y, x])
        return planes[0] if isinstance(z, int) else np.stack(planes)

    size = (shape["Z"], shape["Y"], shape["X"])
    return VolumeSource(path, [read], [size], shape.get("C", 1), tiff.close)
