"""Fields of PSFs at depths that were left out, and by an angular response alone, against measured ones.

    python benchmarks/depths_between.py [--seeds 2] [--out FILE.csv]
    python benchmarks/depths_between.py --stated [--seeds 2]

PSFs and photographs are propagated as light (wave optics, every bead at its own place, the pixels' angular
response at each source's own angle); calibrations have photon and read noise. At a depth half way, in 1/z,
between two calibrated ones (3 x 3 places each) the same photograph is reconstructed

* measured: with nine PSFs photographed at that depth,
* brought: with nine PSFs brought there from the two depths (Kuo 2020, Eqs. 5.2 and 5.3),
* central: with the one on the axis, brought there,
* nearest: with the nine of the nearer depth as they are,
* two-part: with the one on the axis, measured there, and the angular response (Eq. 5.1).

Figures are the peak signal-to-noise ratio of the picture against the scene, in decibels. "Eq. 5.1 holds to"
is the least likeness, without noise, of 3 x 3 two-part PSFs to light from their places: it is 1 where they
differ by nothing but where they lie and the sensor's response. That asks for patterns that lie on the sensor
as a whole (the last two cameras; the others' apertures are larger), and for a smooth diffuser: what lenslets
show out of focus differs with the angle.

``--stated`` holds the similarity that ``refocus`` states of a PSF brought to another depth against the true
one: several diffusers on the bench ``tiny``, 3, 4 and 7 calibrated depths, four frames averaged.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon import reconstruct
from recon.analysis.correlation import similarity
from recon.base import metrics
from recon.camera.refocus import refocus
from recon.camera.refocus_field import refocus_field
from recon.camera.two_part import two_part
from recon.optics.diffuser import Diffuser, microlens_diffuser, smooth_diffuser
from recon.optics.fall_off import gaussian_fall_off, response_on
from recon.optics.grid import GREEN, PixelGrid
from recon.optics.render import render
from recon.optics.scene import Beads, Scene, TruthGrid
from recon.optics.wave import WavePropagator
from recon.types import Calibration, Geometry

WEIGHTS = (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Camera:
    """A camera, and between which depths one is left out."""

    name: str
    kind: str
    shape: tuple[int, int]
    pitch_um: float
    distance_um: float
    aperture_um: float
    fall_off_deg: float
    depths_um: tuple[float, float]

    @property
    def z_um(self) -> float:
        """The depth left out."""
        near, far = self.depths_um
        return 2 / (1 / near + 1 / far)

    def diffuser(self, seed: int) -> Diffuser:
        """Return its diffuser."""
        size = (self.aperture_um, self.aperture_um)
        if self.kind == "lenslets":
            return microlens_diffuser(size, 2.5, lenslet_um=250, focal_length_um=1500, seed=seed)
        return smooth_diffuser(size, 5.0, feature_size_um=160, mean_slope_deg=0.7, seed=seed)


MICROSCOPE = ("lenslets", (96, 120), 23.2, 3800.0, 1000.0, 13.0)
SMOOTH = ("smooth", (96, 120), 23.2, 5000.0, 1500.0, 13.0)
CAMERAS = (
    Camera("microscope, 33 / m apart", *MICROSCOPE, (1800.0, 1914.0)),
    Camera("microscope, 66 / m apart", *MICROSCOPE, (1750.0, 1979.0)),
    Camera("smooth diffuser, 30 % apart", *SMOOTH, (5500.0, 7150.0)),
    Camera("the same, whole pattern", *SMOOTH[:4], 1100.0, 13.0, (5500.0, 7150.0)),
    Camera("smooth diffuser, near, whole pattern", *SMOOTH[:3], 3800.0, 700.0, 13.0, (1750.0, 1979.0)),
)


@dataclass(frozen=True)
class Bench:
    """One camera with one diffuser."""

    camera: Camera
    seed: int

    def __post_init__(self) -> None:
        c = self.camera
        object.__setattr__(self, "light", WavePropagator(c.diffuser(self.seed), c.distance_um))
        object.__setattr__(self, "grid", PixelGrid(c.shape, c.pitch_um))
        object.__setattr__(self, "response", gaussian_fall_off(c.fall_off_deg))
        object.__setattr__(self, "rng", np.random.default_rng([41, self.seed]))

    def psf(self, place: tuple[float, float, float]) -> np.ndarray:
        """Light of a point on the sensor."""
        light = self.light.psf(place, self.grid, GREEN.samples(1), emission="isotropic")
        return light * response_on(self.grid, place, self.camera.distance_um, self.response)

    def holds(self) -> float:
        """Return the least likeness of two-part PSFs of the depth left out to light from their places."""
        z_um, geometry = self.camera.z_um, Geometry(self.camera.pitch_um, self.camera.distance_um / 1e3)
        on_axis = np.float32(self.psf((0.0, 0.0, z_um)))[None, None]
        alone = Calibration(on_axis, np.array([(0.0, 0.0, z_um)]), geometry=geometry)
        made = two_part(alone, self.response)
        true = [np.float32(self.psf(tuple(place))) for place in made.source_positions_um]
        return min(similarity(psf, light) for psf, light in zip(made.psfs[:, 0], true, strict=True))

    def calibration(self, z_um: tuple[float, ...], points: int = 3) -> Calibration:
        """Photograph a point source at 3 x 3 places of each depth."""
        c = self.camera
        psfs, places = [], []
        for z in z_um:
            across = 0.33 * np.array(c.shape[::-1]) * c.pitch_um * c.z_um / c.distance_um
            steps = np.linspace(-1, 1, points) if points > 1 else np.zeros(1)
            for y in steps * across[1]:
                for x in steps * across[0]:
                    light = self.psf((x, y, z))
                    light = light * (20_000 / np.quantile(self.psf((0.0, 0.0, c.z_um)), 0.999))
                    noisy = self.rng.poisson(light) + self.rng.normal(0, 2, c.shape)
                    psfs.append(np.maximum(noisy, 0))
                    places.append((x, y, z))
        geometry = Geometry(c.pitch_um, c.distance_um / 1e3)
        return Calibration(np.float32(psfs)[:, None], np.array(places), geometry=geometry)

    def photograph(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a photograph of beads all over the field of the depth left out, and what it shows."""
        c = self.camera
        half = 0.42 * np.array(c.shape[::-1]) * c.pitch_um * c.z_um / c.distance_um
        places = np.column_stack([*(self.rng.uniform(-h, h, 120) for h in half), np.full(120, c.z_um)])
        powers = np.repeat(self.rng.uniform(0.3, 1, (120, 1)), 3, axis=1)
        size = 1.5 * c.pitch_um * c.z_um / c.distance_um
        scene = Scene("beads", beads=(Beads(places, powers, size),))
        light = render(scene, WEIGHTS, self.grid, self.light, self.response, layer_photons=1, bead_photons=1)
        light = light * (3000 / light.max())
        counts = self.rng.poisson(light) + self.rng.normal(0, 2, c.shape)
        truth = scene.true_image(TruthGrid(c.shape, c.pitch_um, c.distance_um), WEIGHTS)
        return np.float32(counts), truth


