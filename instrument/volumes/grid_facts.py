"""Where a volume's voxels lie, as files tell it: by one size for all, and plane by plane beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.arrays import Float64Array

if TYPE_CHECKING:
    from recon.camera.grid import Grid

_BEYOND = 1e18
"""Micrometres, or pixels: so far off lies nothing, and squares of it are still numbers."""
EVEN = 0.01
"""Steps that differ by less than this part of the smallest are taken for even."""


def middle_step_um(z_um: Float64Array) -> float:
    """Return the step beside the middle plane, positive: what OME files get; NaN where it is not known."""
    if len(z_um) < 2:
        return float("nan")
    middle = min(len(z_um) // 2, len(z_um) - 2)
    return abs(float(z_um[middle + 1] - z_um[middle]))


def uneven_steps(z_um: Float64Array) -> str:
    """Say that planes are not evenly spaced, and which step an OME file has; empty where they are.

    ``z_um``, (n_z,), are the planes' depths, ascending or descending; not finite where they are not known.
    """
    steps = np.abs(np.diff(z_um))
    if len(steps) < 2 or not np.isfinite(steps).all() or np.ptp(steps) <= EVEN * steps.min():
        return ""
    return (
        f"steps of {steps.min():.4g} to {steps.max():.4g} µm. OME files know one step for all: "
        f"{middle_step_um(z_um):.4g} µm, that of the middle, is written. Other programs stretch the others."
    )


def voxel_um(grid: Grid) -> dict[str, float]:
    """Return the middle plane's voxel size, of one plane its pixels'; nothing where it is not known."""
    if not np.isfinite(grid.pitch_um).all():
        return {}
    pitch = float(grid.pitch_um[len(grid.z_um) // 2])
    if len(grid.z_um) == 1:
        return {"y": pitch, "x": pitch}
    if not np.isfinite(grid.spacing_um).all():
        return {}
    return {"z": middle_step_um(grid.z_um), "y": pitch, "x": pitch}


def origin_um(grid: Grid) -> dict[str, float]:
    """Return where the first voxel's centre is: its depth, and from the axis; nothing where not known.

    Along rows and columns as they are stored: of a grid that is not upright these go against y and x.
    """
    voxel = voxel_um(grid)
    if (
        "z" not in voxel or (np.diff(grid.z_um) < 0).any()
    ):  # told by a step and a place, planes go away from it
        return {}
    row, column = grid.centre
    return {"z": float(grid.z_um[0]), "y": -row * voxel["y"], "x": -column * voxel["x"]}


def grid_facts(grid: Grid) -> dict[str, Any]:
    """Return where a volume's voxels lie, JSON-compatible: None for what is not known."""
    return {
        "shape": list(grid.shape),
        "centre": list(grid.centre),
        "z_um": known(grid.z_um),
        "pitch_um": known(grid.pitch_um),
        "axis_um": None if grid.axis_um is None else grid.axis_um.tolist(),
        "upright": grid.upright,
        **({} if grid.made_of_um is None else {"made_of_um": list(grid.made_of_um)}),
    }


def scale_in_words(grid: Grid) -> str:
    """Say what the one voxel size of an OME file stands for."""
    if grid.is_metric:
        return "All voxels have one size; rows and columns go with y and x; values are light a voxel."
    if not voxel_um(grid):
        return "The size of the voxels is not known."
    if len(grid.z_um) == 1:
        return "The pictures stand upside down: rows and columns go against the scene's y and x."
    return (
        "Perspective grid: voxels of plane z are pitch_um[z] wide, and the scale is the middle plane's. The "
        "planes stand upside down: rows and columns go against the scene's y and x. diffuserbench export "
        "--metric makes voxels of one size of it."
    )


def grid_of(facts: Mapping[str, Any], shape: tuple[int, int, int]) -> Grid:
    """Return the grid that :func:`grid_facts` told of, NaN for what it did not; of a volume of this shape."""
    from recon.camera.grid import Grid

    n_z, *size = shape
    z_um, pitch_um = (numbers(facts.get(name), (n_z,)) for name in ("z_um", "pitch_um"))
    if z_um is None or pitch_um is None or (pitch_um <= 0).any():
        z_um = pitch_um = np.full(n_z, np.nan)
    centre = numbers(facts.get("centre"), (2,))
    row, column = (n // 2 for n in size) if centre is None else centre.astype(int).tolist()
    axis_um = numbers(facts.get("axis_um"), (n_z, 2))
    steps = numbers(facts.get("made_of_um"), (2,))
    made_of_um = None if steps is None or (steps <= 0).any() else (float(steps[0]), float(steps[1]))
    return Grid(shape, (row, column), z_um, pitch_um, None, axis_um, facts.get("upright") is True, made_of_um)


def numbers(value: Any, shape: tuple[int, ...]) -> Float64Array | None:
    """Return numbers of a shape, () for one; None where a record has something else, or what is no size."""
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers if numbers.shape == shape and (np.abs(numbers) < _BEYOND).all() else None


def known(values: Float64Array) -> list[float] | None:
    """Return numbers as JSON can hold them; None where one of them is not known."""
    return [float(v) for v in values] if np.isfinite(values).all() else None
