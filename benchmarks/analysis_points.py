"""The distances that ``analyze`` states, held against points whose light is propagated.

    python benchmarks/analysis_points.py [--pairs 20] [--only across along sixteen]
    python benchmarks/analysis_points.py --bench tiny lenslets pointgrey microscope --only across
    python benchmarks/analysis_points.py --pairs 12 --only volume

Benches of :data:`BENCHES`, calibrated at two depths with noise. Then points alone, at places
between pixels and planes that the analysis has not seen, by wave optics: pairs across in a picture as the
default reconstruction makes it, at the depth analysed (``--between``: in the middle of the two); pairs along
the axis and sixteen in x and z in the window that states them. Printed is how many are told apart at the
stated distance and at 0.8 of it. ``volume``: pairs along the axis and sixteens, each in a cell of its own
with the noise that it would have alone, in one default volume, at the distances that ``analyze --volumes``
states.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon import reconstruct
from recon.analysis import Analysis, analyse
from recon.analysis.gram import WindowProblem
from recon.analysis.point_images import HALF_WINDOW, planes_about
from recon.analysis.point_noise import Noise
from recon.analysis.points import DIP, PointGrid, smallest_dip, try_points
from recon.camera.refocus import psf_at
from recon.evaluation.points_in_volumes import in_volumes
from recon.evaluation.two_points import cells, reached
from recon.types import Calibration, Geometry

GREEN = (0.0, 1.0, 0.0)
BENCHES: dict[str, tuple[dict[str, Any], int, tuple[float, float]]] = {
    "tiny": ({"preset": "tiny"}, 1, (60e3, 75e3)),
    "fine": ({"preset": "tiny", "feature_size_um": 90.0, "diffuser_seed": 5}, 1, (30e3, 40e3)),
    "coarse": ({"preset": "tiny", "feature_size_um": 220.0, "diffuser_seed": 9}, 1, (100e3, 150e3)),
    "lenslets": (
        {"preset": "tiny", "diffuser": "random_microlens", "lenslet_um": 250.0, "focal_length_um": 8900.0},
        1,
        (60e3, 75e3),
    ),
    "pointgrey": ({"preset": "pointgrey"}, 4, (60e3, 80e3)),
    "microscope": ({"preset": "microscope"}, 4, (2.2e3, 2.6e3)),
    "pco": ({"preset": "pco"}, 8, (60e3, 75e3)),
}
"""The world's options, the binning, and the calibrated depths."""
SHARES = (1.0, 0.8)
CELL_PX = 30


@dataclass(frozen=True)
class Camera:
    """A simulated world seen on binned pixels."""

    world: SimulatedWorld
    binning: int

    @classmethod
    def of(cls, bench: str) -> Camera:
        """Return a bench's, steady."""
        options, binning, _ = BENCHES[bench]
        return cls(SimulatedWorld(WorldOptions(**options, time_scale=0.0)), binning)

    @cached_property
    def geometry(self) -> Geometry:
        """Of the binned pixels."""
        pitch_um = self.binning * self.world.sensor.pitch_um
        return replace(self.world.geometry, pixel_pitch_um=pitch_um)

    def light(self, row: float, column: float, z_um: float) -> np.ndarray:
        """Return the image of a point so many pixels from the axis."""
        by = -float(self.geometry.pixel_pitch_um or 0.0) * z_um / self.world.distance_um
        return self.world.psf((column * by, row * by, z_um), GREEN, self.binning)


def calibrated(camera: Camera, depths_um: tuple[float, ...], electrons: float = 1e5) -> Calibration:
    """Return PSFs of a world with the noise of such a brightest pixel."""
    rng = np.random.default_rng(7)
    psfs = [Noise(electrons).expose(camera.light(0.0, 0.0, z), rng) for z in depths_um]
    places = np.array([(0.0, 0.0, z) for z in depths_um])
    lit = np.maximum(np.stack(psfs), 0).astype(np.float32)[:, None]
    return Calibration(lit, places, geometry=camera.geometry)


class Truth:
    """Light of points by wave optics."""

    def __init__(self, camera: Camera, found: Analysis) -> None:
        self.light, self.geometry, self.z_um = camera.light, camera.geometry, found.z_um
        self.planes = planes_about(found.z_um, found.axial_inner.step_per_um)

    def point(self, columns: float, plane: float) -> np.ndarray:
        """Return the same at a place between the window's planes."""
        z_um = float(1 / np.interp(plane, np.arange(len(self.planes)), self.planes))
        return self.light(0.0, columns, z_um)


