"""Metric volumes with voxels finer than the planes and pixels they were made of, back on steps as large."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from recon.arrays import Float32Array, Float64Array
from recon.camera.grid import Grid

Plane = Float32Array

SPARE = 0.25
"""Part of a step by which a voxel may be smaller and still stands for it."""


def in_whole_steps(
    read: Callable[[int], Plane], grid: Grid
) -> tuple[Callable[[int], Plane], Grid, Float64Array]:
    """Sum voxels until they are as large as what a metric volume was made of.

    Parameters
    ----------
    read : callable
        ``read(z)`` returns a plane, (height, width), of light a voxel.
    grid : Grid
        Of the volume: a reconstruction's own, or a metric one, which tells its :attr:`Grid.made_of_um`.

    Returns
    -------
    read, grid
        Of the sums; as they were where voxels are as large, or it is not known what they were made of.
    factors : ndarray, float64, (3,)
        Voxels that a sum has along planes, rows and columns.
    """
    if grid.made_of_um is None or not grid.is_metric:
        return read, grid, np.ones(3)
    deep, wide = grid.made_of_um
    n_z, height, width = grid.shape
    along = min(_voxels(deep, float(grid.spacing_um[0])), n_z // 2)
    across = _voxels(wide, float(grid.pitch_um[0]))
    if along <= 1 and across <= 1:
        return read, grid, np.ones(3)

    def summed(number: int) -> Plane:
        total = np.zeros((height, width), np.float32)
        for z in range(number * along, min((number + 1) * along, n_z)):
            total += read(z)
        rows = np.add.reduceat(total, np.arange(0, height, across), axis=0)
        return np.asarray(np.add.reduceat(rows, np.arange(0, width, across), axis=1), np.float32)

    shape = (-(-n_z // along), -(-height // across), -(-width // across))
    # Their middles stand between voxels: what is left of that is where the middle pixel looks at.
    row, column = (int(at // across) for at in grid.centre)
    y, x = (at * across + (across - 1) / 2 - of for at, of in zip((row, column), grid.centre, strict=True))
    sign = 1 if grid.upright else -1
    middle = (0.0, 0.0) if grid.axis_um is None else grid.axis_um[0]
    axis = np.array([x, y]) * sign * grid.pitch_um[0] + middle
    step = float(grid.z_um[1] - grid.z_um[0])
    made = replace(
        grid,
        shape=shape,
        centre=(row, column),
        z_um=grid.z_um[0] + (np.arange(shape[0]) * along + (along - 1) / 2) * step,
        pitch_um=np.full(shape[0], across * grid.pitch_um[0]),
        axis_um=np.tile(axis, (shape[0], 1)),
    )
    return summed, made, np.array([along, across, across], np.float64)


def _voxels(step_um: float, voxel_um: float) -> int:
    return max(1, int(np.ceil(step_um / voxel_um - SPARE)))
