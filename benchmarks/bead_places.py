"""Where beads come out of a reconstructed volume, against how far apart its planes are.

Beads stand between planes and pixels, at random places of 10 to 20 mm, planes evenly in 1/z. They are
rendered lenslet by lenslet (``lenslet_scene``), reconstructed by l1 and looked for in the volume and in its
metric copy (``export --metric``): by the brightest voxel, and the light's centre about it, within two planes
and as far across as a ray from the pattern's edge goes in these, four pixels more. "Perfect" volumes are made
of the places themselves, without photograph and solver: each bead's light shared by the eight voxels beside
it, along its ray. What they miss is the resampling's; what the others miss beyond it is the reconstruction's.

    python benchmarks/bead_places.py --planes 4 7 13 25
"""

from __future__ import annotations

import argparse

import numpy as np
from lenslet_scene import Camera, beads
from scipy.ndimage import center_of_mass

import recon
from recon.camera.grid import Grid, metric_volume
from recon.types import Geometry

SIZE, COUNT, DISTANCE_MM, PITCH_UM, REACH = 128, 40, 6.0, 6.5, 4
PHOTONS = 3000.0
"""In the brightest pixel."""


def apart(points: np.ndarray, reach: float) -> np.ndarray:
    """Return those beads that stand further from all before them than two windows reach."""
    kept: list[np.ndarray] = []
    for one in points:
        if all(np.hypot(*(one[:2] - other[:2])) > 2.9 * reach for other in kept):
            kept.append(one)
    return np.array(kept)


def found(volume: np.ndarray, at: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the brightest voxel and the centre of the light within ``reach`` of a place, in voxels."""
    low = np.maximum(np.round(at - reach), 0).astype(int)
    high = np.minimum(np.round(at + reach) + 1, volume.shape).astype(int)
    window = volume[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    brightest = np.array(np.unravel_index(np.argmax(window), window.shape))
    lit = np.where(window > 0.2 * window.max(), window, 0)
    return low + brightest, low + np.array(center_of_mass(lit))


def perfect(shape: tuple[int, int, int], at: np.ndarray) -> np.ndarray:
    """Return a volume with the light of one bead, 1, shared by the voxels beside its place."""
    shares = [np.maximum(1 - np.abs(np.arange(n) - where), 0) for n, where in zip(shape, at, strict=True)]
    return np.einsum("z,y,x->zyx", *shares).astype(np.float32)


def offsets(planes: int, seed: int) -> tuple[float, dict[str, np.ndarray]]:
    """Return by how many pixels the pattern's edge moves a plane, and how far beads are off (n, 3)."""
    camera = Camera(SIZE, planes)
    moved = 0.33 * SIZE * camera.span / (planes - 1)
    across = REACH + 2 * moved
    points = apart(beads(camera, COUNT, seed), across)
    z_um = 1e3 * DISTANCE_MM / (camera.magnifications - 0.7)
    geometry = Geometry(PITCH_UM, DISTANCE_MM)
    calibration = recon.Calibration(camera.psfs(), np.stack([0 * z_um, 0 * z_um, z_um], 1), geometry=geometry)
    light = camera.render(points)
    rng = np.random.default_rng(seed)
    photograph = rng.poisson(light / light.max() * PHOTONS).astype(np.float32)
    result = recon.reconstruct(
        recon.Measurement(photograph), calibration, prior="l1", model="convolution", iterations=200
    )
    grid: Grid = result.grid
    metric, placed = metric_volume(result.volume, grid)
    off: dict[str, list[np.ndarray]] = {}

    def note(name: str, volume: np.ndarray, there: np.ndarray, reach: np.ndarray) -> None:
        for kind, voxel in zip(("brightest", "centre"), found(volume, there, reach), strict=True):
            off.setdefault(f"{name}, {kind}", []).append(np.abs(voxel - there))

    for y, x, m, _ in points:
        z = 1e3 * DISTANCE_MM / (m - 0.7)
        plane = (camera.magnifications[0] - m) / camera.span * (planes - 1)
        at = np.array([plane, y + grid.centre[0], x + grid.centre[1]])
        place = grid.place_um(0, at[1], at[2])
        scale = z / z_um[0]  # along the ray
        there = np.array([
            (z - placed.z_um[0]) / placed.spacing_um[0],
            *placed.pixel_of(0, place[0] * scale, place[1] * scale),
        ])  # fmt: skip
        deep = 2 * np.gradient(z_um)[round(plane)] / placed.spacing_um[0]
        reach = np.array([abs(deep), across, across])
        note("reconstructed, planes", result.volume, at, np.array([2, REACH, REACH]))
        note("reconstructed, voxels", metric, there, reach)
        linear = np.array([np.interp(z, z_um, np.arange(planes)), *at[1:]])
        note("perfect, voxels", metric_volume(perfect(grid.shape, linear), grid)[0], there, reach)
    return moved, {name: np.array(each) for name, each in off.items()}


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--planes", type=int, nargs="+", default=[4, 7, 13, 25])
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    print("| planes | pixels a plane | beads | where | z, 90 %, most | x, y: 90 %, most | z within half |")
    print("|---|---|---|---|---|---|---|")
    for planes in arguments.planes:
        runs = [offsets(planes, seed) for seed in range(1, 1 + arguments.seeds)]
        for where in runs[0][1]:
            off = np.concatenate([each[where] for _, each in runs])
            z, across = off[:, 0], off[:, 1:].max(axis=1)
            figures = [f"{np.percentile(one, 90):.2f}, {one.max():.2f}" for one in (z, across)]
            told = [planes, f"{runs[0][0]:.2f}", len(off), where, *figures, f"{(z <= 0.5).mean():.0%}"]
            print("| " + " | ".join(map(str, told)) + " |")


if __name__ == "__main__":
    main()
