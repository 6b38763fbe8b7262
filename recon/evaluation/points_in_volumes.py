"""Points along the axis, and sixteen in x and z, told apart by default volumes.

As in :mod:`recon.evaluation.two_points` each group of points stands in a cell of its own, at places between
pixels and planes, with the noise that it alone would have; the volume's planes are half an axial step apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from recon.analysis.middle import Middle
from recon.analysis.point_images import PLANES, planes_about
from recon.analysis.point_noise import Noise
from recon.analysis.points import DIP, PointGrid, smallest_dip
from recon.analysis.stated_distance import InVolumes, TriedPair, stated_px
from recon.arrays import Float64Array
from recon.evaluation.two_points import cells, shifted
from recon.reconstruction.reconstruct import reconstruct
from recon.types import Calibration

CELL_PX = 30
"""For a group of points, at least."""
_BESIDE = 2  # rows to both sides of a group's that the volume is summed over
_GROUPS = 16  # in a volume, at most
_ENOUGH, _VOLUMES = 20, 6  # groups, in so many volumes at most where there is room for few
_FIRST, _LATER = (1.25, 1.5), 1.25
"""Middle of the first volume's distances over the optics', and the largest over it; later about what was
found."""


@dataclass(frozen=True, slots=True)
class _Volume:
    """A default volume of planes half a step apart."""

    middle: Middle
    inverse: Float64Array
    """1 / z of its planes, the nearest first."""
    noise: Noise

    def depth_um(self, plane: float) -> float:
        return float(1 / np.interp(plane, np.arange(len(self.inverse)), self.inverse))

    def told_apart(
        self, grids: list[PointGrid], places: Float64Array, rng: np.random.Generator
    ) -> list[bool]:
        """Photograph groups in their cells, reconstruct, and tell which are told apart."""
        psfs = np.stack([self.middle.psf_at(float(1 / v)) for v in self.inverse])
        height, width = psfs.shape[1:]
        light, where, peak = np.zeros((height, width)), [], 0.0
        for grid, cell in zip(grids, places, strict=True):
            row, column = cell + rng.uniform(-0.5, 0.5, 2)
            x = column + _about_zero(grid.columns) * grid.separation_px
            z = (len(psfs) - 1) / 2 + _about_zero(grid.planes) * grid.separation_planes
            z = z + rng.uniform(-0.5, 0.5)
            in_row = np.stack([np.full(len(x), row), x], axis=-1)
            alone = np.sum([shifted(self.middle.psf_at(self.depth_um(s)), in_row) for s in z], axis=0)
            light, peak = light + alone, max(peak, float(alone.max()))
            where.append((round(row), np.stack(np.meshgrid(z, x + width // 2, indexing="ij"), axis=-1)))
        scale = self.noise.electrons / peak
        mean = scale * np.maximum(light, 0.0) / len(grids)
        charge = scale * light + rng.poisson(mean) - mean + rng.normal(0, self.noise.read_e, light.shape)
        at = np.array([(0.0, 0.0, float(1 / v)) for v in self.inverse])
        calibration = replace(
            self.middle.calibration, psfs=psfs[:, None].astype(np.float32), source_positions_um=at
        )
        made = reconstruct(charge / scale, calibration, estimate_background=False, judged=False)
        assert made.volume is not None
        lines = [
            made.volume[:, row + height // 2 - _BESIDE : row + height // 2 + _BESIDE + 1].sum(
                axis=1, dtype=np.float64
            )
            for row, _ in where
        ]
        return [smallest_dip(line, place) >= DIP for line, (_, place) in zip(lines, where, strict=True)]


def in_volumes(
    calibration: Calibration,
    z_um: float,
    lateral_px: float,
    axial_per_um: float,
    step_per_um: float,
    noise: Noise | None = None,
    *,
    seed: int = 0,
    on_progress: Callable[[float], object] | None = None,
) -> InVolumes:
    """Find the distances at which default volumes tell points apart; see :class:`InVolumes`.

    Parameters
    ----------
    calibration : Calibration
    z_um : float
        Depth of the volumes' middle.
    lateral_px, axial_per_um : float
        Two points' distances as the optics allow them, where the search begins.
    step_per_um : float
        Difference in 1/z that changes the pattern (inner product 0.8).
    noise : Noise, optional
        Of one group alone.
    on_progress : callable, optional
        Called with the share done.
    """
    on_progress = on_progress or (lambda _share: None)
    middle, rng = Middle.of(calibration, z_um, step_per_um), np.random.default_rng(seed)
    per_plane = step_per_um / 2
    optics = axial_per_um / per_plane
    whole = planes_about(z_um, step_per_um * middle.spread, PLANES)
    places = rng.permutation(cells(middle.psf_at(z_um), 0.0, CELL_PX))[:_GROUPS]

    def search(grid: PointGrid, room: float, count: int) -> float | None:
        """Return by how much a grid must grow; None where it is not told apart within the room."""
        inverse = whole[(PLANES - count) // 2 : (PLANES + count) // 2]
        volume = _Volume(middle, inverse, middle.noise(noise or Noise()))
        tried: list[TriedPair] = []
        (centre, wide), found = _FIRST, None
        for number in range(_VOLUMES):
            if number > 1 and len(tried) >= _ENOUGH:
                break
            shares = (np.arange(len(places)) + rng.uniform(0, 1, len(places))) / len(places)
            factors = np.minimum(centre * wide ** (2 * shares - 1), room)
            grids = [
                replace(
                    grid,
                    separation_px=float(f) * grid.separation_px,
                    separation_planes=float(f) * grid.separation_planes,
                )
                for f in factors
            ]
            told = volume.told_apart(grids, rng.permutation(places), rng)
            tried += [TriedPair(float(f), 0, t) for f, t in zip(factors, told, strict=True)]
            found, _ = stated_px(tried)
            if found is None and centre >= room:
                break
            centre, wide = (found, _LATER) if found is not None else (min(1.5 * centre, room), wide)
        return found

    if not whole[-1] > 0:
        return InVolumes(None, None, PLANES, middle.part)
    # Room for the largest distance and a plane to each side.
    count = min(2 * int(np.ceil(optics * np.prod(_FIRST) / 2 + 1)) + 1, PLANES)
    along = search(PointGrid(1, 2, separation_planes=optics), (count - 2) / optics, count)
    on_progress(0.4)
    sixteen = search(PointGrid(4, 4, lateral_px, optics), (PLANES - 2) / (3 * optics), PLANES)
    on_progress(1.0)
    return InVolumes(None if along is None else along * axial_per_um, sixteen, PLANES, middle.part)


def _about_zero(count: int) -> Float64Array:
    return np.asarray(np.arange(count) - (count - 1) / 2, np.float64)
