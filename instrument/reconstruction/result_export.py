"""A stored picture or volume written for other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import whole_file
from instrument.files.errors import FileError
from instrument.files.images import write_image
from instrument.files.volumes import VolumeSource, is_zarr_name, middle_step_um, write_volume_zarr
from instrument.reconstruction.result_file import preview
from instrument.reconstruction.stored_result import StoredResult
from recon.reconstruction.result import Grid

Advance = Callable[[int, int], object]
PICTURE_SUFFIXES = (".tif", ".tiff", ".npy", ".png")
VOLUME_SUFFIXES = (".tif", ".tiff", ".npy", ".ome.zarr", ".zarr")
_BIG_TIFF_BYTES = 4_000_000_000


def export_result(
    result: StoredResult,
    target: Path | str,
    *,
    rotate_deg: int = 0,
    overwrite: bool = False,
    advance: Advance | None = None,
) -> None:
    """Write a picture or volume in the format that the target's name asks for, whole or not at all.

    Parameters
    ----------
    result : StoredResult
    target : Path
        A picture: ``.tif`` and ``.npy`` (float32) or ``.png`` (8 bit, as the preview). A volume: ``.tif``
        (OME-TIFF), ``.npy``, both plane by plane, or ``.ome.zarr``, for which it must fit into memory.
    rotate_deg : int
        A multiple of 90 by which a picture is turned counter-clockwise.
    overwrite : bool
    advance : callable, optional
        ``advance(planes done, planes)``; may raise to end the work.

    Raises
    ------
    FileError
        When the name asks for no format that there is, something is there already, or it cannot be written.
    OSError
        When the disk is full.
    """
    target = Path(target)
    volume = result.volume is not None
    known = VOLUME_SUFFIXES if volume else PICTURE_SUFFIXES
    if not target.name.lower().endswith(known):
        kind = "volume" if volume else "picture"
        raise FileError(target, f"a {kind} is exported as {', '.join(known)}.")
    if target.resolve() == result.path.resolve():
        raise FileError(target, "is the result itself.", "Choose another name.")
    if target.exists() and not overwrite:
        raise FileError(target, "exists already and was left as it is.")
    if result.volume is None:
        assert result.image is not None
        image = np.ascontiguousarray(np.rot90(result.image, rotate_deg // 90))
        write_image(target, preview(image)[0] if target.suffix.lower() == ".png" else image)
    elif is_zarr_name(target):
        _to_zarr(result, result.volume, target, advance)
    elif target.suffix.lower() == ".npy":
        _to_npy(result.volume, target, advance)
    else:
        _to_tiff(result, result.volume, target, advance)


def _planes(source: VolumeSource, advance: Advance | None) -> Iterator[npt.NDArray[np.float32]]:
    n_z = source.shape[0]
    for z in range(n_z):
        yield source.plane(z)
        if advance is not None:
            advance(z + 1, n_z)


def _full_shape(source: VolumeSource) -> tuple[int, ...]:
    return source.shape if source.n_channels == 1 else (*source.shape, source.n_channels)


def _to_npy(source: VolumeSource, target: Path, advance: Advance | None) -> None:
    with whole_file(target) as temporary:
        voxels = np.lib.format.open_memmap(
            temporary, mode="w+", dtype=np.dtype(np.float32), shape=_full_shape(source)
        )
        for z, plane in enumerate(_planes(source, advance)):
            voxels[z] = plane
        voxels.flush()


def _to_zarr(result: StoredResult, source: VolumeSource, target: Path, advance: Advance | None) -> None:
    voxels = np.empty(_full_shape(source), np.float32)
    for z, plane in enumerate(_planes(source, advance)):
        voxels[z] = plane
    unknown = np.full(source.shape[0], np.nan)
    z_um, pitch_um = result.planes_um or (unknown, unknown)
    centre = (source.shape[1] // 2, source.shape[2] // 2)
    grid = Grid(source.shape, centre, z_um, pitch_um)
    write_volume_zarr(target, voxels, grid, {"simulated": result.simulated})


def _to_tiff(result: StoredResult, source: VolumeSource, target: Path, advance: Advance | None) -> None:
    import tifffile

    n_z, height, width = source.shape
    colour = source.n_channels > 1
    shape = (n_z, source.n_channels, height, width) if colour else source.shape
    metadata: dict[str, Any] = {"axes": "ZCYX" if colour else "ZYX"}
    if (planes := result.planes_um) is not None and n_z > 1:
        z_um, pitch_um = planes
        spacing, pitch = middle_step_um(z_um), float(pitch_um[n_z // 2])
        metadata |= {"PhysicalSizeX": pitch, "PhysicalSizeY": pitch, "PhysicalSizeZ": spacing}
        metadata |= {f"PhysicalSize{axis}Unit": "µm" for axis in "XYZ"}

    def pages() -> Iterator[npt.NDArray[np.float32]]:
        for plane in _planes(source, advance):
            if colour:
                yield from np.moveaxis(plane, -1, 0)
            else:
                yield plane

    with (
        whole_file(target) as temporary,
        tifffile.TiffWriter(temporary, ome=True, bigtiff=source.n_bytes > _BIG_TIFF_BYTES) as tiff,
    ):
        tiff.write(pages(), shape=shape, dtype=np.float32, photometric="minisblack", metadata=metadata)