def across(
    truth: Truth, calibration: Calibration, axis: int, px: float, number: int, count: int = 1
) -> list[bool]:
    """Tell which pairs of one picture are told apart, each in its own cell, with the noise of one alone.

    Pictures of ever larger ``number`` go on with a sequence that takes all places between pixels evenly.
    """
    rng = np.random.default_rng(1000 + number)
    middles = rng.permutation(cells(calibration.psfs[0, 0], px, CELL_PX))[:count]
    if count == 1:
        middles = np.round(rng.uniform(-20, 20, (1, 2)))
    on = np.arange(len(middles)) + number * len(middles)
    between = (0.5 + on[:, None] * np.array((0.754878, 0.569840))) % 1 - 0.5
    pairs = [
        middle + place + px * np.outer((0, 1), np.eye(2)[axis])
        for middle, place in zip(middles, between, strict=True)
    ]
    each = [np.sum([truth.light(*place, truth.z_um) for place in pair], axis=0) for pair in pairs]
    seen = exposed(np.sum(each, axis=0), len(pairs), max(float(one.max()) for one in each), rng)
    image = reconstruct(seen, calibration, z_um=truth.z_um, judged=False).image
    found = []
    for first, _ in pairs:
        picture, (row, column) = (image, first) if axis == 1 else (image.T, first[::-1])
        row, column = np.array((row, column)) + np.array(picture.shape) // 2
        line = picture[round(row) - 2 : round(row) + 3].sum(axis=0, dtype=np.float64)[None]
        found.append(smallest_dip(line, np.array([[[0.0, column], [0.0, column + px]]])) >= DIP)
    return found


def exposed(light: np.ndarray, count: int, peak: float, rng: np.random.Generator) -> np.ndarray:
    """Return light of several groups of points with the photon noise that one of them alone would have."""
    scale = Noise().electrons / peak
    noise = rng.poisson(scale * light / count) - scale * light / count
    return np.asarray(light + (noise + rng.normal(0, Noise().read_e, light.shape)) / scale)


