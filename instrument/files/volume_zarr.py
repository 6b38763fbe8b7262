"""A volume as OME-Zarr 0.5: one plane a chunk, smaller levels to browse; what one step a file cannot say."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import whole_folder
from instrument.files.ome import ome_attributes
from recon.reconstruction.result import Grid

EVEN = 0.01
"""Steps that differ by less than this part of the smallest are taken for even."""


def middle_step_um(z_um: npt.NDArray[np.float64]) -> float:
    """Return the step beside the middle plane, positive: what OME files get; NaN where it is not known."""
    if len(z_um) < 2:
        return float("nan")
    middle = min(len(z_um) // 2, len(z_um) - 2)
    return abs(float(z_um[middle + 1] - z_um[middle]))


def uneven_steps(z_um: npt.NDArray[np.float64]) -> str:
    """Say that planes are not evenly spaced, and which step an OME file has; empty where they are.

    Parameters
    ----------
    z_um : ndarray, float64, (n_z,)
        Depths of the planes, ascending or descending; not finite where they are not known.
    """
    steps = np.abs(np.diff(z_um))
    if len(steps) < 2 or not np.isfinite(steps).all() or np.ptp(steps) <= EVEN * steps.min():
        return ""
    return (
        f"steps of {steps.min():.4g} to {steps.max():.4g} µm. OME files know one step for all: "
        f"{middle_step_um(z_um):.4g} µm, that of the middle, is written. Other programs stretch the others."
    )


SUFFIXES = (".ome.zarr", ".zarr")
"""Names that ask for OME-Zarr."""
_SMALLEST_LEVEL = 128
"""Levels are halved laterally until the longer side is at most this many pixels."""


def is_zarr_name(path: Path) -> bool:
    """Whether a name asks for OME-Zarr."""
    return path.name.lower().endswith(SUFFIXES)


def write_volume_zarr(
    path: Path, volume: npt.NDArray[np.float32], grid: Grid, attributes: dict[str, Any]
) -> None:
    """Write a volume as OME-Zarr 0.5, whole or not at all; a folder of that name is replaced.

    Parameters
    ----------
    path : Path
        The folder to be.
    volume : ndarray, float32, (n_z, height, width) or (n_z, height, width, n_channels)
        Stored as ``z, y, x`` or, in OME-Zarr's order, ``c, z, y, x``.
    grid : Grid
        OME-Zarr knows one voxel size for all planes: that of the middle one is written where it is known, and
        every plane's own ``z_um`` and ``pitch_um`` beside it in the group's attribute ``diffuserbench``.
    attributes : dict
        JSON-compatible; what else shall stand in the attribute ``diffuserbench``.

    Raises
    ------
    OSError
        When the disk is full or not writable; what was there before stays as it was.
    """
    import zarr

    data = volume[None] if volume.ndim == 3 else np.moveaxis(volume, -1, 0)
    colour = volume.ndim == 4
    with whole_folder(path) as draft:
        group = zarr.open_group(draft, mode="w", zarr_format=3)
        names = ["c", "z", "y", "x"] if colour else ["z", "y", "x"]
        levels = []
        for level, step, pixels in _levels(data):
            pixels = pixels if colour else pixels[0]
            group.create_array(
                str(level),
                data=np.ascontiguousarray(pixels),
                chunks=(1,) * (pixels.ndim - 2) + pixels.shape[-2:],
                dimension_names=names,
            )
            levels.append(step)
        group.attrs["ome"] = ome_attributes(
            path.name, names, _steps(grid), levels=levels, more={"type": "local mean"}
        )
        planes = {"z_um": _known(grid.z_um), "pitch_um": _known(grid.pitch_um)}
        group.attrs["diffuserbench"] = attributes | planes


def _levels(
    data: npt.NDArray[np.float32],
) -> Sequence[tuple[int, int, npt.NDArray[np.float32]]]:
    """Return (level, lateral step, pixels), each level the mean of 2 x 2 pixels of the one before."""
    levels, step = [(0, 1, data)], 1
    while max(data.shape[-2:]) > _SMALLEST_LEVEL and min(data.shape[-2:]) >= 2:
        height, width = (n // 2 * 2 for n in data.shape[-2:])
        blocks = data[..., :height, :width].reshape(*data.shape[:-2], height // 2, 2, width // 2, 2)
        data = blocks.mean(axis=(-3, -1), dtype=np.float32)
        step *= 2
        levels.append((len(levels), step, data))
    return levels


def _steps(grid: Grid) -> dict[str, float | None]:
    """Return the middle plane's voxel size; None where it is not known."""
    if not (np.isfinite(grid.pitch_um).all() and np.isfinite(grid.spacing_um).all()):
        return {}
    middle = len(grid.z_um) // 2
    pitch = float(grid.pitch_um[middle])
    return {"z": float(grid.spacing_um[middle]), "y": pitch, "x": pitch}


def _known(values: npt.NDArray[np.float64]) -> list[float] | None:
    return [float(v) for v in values] if np.isfinite(values).all() else None
