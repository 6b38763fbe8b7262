"""Volumes written as OME-Zarr 0.5 and OME-TIFF, whole or not at all, with one plane in memory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from instrument.files.atomic import whole_file, whole_folder
from instrument.files.ome_tiff import annotation, ome_tiff_channels, resolution
from instrument.files.ome_zarr import ome_attributes, ome_channels, stem_of
from instrument.volumes.grid_facts import EVEN, grid_facts, origin_um, scale_in_words, voxel_um
from recon.arrays import Float32Array, Float64Array

if TYPE_CHECKING:
    from recon.camera.grid import Grid

_BIG_TIFF_BYTES = 4_000_000_000
_SMALLEST_LEVEL = 128
"""Levels are halved laterally until the longer side is at most this many pixels."""


def write_volume_zarr(
    path: Path,
    planes: Iterable[Float32Array],
    shape: tuple[int, ...],
    grid: Grid,
    attributes: dict[str, Any],
) -> None:
    """Write a volume as OME-Zarr 0.5, whole or not at all, with one plane in memory.

    A folder of that name is replaced.

    Raises OSError when the disk is full or not writable; what was there before stays as it was.

    Parameters
    ----------
    path : Path
        The folder to be.
    planes : iterable of ndarray, float32
        (height, width) or (height, width, n_channels).
    shape : tuple of int
        That of all, with n_z in front. Stored as ``z, y, x`` or, in OME-Zarr's order, ``c, z, y, x``.
    grid : Grid
        OME-Zarr knows one voxel size for all planes: that of the middle one is written where it is known, and
        what :func:`grid_facts` says beside it in the group's attribute ``diffuserbench``.
    attributes : dict
        JSON-compatible; what else shall stand in the attribute ``diffuserbench``.
    """
    import zarr

    colour = len(shape) == 4
    channels = shape[3:]
    with whole_folder(path) as draft:
        group = zarr.open_group(draft, mode="w", zarr_format=3)
        names = ["c", "z", "y", "x"] if colour else ["z", "y", "x"]
        levels = [1]
        arrays: list[Any] = []
        height, width = shape[1:3]
        while True:
            array = group.create_array(
                str(len(arrays)),
                shape=(*channels, shape[0], height, width),
                dtype=np.float32,
                chunks=(1,) * (1 + len(channels)) + (height, width),
                dimension_names=names,
            )
            arrays.append(array)
            if max(height, width) <= _SMALLEST_LEVEL or min(height, width) < 2:
                break
            height, width = height // 2, width // 2
            levels.append(2 * levels[-1])
        white = 0.0
        for z, plane in enumerate(planes):
            pixels = np.moveaxis(plane, -1, 0) if colour else plane
            white = max(white, float(np.nanmax(plane, initial=0.0)))
            for array in arrays:
                array[..., z, :, :] = pixels
                pixels = _halved(pixels)
        told = ome_attributes(
            path.name,
            names,
            voxel_um(grid),
            levels=levels,
            origin=origin_um(grid),
            more={"type": "local mean"},
        )
        if channels == (3,):
            told["omero"] = ome_channels(white or 1.0, colour=True)
        group.attrs["ome"] = told
        group.attrs["diffuserbench"] = attributes | {"words": scale_in_words(grid)} | grid_facts(grid)


def _halved(pixels: Float32Array) -> Float32Array:
    """Return the mean of 2 x 2 pixels."""
    height, width = (n // 2 for n in pixels.shape[-2:])
    blocks = pixels[..., : 2 * height, : 2 * width].reshape(*pixels.shape[:-2], height, 2, width, 2)
    means: Float32Array = blocks.mean(axis=(-3, -1), dtype=np.float32)
    return means


def write_volume_tiff(path: Path, planes: Iterable[Float32Array], shape: tuple[int, ...], grid: Grid) -> None:
    """Write a volume as OME-TIFF, ``ZYX`` or ``ZCYX``, whole or not at all, with one plane in memory.

    ``planes`` are (height, width) or (height, width, n_channels), ``shape`` is that of all with n_z in front.
    The voxel size is that of the middle plane, where it is known; what :func:`grid_facts` says is annotated.

    Raises FileError or OSError when it cannot be written.
    """
    _write_tiff(path, planes, shape, grid, {})


def write_film_tiff(
    path: Path,
    pictures: Iterable[Float32Array],
    shape: tuple[int, ...],
    grid: Grid | None,
    times_s: Float64Array | None,
    facts: Mapping[str, Any],
) -> None:
    """Write a film as OME-TIFF, ``T``, ``Z`` where it is of volumes, ``C`` where in colour, ``YX``.

    Whole or not at all, with one picture in memory; as :func:`write_volume_tiff`.

    Parameters
    ----------
    pictures : iterable of ndarray, float32, ([n_z,] height, width[, n_channels])
    shape : tuple of int
        Of all of them, how many there are in front.
    grid : Grid, optional
        Where pixels and planes lie in the object; None: not known, and the pictures are flat.
    times_s : ndarray, (n,), optional
        When each was taken; None where that is not known.
    facts : mapping
        JSON-compatible, annotated.
    """
    deep = grid is not None and grid.shape[0] > 1
    planes = (plane for picture in pictures for plane in (picture if deep else picture[None]))
    _write_tiff(path, planes, shape[1:] if deep else (1, *shape[1:]), grid, facts, shape[0], times_s)


def _write_tiff(
    path: Path,
    planes: Iterable[Float32Array],
    shape: tuple[int, ...],
    grid: Grid | None,
    facts: Mapping[str, Any],
    count: int | None = None,
    times_s: Float64Array | None = None,
) -> None:
    """Write ``count`` volumes of a shape with n_z in front, one after the other; None: one, without T."""
    import tifffile

    n_z, height, width, *channels = shape
    deep, colour = count is None or n_z > 1, bool(channels)
    pages = (page for plane in planes for page in (np.moveaxis(plane, -1, 0) if colour else plane[None]))
    sizes = {} if grid is None else {f"PhysicalSize{axis.upper()}": v for axis, v in voxel_um(grid).items()}
    film = count is not None
    metadata: dict[str, Any] = {"axes": "T" * film + "Z" * deep + "C" * colour + "YX", **sizes}
    metadata["Name"] = stem_of(path).removesuffix(".ome")
    if channels == [3]:
        metadata["Channel"] = ome_tiff_channels()
    metadata |= {f"{name}Unit": "µm" for name in sizes}
    volumes, per_plane = count or 1, channels[0] if colour else 1
    told: dict[str, list[Any]] = {}
    for axis, place in ({} if grid is None else origin_um(grid)).items():
        where = grid.z_um if grid is not None and axis == "z" else np.full(n_z, place)
        told[f"Position{axis.upper()}"] = np.tile(np.repeat(where, per_plane), volumes).tolist()
        told[f"Position{axis.upper()}Unit"] = ["µm"] * (volumes * n_z * per_plane)
    if times_s is not None:
        told["DeltaT"] = np.repeat(times_s, n_z * per_plane).tolist()
        told["DeltaTUnit"] = ["s"] * (volumes * n_z * per_plane)
        if len(steps := np.diff(times_s)) and np.ptp(steps) <= EVEN * steps.min():
            metadata |= {"TimeIncrement": float(steps.mean()), "TimeIncrementUnit": "s"}
    if told:
        metadata["Plane"] = told
    where_it_lies = {} if grid is None else {"words": scale_in_words(grid), **grid_facts(grid)}
    metadata["MapAnnotation"] = annotation({**facts, **where_it_lies})
    stored = (*(volumes,) * film, *(n_z,) * deep, *channels, height, width)
    big = 4 * int(np.prod(stored)) > _BIG_TIFF_BYTES
    with whole_file(path) as temporary, tifffile.TiffWriter(temporary, ome=True, bigtiff=big) as tiff:
        size = resolution(sizes.get("PhysicalSizeX"))
        tiff.write(pages, shape=stored, dtype=np.float32, photometric="minisblack", metadata=metadata, **size)
