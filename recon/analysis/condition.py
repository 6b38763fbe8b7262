"""Local condition number: how well neighbouring voxels can be told apart (Kuo 2020, sec. 4.4, Fig. 4.5).

If an oracle tells which voxels are lit, their values are a least-squares problem with the columns of these
voxels alone; its condition number bounds what noise does to them. Columns are never put together to a matrix:
their inner products (the Gram matrix, double precision) are enough, whose eigenvalues are the squares of the
singular values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from recon.errors import InputError

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]
Direction = Literal["x", "z", "xz"]

WORST = 1e7
"""Condition numbers above this are rounding: the Gram matrix holds their squares, in 16 digits."""


@dataclass(frozen=True, slots=True)
class Voxel:
    """A voxel: depth plane, and rows and columns from the axis in sensor pixels."""

    plane: int
    row: int = 0
    column: int = 0


def group(direction: Direction, count: int, separation: int, *, first_plane: int = 0) -> tuple[Voxel, ...]:
    """Return voxels of a regular group.

    Parameters
    ----------
    direction : "x", "z" or "xz"
        A line of ``count`` along the columns or along depth, or a square of ``count`` in both.
    count : int
        For ``"xz"`` a square number.
    separation : int
        Voxels from one to the next; in ``"xz"`` in both directions.
    first_plane : int
        Nearest plane of the group.
    """
    if direction == "x":
        start = -separation * (count - 1) // 2
        return tuple(Voxel(first_plane, 0, start + separation * k) for k in range(count))
    if direction == "z":
        return tuple(Voxel(first_plane + separation * k) for k in range(count))
    side = round(count**0.5)
    if side * side != count:
        raise InputError(f"A group in x and z is a square: 4, 9, 16, ... sources, not {count}.")
    start = -separation * (side - 1) // 2
    return tuple(
        Voxel(first_plane + separation * j, 0, start + separation * i)
        for j in range(side)
        for i in range(side)
    )


def gram_matrix(planes: Array, voxels: Sequence[Voxel]) -> Floats:
    """Inner products of the columns of voxels: each plane's PSF, shifted, and cropped to the sensor.

    Parameters
    ----------
    planes : ndarray, (n_z, height, width)
        On-axis PSFs.
    voxels : sequence of Voxel

    Returns
    -------
    ndarray, float64, (n, n)
    """
    height, width = planes.shape[1:]
    for voxel in voxels:
        if not 0 <= voxel.plane < len(planes) or abs(voxel.row) >= height or abs(voxel.column) >= width:
            raise InputError(f"{voxel} is not within {len(planes)} planes of {height} x {width} pixels.")
    gram = np.empty((len(voxels), len(voxels)))
    for i, first in enumerate(voxels):
        for j in range(i, len(voxels)):
            gram[i, j] = gram[j, i] = _product(planes, first, voxels[j])
    return gram


def condition_number(gram: Floats) -> float:
    """Condition number of the columns with this Gram matrix, each column divided by its norm.

    Infinite where a column is zero or the columns are dependent as far as double precision tells.
    """
    norms = np.sqrt(np.diag(gram))
    if not (norms > 0).all():
        return float("inf")
    values = np.linalg.eigvalsh(gram / np.outer(norms, norms))
    if values[0] <= values[-1] / WORST**2:
        return float("inf")
    return float(np.sqrt(values[-1] / values[0]))


@dataclass(frozen=True, slots=True)
class ConditionCurve:
    """Condition number of groups of ``count`` sources at growing separations, in voxels."""

    direction: Direction
    count: int
    separations: tuple[int, ...]
    values: tuple[float, ...]


def condition_curve(
    planes: Array, direction: Direction, count: int, separations: Sequence[int]
) -> ConditionCurve:
    """Compute one curve of Fig. 4.5; separations for which there are too few planes are left out."""
    kept, values = [], []
    side = round(count**0.5) if direction == "xz" else count
    for separation in separations:
        depth = separation * (side - 1) + 1 if direction != "x" else 1
        reach = separation * (side - 1) + 1 if direction != "z" else 1
        if depth > len(planes) or reach > planes.shape[2] // 2:
            continue
        voxels = group(direction, count, separation, first_plane=(len(planes) - depth) // 2)
        kept.append(int(separation))
        values.append(condition_number(gram_matrix(planes, voxels)))
    return ConditionCurve(direction, count, tuple(kept), tuple(values))


def _product(planes: Array, first: Voxel, second: Voxel) -> float:
    """Inner product of two shifted, cropped PSFs, without copies."""
    cuts: list[list[slice]] = [[], []]
    for size, a, b in zip(
        planes.shape[1:], (first.row, first.column), (second.row, second.column), strict=True
    ):
        # On the sensor both are present from max(a, b, 0) to size + min(a, b, 0).
        low, high = max(a, b, 0), size + min(a, b, 0)
        if high <= low:
            return 0.0
        cuts[0].append(slice(low - a, high - a))
        cuts[1].append(slice(low - b, high - b))
    one, two = planes[first.plane][tuple(cuts[0])], planes[second.plane][tuple(cuts[1])]
    return float(np.einsum("ij,ij->", one, two, dtype=np.float64))
