"""A volume as OME-Zarr 0.5: one plane a chunk, smaller levels to browse; what one step a file cannot say."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import sync_folder
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
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        group = zarr.open_group(draft, mode="w", zarr_format=3)
        names = ["c", "z", "y", "x"] if colour else ["z", "y", "x"]
        steps = []
        for level, step, pixels in _levels(data):
            pixels = pixels if colour else pixels[0]
            group.create_array(
                str(level),
                data=np.ascontiguousarray(pixels),
                chunks=(1,) * (pixels.ndim - 2) + pixels.shape[-2:],
                dimension_names=names,
            )
            steps.append(step)
        group.attrs["ome"] = {"version": "0.5", "multiscales": [_multiscale(path.name, grid, names, steps)]}
        planes = {"z_um": _known(grid.z_um), "pitch_um": _known(grid.pitch_um)}
        group.attrs["diffuserbench"] = attributes | planes
        _sync(draft)
        _take_the_place_of(draft, path)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


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


def _multiscale(name: str, grid: Grid, names: list[str], steps: list[int]) -> dict[str, Any]:
    known = bool(np.isfinite(grid.pitch_um).all() and np.isfinite(grid.spacing_um).all())
    middle = len(grid.z_um) // 2
    unit = {"unit": "micrometer"} if known else {}
    z, pitch = (float(grid.spacing_um[middle]), float(grid.pitch_um[middle])) if known else (1.0, 1.0)
    axes = [
        {"name": n, "type": "channel"} if n == "c" else {"name": n, "type": "space", **unit} for n in names
    ]
    colour = [1.0] * (len(names) - 3)
    datasets = []
    for level, step in enumerate(steps):
        # The centre of a larger pixel lies half of the difference away from that of the first small one.
        shift = pitch * (step - 1) / 2
        transformations: list[dict[str, Any]] = [
            {"type": "scale", "scale": [*colour, z, pitch * step, pitch * step]}
        ]
        if step > 1:
            transformations.append(
                {"type": "translation", "translation": [*(0.0 for _ in colour), 0.0, shift, shift]}
            )
        datasets.append({"path": str(level), "coordinateTransformations": transformations})
    return {
        "name": name.removesuffix(".zarr").removesuffix(".ome"),
        "axes": axes,
        "datasets": datasets,
        "type": "local mean",
    }


def _known(values: npt.NDArray[np.float64]) -> list[float] | None:
    return [float(v) for v in values] if np.isfinite(values).all() else None


def _sync(folder: Path) -> None:
    for place, _, files in os.walk(folder, topdown=False):
        for name in files:
            with (Path(place) / name).open("rb") as written:
                os.fsync(written.fileno())
        sync_folder(Path(place))


def _take_the_place_of(draft: Path, path: Path) -> None:
    """Rename ``draft`` to ``path``; a folder there before is removed only once the new one stands."""
    old = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    if path.exists():
        path.rename(old)
    try:
        draft.rename(path)
    except OSError:
        if old.exists():
            old.rename(path)
        raise
    sync_folder(path.parent)
    shutil.rmtree(old, ignore_errors=True)
