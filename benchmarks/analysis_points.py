"""The distances that ``analyze`` states, held against points whose light is propagated.

    python benchmarks/analysis_points.py [--pairs 20] [--only across along sixteen]

The simulated bench's preset ``tiny``, calibrated at two depths with noise. Then points alone, at places
between pixels and planes that the analysis has not seen, by wave optics: pairs across in a picture as the
default reconstruction makes it; pairs along the axis and sixteen in x and z in the window that states them.
Printed is how many are told apart at the stated distance and at 0.8 of it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon import reconstruct
from recon.analysis import Analysis, analyse
from recon.analysis.gram import WindowProblem
from recon.analysis.points import DIP, HALF_WINDOW, Noise, PointGrid, planes_about, smallest_dip, try_points
from recon.camera.refocus import psf_at
from recon.evaluation.two_points import reached
from recon.types import Calibration

GREEN = (0.0, 1.0, 0.0)
SHARES = (1.0, 0.8)


def calibrated(world: SimulatedWorld, depths_um: tuple[float, ...], electrons: float = 1e5) -> Calibration:
    """Return PSFs of a world with the noise of such a brightest pixel."""
    rng = np.random.default_rng(7)
    psfs = [Noise(electrons).expose(world.psf((0.0, 0.0, z), GREEN), rng) for z in depths_um]
    places = np.array([(0.0, 0.0, z) for z in depths_um])
    lit = np.maximum(np.stack(psfs), 0).astype(np.float32)[:, None]
    return Calibration(lit, places, geometry=world.geometry)


class Truth:
    """Light of points by wave optics."""

    def __init__(self, world: SimulatedWorld, found: Analysis) -> None:
        self.world, self.z_um = world, found.z_um
        self.planes = planes_about(found.z_um, found.axial_inner.step_per_um)

    def light(self, row: float, column: float, z_um: float) -> np.ndarray:
        """Return the image of a point so many pixels from the axis."""
        by = -self.world.sensor.pitch_um * z_um / self.world.distance_um
        return self.world.psf((column * by, row * by, z_um), GREEN)

    def point(self, columns: float, plane: float) -> np.ndarray:
        """Return the same at a place between the window's planes."""
        z_um = float(1 / np.interp(plane, np.arange(len(self.planes)), self.planes))
        return self.light(0.0, columns, z_um)


def across(truth: Truth, calibration: Calibration, axis: int, px: float, rng: np.random.Generator) -> bool:
    """Tell whether one pair is told apart in a picture of its own."""
    first = rng.uniform(-20.5, 20.5, 2)
    places = [first, first + px * np.eye(2)[axis]]
    light = np.sum([truth.light(*place, truth.z_um) for place in places], axis=0)
    image = reconstruct(
        Noise().expose(light, rng), calibration, z_um=truth.z_um, estimate_background=False, judged=False
    ).image
    seen, place = (image, first) if axis == 1 else (image.T, first[::-1])
    row, column = place + np.array(seen.shape) // 2
    line = seen[round(row) - 2 : round(row) + 3].sum(axis=0, dtype=np.float64)[None]
    return smallest_dip(line, np.array([[[0.0, column], [0.0, column + px]]])) >= DIP


def told(count: int, one: Callable[[np.random.Generator], bool]) -> str:
    """Return how many of so many are told apart."""
    return f"{sum(one(np.random.default_rng(1000 + seed)) for seed in range(count))} of {count}"


def main() -> None:
    """Analyse, then count."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=["across", "along", "sixteen"], default=None)
    arguments = parser.parse_args()
    wanted = arguments.only or ["across", "along", "sixteen"]
    world = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
    calibration = calibrated(world, (60e3, 75e3))
    began = time.process_time()
    found = analyse(calibration, reach=reached if "across" in wanted else None)
    print(f"analysed at {found.z_um / 1e3:.4g} mm in {time.process_time() - began:.1f} CPU s", flush=True)
    truth, points = Truth(world, found), found.points
    assert points is not None
    if found.reached is not None:
        for axis, px in enumerate(found.reached.across_px):
            for share in SHARES if px is not None else ():
                count = told(
                    arguments.pairs,
                    lambda rng, d=share * px, axis=axis: across(truth, calibration, axis, d, rng),
                )
                print(f"across, {'yx'[axis]} {share * px:.2f} px ({share:g} of stated): {count}", flush=True)
    stack = np.stack([psf_at(replace(calibration), float(1 / v)) for v in truth.planes])
    per_plane = found.axial_inner.step_per_um / 2
    assert points.axial_per_um is not None
    assert points.lateral_px is not None
    along = points.axial_per_um / per_plane
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
            count = told(
                arguments.pairs,
                lambda rng, window=window, grid=grid: (
                    try_points(
                        window, truth.point, grid, Noise(), seed=int(rng.integers(1 << 30)), trials=1
                    ).resolved
                ),
            )
            print(
                f"{name}, {grid.separation_px:.2f} px, {grid.separation_planes:.2f} half steps "
                f"({share:g} of stated): {count}",
                flush=True,
            )


if __name__ == "__main__":
    main()