def figures(camera: Camera, seed: int, iterations: int) -> dict[str, float]:
    """Reconstruct one photograph with every calibration; PSNR by name."""
    bench = Bench(camera, seed)
    near_far, there = bench.calibration(camera.depths_um), bench.calibration((camera.z_um,))
    alone = there.part([there.nearest_to_axis()])
    brought = refocus_field(near_far, camera.z_um)
    nearest = near_far.part(near_far.source_positions_um[:, 2] == camera.depths_um[1])
    tried = {
        "measured": there,
        "brought": brought,
        "central": brought.part([brought.nearest_to_axis()]),
        "nearest": nearest,
        "two-part": two_part(alone, bench.response, points=3),
        "two-part, 5 x 5": two_part(alone, bench.response, points=5),
    }
    counts, truth = bench.photograph()
    found = {}
    for name, calibration in tried.items():
        model = "local" if len(calibration.psfs) > 1 else "convolution"
        settings = {"model": model, "prior": "l1", "iterations": iterations, "judged": False}
        picture = reconstruct(counts, calibration, **settings).image
        found[name] = metrics.psnr(picture, truth, fit_scale=True)
    return found


STATED = {
    "smooth, 140 um": lambda size, seed: smooth_diffuser(size, 5.0, seed=seed),
    "smooth, 60 um": lambda size, seed: smooth_diffuser(size, 5.0, feature_size_um=60, seed=seed),
    "lenslets, f = 1.5 mm": lambda size, seed: microlens_diffuser(size, 5.0, seed=seed),
    "lenslets, f = 8 mm": lambda size, seed: microlens_diffuser(
        size, 5.0, lenslet_um=200, focal_length_um=8000, seed=seed
    ),
}
RANGES_UM = ((40e3, 300e3), (60e3, 150e3))