def in_a_volume(
    truth: Truth, stack: np.ndarray, grid: PointGrid, count: int, seed: int = 5
) -> tuple[int, int, str]:
    """Tell how many grids of points are told apart in one default volume, of how many there is room for."""
    rng = np.random.default_rng(seed)
    height, width = stack.shape[1:]
    rows, columns = (
        CELL_PX * np.arange(-(n // 4 // CELL_PX), n // 4 // CELL_PX + 1) for n in (height, width)
    )
    cells = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    light, places, peak = np.zeros((height, width)), [], 0.0
    for cell in rng.permutation(cells)[:count]:
        row, column = cell + rng.uniform(-0.5, 0.5, 2)
        x = column + (np.arange(grid.columns) - (grid.columns - 1) / 2) * grid.separation_px
        z = (len(stack) - 1) / 2 + (np.arange(grid.planes) - (grid.planes - 1) / 2) * grid.separation_planes
        z = z + rng.uniform(-0.5, 0.5)
        depths = [float(1 / np.interp(s, np.arange(len(stack)), truth.planes)) for s in z]
        alone = np.sum([truth.light(row, float(c), one) for one in depths for c in x], axis=0)
        light, peak = light + alone, max(peak, float(alone.max()))
        places.append((row, np.stack(np.meshgrid(z, x, indexing="ij"), axis=-1)))
    seen = exposed(light, len(places), peak, rng)
    at = np.array([(0.0, 0.0, float(1 / v)) for v in truth.planes])
    calibration = Calibration(stack[:, None].astype(np.float32), at, geometry=truth.geometry)
    made = reconstruct(seen, calibration, estimate_background=False, judged=False)
    found = 0
    for row, where in places:
        middle = round(row) + height // 2
        line = made.volume[:, middle - 2 : middle + 3].sum(axis=1, dtype=np.float64)
        found += smallest_dip(line, where + np.array([0.0, width // 2])) >= DIP
    return found, len(places), f"{made.solver}, {made.prior}"


def told(count: int, one: Callable[[np.random.Generator], bool]) -> str:
    """Return how many of so many are told apart."""
    return f"{sum(one(np.random.default_rng(1000 + seed)) for seed in range(count))} of {count}"


def _volumes(
    truth: Truth,
    calibration: Calibration,
    stack: np.ndarray,
    found: Analysis,
    count: int,
    shares: Sequence[float],
) -> None:
    """Hold what volumes are said to reach against points whose light is propagated."""
    points, step = found.points, found.axial_inner.step_per_um
    assert points is not None
    assert points.lateral_px is not None
    assert points.axial_per_um is not None
    began = time.process_time()
    stated = in_volumes(calibration, found.z_um, points.lateral_px, points.axial_per_um, step)
    optics = points.axial_per_um / (step / 2)
    print(
        f"volumes: {stated}, optics {optics:.2f} half steps, {time.process_time() - began:.0f} CPU s",
        flush=True,
    )
    for share in shares:
        grids = {}
        if stated.along_per_um is not None:
            grids["two along"] = PointGrid(1, 2, separation_planes=share * stated.along_per_um / (step / 2))
        if stated.sixteen_factor is not None:
            factor = share * stated.sixteen_factor
            grids["sixteen"] = PointGrid(4, 4, factor * points.lateral_px, factor * optics)
        for name, grid in grids.items():
            began = time.process_time()
            told_apart, of, how = in_a_volume(truth, stack, grid, count)
            print(
                f"volume ({how}), {name}, {grid.separation_px:.2f} px, {grid.separation_planes:.2f} half "
                f"steps ({share:g} of stated): {told_apart} of {of}, {time.process_time() - began:.0f} CPU s",
                flush=True,
            )


def held(bench: str, wanted: Sequence[str], asked: argparse.Namespace) -> None:
    """Analyse a bench's calibration, then count."""
    count, shares, together = asked.pairs, asked.shares, asked.together
    camera = Camera.of(bench)
    calibration = calibrated(camera, BENCHES[bench][2])
    began = time.process_time()
    found = analyse(calibration, reach=reached if "across" in wanted else None)
    print(
        f"{bench}: {calibration!r}, analysed at {found.z_um / 1e3:.4g} mm in "
        f"{time.process_time() - began:.1f} CPU s",
        flush=True,
    )
    truth, points = Truth(camera, found), found.points
    if asked.between:
        truth.z_um = float(2 / np.sum(1 / np.array(BENCHES[bench][2])))
    assert points is not None
    if found.reached is not None:
        for axis, px in enumerate(found.reached.across_px):
            for share in SHARES if px is not None else ():
                told_apart = [
                    one
                    for seed in range(-(-count // together))
                    for one in across(truth, calibration, axis, share * px, seed, together)
                ]
                print(
                    f"across, {'yx'[axis]} {share * px:.2f} px ({share:g} of stated, "
                    f"{found.reached.shares[axis][share < 1]:.0%} foretold): "
                    f"{sum(told_apart)} of {len(told_apart)}",
                    flush=True,
                )
    if not {"volume", "along", "sixteen"}.intersection(wanted):
        return
    stack = np.stack([psf_at(replace(calibration), float(1 / v)) for v in truth.planes])
    assert points.axial_per_um is not None
    assert points.lateral_px is not None
    along = points.axial_per_um / (found.axial_inner.step_per_um / 2)
    if "volume" in wanted:
        _volumes(truth, calibration, stack, found, count, shares)
    for name, half in (("along", (4, 4)), ("sixteen", HALF_WINDOW)):
        if name not in wanted or (name == "sixteen" and points.sixteen_factor is None):
            continue
        window = WindowProblem(stack, half)
        for share in SHARES:
            if name == "along":
                grid = PointGrid(1, 2, separation_planes=share * along)
            else:
                factor = share * float(points.sixteen_factor or 1.0)
                grid = PointGrid(4, 4, factor * points.lateral_px, factor * along)
            told_apart = told(
                count,
                lambda rng, window=window, grid=grid: (
                    try_points(
                        window, truth.point, grid, Noise(), seed=int(rng.integers(1 << 30)), trials=1
                    ).resolved
                ),
            )
            print(
                f"{name}, {grid.separation_px:.2f} px, {grid.separation_planes:.2f} half steps "
                f"({share:g} of stated): {told_apart}",
                flush=True,
            )


def main() -> None:
    """Hold each bench's figures against its own points."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=["across", "along", "sixteen", "volume"], default=None)
    parser.add_argument("--bench", nargs="+", choices=list(BENCHES), default=["tiny"])
    parser.add_argument("--shares", nargs="+", type=float, default=SHARES, help="Of a volume's points.")
    parser.add_argument("--between", action="store_true", help="Pairs across between the two depths.")
    parser.add_argument("--together", type=int, default=1, help="Pairs across in one picture, far apart.")
    asked = parser.parse_args()
    for bench in asked.bench:
        held(bench, asked.only or ["across", "along", "sixteen"], asked)


if __name__ == "__main__":
    main()
