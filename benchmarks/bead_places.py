"""Where ``diffuserbench points`` finds beads in reconstructed volumes, against how far apart planes are.

Beads stand between planes and pixels, at random, planes evenly in 1/z. ``tiny`` is the simulated bench:
wave optics, every bead at its own place, smooth diffuser, 60 to 120 mm; ``lenslets`` casts a Gaussian spot a
lenslet (``lenslet_scene``), 10 to 20 mm. Photographs (photon and read noise) are reconstructed from PSFs
on the axis. Beads are looked for in the volume, these then fitted to the photograph (``points --fit``), in
its metric copy (``export --metric``), and in a "perfect" volume made of the places themselves, without
photograph and solver. Figures are in voxels of the metric copy:
the middle plane's pixel across, the step beside it along. "Advised" is how many of the planes that the
calibration's analysis advises there are: half an axial step (inner product 0.8) apart. "Edge" is by how many
voxels x or y of a direction at the field's edge changes from one plane to the next: so much more exact than
half a voxel must depth be known for x and y.

    python benchmarks/bead_places.py --bench tiny lenslets --planes 4 8 16
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lenslet_scene import Camera
from lenslet_scene import beads as lenslet_beads

import recon
from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.analysis.point_places import PointPlaces, point_places
from recon.analysis.resolution import axial_resolution
from recon.camera.grid import Grid, metric_grid, metric_volume
from recon.optics.scene import bead_volume
from recon.reconstruction.point_errors import fitted_places
from recon.types import Calibration, Geometry

GREEN = (0.0, 1.0, 0.0)
READ_NOISE = 2.0


@dataclass(frozen=True)
class Scene:
    """A photograph of beads, and what its camera makes of a source on the axis."""

    photograph: np.ndarray
    places_um: np.ndarray
    psf: Callable[[float], np.ndarray]
    geometry: Geometry
    z_um: tuple[float, float]

    def calibration(self, planes: int) -> Calibration:
        """Return one of so many planes, evenly in 1/z."""
        z_um = 1 / np.linspace(1 / self.z_um[0], 1 / self.z_um[1], planes)
        psfs = np.stack([self.psf(float(z)) for z in z_um])[:, None].astype(np.float32)
        return Calibration(psfs, np.stack([0 * z_um, 0 * z_um, z_um], 1), geometry=self.geometry)

    @property
    def advised(self) -> float:
        """Planes that sample the axial step twice."""
        near, far = self.z_um
        middle = 2 / (1 / near + 1 / far)
        distance_um = 1e3 * (self.geometry.diffuser_distance_mm or 0.0)
        step = axial_resolution(self.psf(middle), middle, distance_um, 0.8).step_per_um
        return 1 + (1 / near - 1 / far) / (step / 2)


def noisy(light: np.ndarray, photons: float, seed: int) -> np.ndarray:
    """Return a photograph with so many photons in its brightest pixel."""
    rng = np.random.default_rng(seed)
    return (rng.poisson(light / light.max() * photons) + rng.normal(0, READ_NOISE, light.shape)).astype(
        np.float32
    )


def tiny(seed: int, photons: float) -> Scene:
    """Return 20 beads before the simulated bench ``tiny``, by wave optics."""
    world = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
    near, far = 60e3, 120e3
    margin = 0.1 * (1 / near - 1 / far)
    nearest, farthest = 1 / (1 / near - margin), 1 / (1 / far + margin)
    pitch_um = world.geometry.pixel_pitch_um
    per_pixel = pitch_um / (1e3 * (world.geometry.diffuser_distance_mm or 0.0))
    scene = bead_volume(
        20, (0.6 * 320 * per_pixel * nearest, 0.6 * 240 * per_pixel * nearest), (nearest, farthest), seed=seed
    )
    world.set_scene(scene)
    world.scene_lit = True
    light = world.photons_per_s(GREEN)
    assert light is not None
    return Scene(
        noisy(np.asarray(light, np.float64), photons, seed),
        scene.beads[0].positions_um,
        lambda z: world.psf((0.0, 0.0, z), GREEN),
        world.geometry,
        (near, far),
    )


def lenslets(seed: int, photons: float) -> Scene:
    """Return 20 beads before random lenslets in closed form."""
    camera, geometry = Camera(128, 2), Geometry(6.5, 6.0)
    points = lenslet_beads(camera, 20, seed)
    z_um = 6000.0 / (points[:, 2] - 0.7)
    across = -points[:, 1::-1] * 6.5 / 6000.0 * z_um[:, None]
    return Scene(
        noisy(camera.render(points), photons, seed),
        np.column_stack([across, z_um]),
        lambda z: camera.render(np.array([[0, 0, 0.7 + 6000.0 / z, 1.0]])),
        geometry,
        (10e3, 20e3),
    )


SCENES = {"tiny": tiny, "lenslets": lenslets}


def perfect(grid: Grid, places_um: np.ndarray) -> np.ndarray:
    """Return a volume with the light of each place shared by the voxels beside it, along its ray."""
    volume = np.zeros(grid.shape, np.float32)
    for x, y, z in places_um:
        plane = np.interp(-1 / z, -1 / grid.z_um, np.arange(grid.shape[0]))
        row, column = grid.pixel_of(0, x * grid.z_um[0] / z, y * grid.z_um[0] / z)
        shares = [
            np.maximum(1 - np.abs(np.arange(n) - at), 0)
            for n, at in zip(grid.shape, (plane, row, column), strict=True)
        ]
        volume += np.einsum("z,y,x->zyx", *shares).astype(np.float32)
    return volume


def offsets(found: PointPlaces, truth_um: np.ndarray, voxel_um: np.ndarray) -> np.ndarray:
    """Return by how many voxels beads are off, and by how many deviations, (n, 6); inf: not found."""
    rays = truth_um[:, :2] / truth_um[:, 2:]
    seen = found.places_um[:, :2] / found.places_um[:, 2:]
    per_pixel = float(voxel_um[0] / np.median(truth_um[:, 2]))
    rows, free = [], np.ones(len(found), bool)
    for place, ray in zip(truth_um, rays, strict=True):
        beside = np.abs(seen - ray).max(axis=1) / per_pixel
        deep = np.abs(found.places_um[:, 2] - place[2]) / voxel_um[2]
        nearest = int(np.argmin(np.where(free, np.hypot(beside, deep), np.inf)))
        if not (free[nearest] and beside[nearest] < 3 and deep[nearest] < 3):
            rows.append(np.full(6, np.inf))
            continue
        free[nearest] = False
        off = found.places_um[nearest] - place
        rows.append(np.append(off / voxel_um, off / found.deviations_um[nearest]))
    return np.array(rows)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bench", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--planes", type=int, nargs="+", default=[4, 8, 16])
    parser.add_argument("--prior", nargs="+", default=["l1"])
    parser.add_argument("--photons", type=float, default=4000.0, help="in the brightest pixel")
    parser.add_argument("--seeds", type=int, default=2)
    asked = parser.parse_args()
    heads = "bench, prior | planes (advised) | edge | in | beads | z: 90 %, most | x, y: 90 %, most"
    print(f"| {heads} | within half; off / deviation |\n|---|---|---|---|---|---|---|---|")
    for name, prior, planes in ((n, p, k) for n in asked.bench for p in asked.prior for k in asked.planes):
        scenes = [SCENES[name](seed, asked.photons) for seed in range(asked.seeds)]
        off: dict[str, list[np.ndarray]] = {"volume": [], "fitted": [], "metric": [], "perfect": []}
        for scene in scenes:
            calibration = scene.calibration(planes)
            result = recon.reconstruct(
                recon.Measurement(scene.photograph),
                calibration,
                prior=prior,
                model="convolution",
                judged=False,
                **({"iterations": 200} if prior == "l1" else {}),
            )
            grid = result.grid
            metric = metric_grid(grid)
            voxel_um = np.array([metric.pitch_um[0], metric.pitch_um[0], metric.spacing_um[0]])
            for where, volume, on in (
                ("volume", result.volume, grid),
                ("metric", *metric_volume(result.volume, grid)),
                ("perfect", perfect(grid, scene.places_um), grid),
            ):
                found = point_places(volume, on)
                off[where].append(offsets(found, scene.places_um, voxel_um))
                if where == "volume":
                    found = fitted_places(found, on, scene.photograph, calibration)
                    off["fitted"].append(offsets(found, scene.places_um, voxel_um))
        edge = max(grid.shape[1:]) / 2 * metric.spacing_um[0] / metric.z_um[len(metric.z_um) // 2]
        for where, each in off.items():
            told = np.concatenate(each)
            seen = told[np.isfinite(told[:, 0])]
            z, across = np.abs(seen[:, 2]), np.abs(seen[:, :2]).max(axis=1)
            figures = [f"{np.percentile(one, 90):.2f}, {one.max():.2f}" for one in (z, across)]
            within = (np.maximum(z, across) <= 0.5).sum() / len(told)
            sure = np.sqrt((seen[:, 3:] ** 2).mean())
            row = [f"{name}, {prior}", f"{planes} ({scenes[0].advised:.1f})", f"{edge:.1f}", where]
            row += [f"{len(seen)} of {len(told)}", *figures, f"{within:.0%}; {sure:.2f}"]
            print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
