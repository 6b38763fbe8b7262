"""Volumes opened to be looked at plane by plane (OME-Zarr, TIFF, NumPy); nothing else is read of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.errors import FileError
from instrument.files.ome_tiff import tiff_facts
from instrument.files.ome_zarr import is_zarr_name
from instrument.files.pieces import piece_bytes
from instrument.files.reading import folder_bytes, require_file, require_plausible, stored_bytes
from instrument.files.tiff_pages import open_tiff
from instrument.volumes.source import VolumeSource, volume_in_memory
from recon.arrays import Array


def open_volume(path: Path | str) -> VolumeSource:
    """Open a volume: OME-Zarr (``z, y, x`` or ``c, z, y, x``), TIFF (``ZYX``, ``ZCYX``, or pages), .npy.

    Raises FileError when it is no volume, or the file is damaged; it names the shape that was found.
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


_SPARSE_BYTES = 1 << 33
"""An OME-Zarr leaves chunks of zeros out and is read plane by plane: a volume by l1 shrinks 500-fold."""


def _open_zarr(path: Path) -> VolumeSource:
    import zarr

    try:
        group: Any = zarr.open_group(path, mode="r")
        multiscale = group.attrs["ome"]["multiscales"][0]
        names = [axis["name"] for axis in multiscale["axes"]]
        facts = group.attrs.get("diffuserbench")
        arrays = [group[dataset["path"]] for dataset in multiscale["datasets"]]
        stored = folder_bytes(path, arrays[0].nbytes, [(path / one.path, piece_bytes(one)) for one in arrays])
        for array in arrays:
            require_plausible(path, array.nbytes, stored, small=_SPARSE_BYTES)
            if len(array.shape) != len(names) or 0 in array.shape:
                raise FileError(path, f"holds an array of shape {array.shape} for {len(names)} axes.")
            require_plausible(path, array.nbytes // array.shape[-3], stored)  # a plane
    except FileError:
        raise
    except Exception as error:
        raise FileError(path, f"is no OME-Zarr 0.5 image: {error!r:.200}.") from error
    if names not in (["z", "y", "x"], ["c", "z", "y", "x"]):
        found = ", ".join(map(str, names))
        raise FileError(path, f"has the axes {found}; a volume has z, y, x, or c before them.")

    def reader(array: Any) -> Callable[[Any, Any, Any], Array]:
        if len(names) == 3:
            return lambda z, y, x: np.asarray(array[z, y, x])[..., None]
        return lambda z, y, x: np.moveaxis(np.asarray(array[:, z, y, x]), 0, -1)

    shapes = [(a.shape[-3], a.shape[-2], a.shape[-1]) for a in arrays]
    n_channels = 1 if len(names) == 3 else int(arrays[0].shape[0])
    facts = facts if isinstance(facts, Mapping) else None
    return VolumeSource(path, [reader(a) for a in arrays], shapes, n_channels, facts=facts)


def _open_npy(path: Path) -> VolumeSource:
    from instrument.files.decoding import require_npy

    try:
        require_npy(path)
        return volume_in_memory(np.load(path, mmap_mode="r", allow_pickle=False), path)
    except Exception as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, f"is no plain .npy array: {error}.") from error


def _open_tiff(path: Path) -> VolumeSource:
    """Map the file where it lies in one piece, else read it page by page."""
    import tifffile

    tiff = None
    try:
        require_file(path)
        tiff = open_tiff(path)
        series: Any = tiff.series[0]
        require_plausible(path, series.size * series.dtype.itemsize, stored_bytes(path))
    except FileError:
        if tiff is not None:
            tiff.close()
        raise
    except Exception as error:
        if tiff is not None:
            tiff.close()
        raise FileError(path, f"is no TIFF, or a damaged one: {error!r:.200}.") from error
    facts = tiff_facts(tiff)
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
        try:
            mapped = tifffile.memmap(path, mode="r")
        except Exception as error:
            raise FileError(path, f"is damaged: {error!r:.200}.") from error
        return volume_in_memory(np.moveaxis(mapped, 1, -1) if axes == "ZCYX" else mapped, path, facts)
    per_plane = shape.get("C", 1) if axes == "ZCYX" else 1

    def read(z: Any, y: Any, x: Any) -> Array:
        numbers = [z] if isinstance(z, int) else list(range(*z.indices(shape["Z"])))
        planes = []
        for number in numbers:
            pages = [series[number * per_plane + c].asarray() for c in range(per_plane)]
            whole = np.stack(pages, axis=-1) if axes != "ZYXC" else pages[0]
            planes.append(whole[y, x])
        return planes[0] if isinstance(z, int) else np.stack(planes)

    size = (shape["Z"], shape["Y"], shape["X"])
    return VolumeSource(path, [read], [size], shape.get("C", 1), tiff.close, facts)