def stated(seed: int) -> None:
    """Print, of each diffuser, how often the stated similarity is the true one."""
    world = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
    depths = np.sort([*(1 / np.linspace(1 / 300e3, 1 / 40e3, 25)), 2e4, 3e4, 4e5, 1e6])
    rng = np.random.default_rng([7, seed])
    for name, make in STATED.items():
        light = WavePropagator(make((1500.0, 2000.0), seed), world.distance_um)
        grid = world.sensor_grid(1)
        true = np.stack(
            [light.psf((0.0, 0.0, z), grid, GREEN.samples(1), emission="lambertian") for z in depths]
        )
        counts = np.maximum(true, 0) * (4000 / np.quantile(true, 0.999, axis=(1, 2), keepdims=True))
        seen = np.mean([rng.poisson(counts) + rng.normal(0, 2, counts.shape) for _ in range(4)], axis=0)
        for near, far in RANGES_UM:
            for count in (3, 4, 7):
                wanted = np.linspace(1 / near, 1 / far, count)
                used = sorted({int(np.argmin(np.abs(1 / depths - each))) for each in wanted})
                places = np.array([(0.0, 0.0, depths[k]) for k in used])
                geometry = Geometry(13.0, world.distance_um / 1e3)
                calibrated = Calibration(np.float32(seen[used])[:, None], places, geometry=geometry)
                kinds: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
                unknown = 0
                for k in set(range(len(depths))) - set(used):
                    made = refocus(calibrated, float(depths[k]))
                    if made.expected_similarity is None or made.similarity_within is None:
                        unknown += 1
                        continue
                    off = made.expected_similarity - similarity(made.psf[0], np.float32(seen[k]))
                    kinds[made.extrapolated].append((abs(off), made.similarity_within))
                print(f"{name}, {seed}, {near / 1e3:g} to {far / 1e3:g} mm, {count} depths:", end=" ")
                for beyond, found in kinds.items():
                    if found:
                        exact = sum(off <= 0.02 for off, _ in found)
                        ranged = sum(off <= max(within, 0.02) for off, within in found)
                        most, widest = np.max(found, axis=0)
                        print(
                            f"{'beyond' if beyond else 'between'} {exact} of {len(found)} within 0.02, "
                            f"{ranged} within what is said (up to {widest:.3f}), most {most:.3f};",
                            end=" ",
                        )
                print(f"not told {unknown}", flush=True)


def main() -> None:
    """Print and perhaps write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--iterations", type=int, default=150)
    parser.add_argument("--only", type=int, default=None, help="number of one camera")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--stated", action="store_true", help="what refocus states of its likeness instead")
    arguments = parser.parse_args()
    if arguments.stated:
        for seed in range(arguments.seeds):
            stated(seed)
        return
    rows = []
    for number, camera in enumerate(CAMERAS):
        if arguments.only not in (None, number):
            continue
        for seed in range(arguments.seeds):
            found = figures(camera, seed, arguments.iterations)
            said = "  ".join(f"{name} {value:.2f}" for name, value in found.items())
            holds = Bench(camera, seed).holds()
            print(f"{camera.name}, diffuser {seed}: Eq. 5.1 holds to {holds:.3f}: {said}", flush=True)
            rows.append({"camera": camera.name, "diffuser": seed, "holds": holds, **found})
    if arguments.out:
        with arguments.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
