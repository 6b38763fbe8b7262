"""Points side by side, reconstructed: whether every two neighbours are told apart (Kuo 2020, sec. 4.4).

Images of single points at continuous places are summed, noise is added, and the sum is reconstructed with
tau = 0. Points count as resolved when the reconstruction dips by 20 % between every two neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.analysis.gram import WindowProblem
from recon.analysis.point_images import PointImage, ShiftedPoints
from recon.analysis.point_noise import Noise
from recon.arrays import Float64Array
from recon.errors import InputError

DIP = 0.2
"""Dip between two points that counts as resolved (the Rayleigh criterion's)."""
TRIALS = 3
"""Noise draws and sub-pixel positions that all must be resolved."""


@dataclass(frozen=True, slots=True)
class PointTrial:
    """One image of points, reconstructed."""

    separation_px: float
    separation_planes: float
    """``separation_px`` and ``separation_planes``: between neighbours."""
    dip: float
    """The smallest dip between any two neighbours, of all draws."""
    map: Float64Array
    """(n_z, width): the reconstruction of the last draw, summed over rows."""

    @property
    def resolved(self) -> bool:
        """Whether every two neighbours are told apart."""
        return self.dip >= DIP


@dataclass(frozen=True, slots=True)
class PointGrid:
    """Points side by side: how many, and how far from their neighbours, in pixels and planes."""

    columns: int
    planes: int = 1
    separation_px: float = 0.0
    separation_planes: float = 0.0


def try_points(
    problem: WindowProblem,
    image: PointImage,
    grid: PointGrid,
    noise: Noise,
    *,
    seed: int = 0,
    trials: int = TRIALS,
) -> PointTrial:
    """Reconstruct a grid of points; see :class:`PointTrial`. The first draw not resolved is the last."""
    rng = np.random.default_rng(seed)
    dips: list[float] = []
    while len(dips) < trials and min(dips, default=DIP) >= DIP:
        # Where the grid's points lie between voxels differs from draw to draw.
        phase_x, phase_z = rng.uniform(-0.5, 0.5, 2)
        x = (np.arange(grid.columns) - (grid.columns - 1) / 2) * grid.separation_px + phase_x
        z = (problem.n_z - 1) / 2 + (np.arange(grid.planes) - (grid.planes - 1) / 2) * grid.separation_planes
        z = z + (phase_z if problem.n_z > 1 else 0.0)
        if max(abs(x)) > problem.half[1] - 1 or z[0] < 0 or z[-1] > problem.n_z - 1:
            raise InputError(
                f"{grid.columns} x {grid.planes} points {grid.separation_px:.3g} px and "
                f"{grid.separation_planes:.3g} planes apart do not fit the window."
            )
        if isinstance(image, ShiftedPoints):
            light = image.of(x, z)
        else:
            light = np.sum([image(float(c), float(s)) for s in z for c in x], axis=0)
        seen = problem.solve(noise.expose(light, rng)).sum(axis=1)
        places = np.stack(np.meshgrid(z, x + problem.half[1], indexing="ij"), axis=-1)
        dips.append(smallest_dip(seen, places))
    return PointTrial(grid.separation_px, grid.separation_planes, min(dips), seen)


def smallest_dip(seen: Float64Array, places: Float64Array) -> float:
    """Return the smallest dip between neighbours of a grid of points.

    Parameters
    ----------
    seen : ndarray, (n_z, width)
    places : ndarray, (n_planes, n_columns, 2)
        Where the points are, ``(plane, column)``.

    Returns
    -------
    float
        ``1 - valley / lower peak``; each peak is the largest value nearer to its point than a third of the
        spacing, the valley the least on the line between two peaks. 0 where a peak is missing.
    """
    n_planes, n_columns = places.shape[:2]
    step_z = float(places[1, 0, 0] - places[0, 0, 0]) if n_planes > 1 else 2.0
    step_x = float(places[0, 1, 1] - places[0, 0, 1]) if n_columns > 1 else 2.0
    reach = max(step_z / 3, 0.5), max(step_x / 3, 0.5)
    peaks = np.array([[_peak(seen, place, *reach) for place in row] for row in places])
    return min(
        _dip(seen, peaks[j, i], peaks[other])
        for j, i in np.ndindex(n_planes, n_columns)
        for other in ((j + 1, i), (j, i + 1))
        if other[0] < n_planes and other[1] < n_columns
    )


def _peak(seen: Float64Array, place: Float64Array, reach_z: float, reach_x: float) -> tuple[int, int]:
    (z, x), (n_z, width) = place, seen.shape
    rows = slice(max(int(np.ceil(z - reach_z)), 0), min(int(np.floor(z + reach_z)), n_z - 1) + 1)
    columns = slice(max(int(np.ceil(x - reach_x)), 0), min(int(np.floor(x + reach_x)), width - 1) + 1)
    part = seen[rows, columns]
    row, column = np.unravel_index(int(np.argmax(part)), part.shape)
    return int(row) + rows.start, int(column) + columns.start


def _dip(seen: Float64Array, first: npt.NDArray[np.int_], second: npt.NDArray[np.int_]) -> float:
    steps = int(np.abs(second - first).max())
    lower = min(float(seen[tuple(first)]), float(seen[tuple(second)]))
    if steps < 2 or lower <= 0:
        return 0.0
    line = [np.rint(first + (second - first) * k / steps).astype(int) for k in range(1, steps)]
    return 1.0 - min(float(seen[tuple(p)]) for p in line) / lower
