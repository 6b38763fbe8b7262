"""How far apart may calibration points be? Kuo 2020, Fig. 5.3, on a microscope in closed form.

    python benchmarks/calibration_spacing.py [--coarse] [--out docs/images/calibration-spacing.png]

A random microlens diffuser in front of a sensor whose response falls off with the angle (Gaussian, 13
degrees). Every point of the scene, at any continuous place, is rendered spot by spot, each spot with the
response at its own angle: no grid, no convolution, no interpolation, so that measurements are not made with
the model they are reconstructed with. The calibration is photographed by the same camera, with noise, at
points ever farther apart, registered from its images, and used by the local convolution model.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from recon import reconstruct
from recon.arrays import Float32Array, Float64Array
from recon.base import metrics
from recon.optics.fall_off import gaussian_fall_off
from recon.types import Calibration, Geometry


@dataclass(frozen=True)
class Microscope:
    """The dissertation's microscope (Sec. 6.4), binned; lengths in micrometres."""

    shape: tuple[int, int] = (137, 242)
    pitch_um: float = 23.2
    distance_um: float = 3800.0
    z_um: float = 1700.0
    aperture_um: float = 1000.0
    lenslets: int = 16
    fall_off_deg: float = 13.0
    spot_px: float = 0.9
    read_noise: float = 2.0
    seed: int = 0

    @property
    def magnification(self) -> float:
        """Sensor micrometres an object micrometre."""
        return self.distance_um / self.z_um

    def photons(self, points: Float64Array) -> Float32Array:
        """Render points ``(x_um, y_um, light)`` spot by spot."""
        rng = np.random.default_rng(self.seed)
        lenses = rng.uniform(-0.5, 0.5, (self.lenslets, 2)) * self.aperture_um
        strength = rng.uniform(0.5, 1.5, self.lenslets)
        response = gaussian_fall_off(self.fall_off_deg)
        m = self.magnification
        x, y = ((1 + m) * lenses[:, k] - m * points[:, k, None] for k in (0, 1))
        depth = self.distance_um + self.z_um
        seen = response((y - points[:, 1, None]) / depth, (x - points[:, 0, None]) / depth)
        light = (points[:, 2, None] * strength * seen).ravel()
        rows = (y / self.pitch_um).ravel() + self.shape[0] // 2
        columns = (x / self.pitch_um).ravel() + self.shape[1] // 2
        return _spots(self.shape, rows, columns, light, self.spot_px)

    def photograph(self, points: Float64Array, gain: float, seed: int) -> Float32Array:
        """Add photon and read noise; ``gain`` electrons for each unit of light."""
        rng = np.random.default_rng([self.seed, seed])
        noisy = rng.poisson(gain * self.photons(points)) + rng.normal(0, self.read_noise, self.shape)
        return noisy.astype(np.float32)

    def gain(self, points: Float64Array, electrons: float) -> float:
        """Return the gain that gives the brightest pixel so many electrons."""
        return electrons / float(self.photons(points).max())

    def calibration(self, spacing_um: float | None, half_um: tuple[float, float]) -> Calibration:
        """Photograph a point on a grid that covers the field, four frames each; None: on the axis only."""
        places = [(0.0, 0.0)]
        if spacing_um is not None:
            steps = [int(np.ceil(h / spacing_um - 1e-9)) for h in half_um]
            y, x = (spacing_um * np.arange(-n, n + 1) for n in steps)
            seen = 0.95 * self.shape[0] / 2 * self.pitch_um / self.magnification
            places = [(float(a), float(b)) for b in y[np.abs(y) <= seen] for a in x]
        gain = self.gain(np.array([(0.0, 0.0, 1.0)]), 10_000.0)
        psfs = []
        for k, (a, b) in enumerate(places):
            frames = [self.photograph(np.array([(a, b, 1.0)]), gain, 100 * k + n) for n in range(4)]
            psfs.append(np.maximum(np.mean(frames, axis=0, dtype=np.float32), 0))
        return Calibration(
            np.stack(psfs)[:, None],
            np.array([(a, b, self.z_um) for a, b in places]),
            geometry=Geometry(self.pitch_um, self.distance_um / 1e3),
        )

    def truth(self, points: Float64Array) -> Float32Array:
        """Return the scene on the reconstruction's grid, each point a spot as wide as the PSF's."""
        scale = self.magnification / self.pitch_um
        rows = -points[:, 1] * scale + self.shape[0] // 2
        columns = -points[:, 0] * scale + self.shape[1] // 2
        return _spots(self.shape, rows, columns, points[:, 2], self.spot_px)


def star(half_um: tuple[float, float], step_um: float, spokes: int = 9) -> Float64Array:
    """Points of a spoke target that fills the field, off every grid: (n, 3)."""
    rng = np.random.default_rng(5)
    y, x = np.meshgrid(*(np.arange(-h, h, step_um) for h in half_um), indexing="ij")
    x, y = (v.ravel() + rng.uniform(-0.3, 0.3, v.size) * step_um for v in (x, y))
    lit = (np.sin(spokes * np.arctan2(y, x)) > 0.3) & (np.hypot(x, y) > 0.12 * half_um[1])
    return np.stack([x[lit], y[lit], np.ones(int(lit.sum()))], axis=1)


@dataclass(frozen=True)
class Result:
    """One spacing's reconstruction."""

    spacing_um: float | None
    points: int
    psnr_db: float
    image: Float32Array
    seconds: float


def compare(
    camera: Microscope,
    spacings_um: tuple[float | None, ...],
    half_um: tuple[float, float],
    *,
    step_um: float,
    iterations: int,
) -> tuple[Float32Array, Float32Array, list[Result]]:
    """Return the truth, the measurement, and a reconstruction for each spacing."""
    scene = star((0.92 * half_um[0], 0.92 * half_um[1]), step_um)
    measured = camera.photograph(scene, camera.gain(scene, 20_000.0), 7)
    truth = camera.truth(scene)
    results = []
    for spacing in spacings_um:
        calibration = camera.calibration(spacing, half_um)
        start = time.perf_counter()
        found = reconstruct(
            measured,
            calibration,
            model="convolution" if spacing is None else "local",
            prior="tv",
            tau=2e-3,
            iterations=iterations,
            tolerance=1e-5,
            estimate_background=False,
            judged=False,
        )
        image = _blurred(np.asarray(found.volume[0], np.float32).reshape(camera.shape), 0.5)
        psnr = metrics.psnr(image, truth, fit_scale=True)
        results.append(Result(spacing, len(calibration.psfs), psnr, image, time.perf_counter() - start))
    return truth, measured, results


def _spots(
    shape: tuple[int, int],
    rows: Float64Array,
    columns: Float64Array,
    light: Float64Array,
    sigma: float,
) -> Float32Array:
    """Sum of Gaussian spots at continuous places, each of unit sum times its light."""
    image = np.zeros((shape[0] + 16, shape[1] + 16))
    row, column = np.floor(rows).astype(int), np.floor(columns).astype(int)
    inside = (row > -8) & (row < shape[0] + 7) & (column > -8) & (column < shape[1] + 7)
    row, column, rows, columns = row[inside], column[inside], rows[inside], columns[inside]
    reach = np.arange(-4, 6)
    y = np.exp(-0.5 * ((row[:, None] + reach - rows[:, None]) / sigma) ** 2)
    x = np.exp(-0.5 * ((column[:, None] + reach - columns[:, None]) / sigma) ** 2)
    spots = (light[inside] / (y.sum(axis=1) * x.sum(axis=1)))[:, None, None] * y[:, :, None] * x[:, None, :]
    places = (row[:, None] + reach + 8)[:, :, None], (column[:, None] + reach + 8)[:, None, :]
    keep = [np.clip(p, 0, n - 1) for p, n in zip(places, image.shape, strict=True)]
    np.add.at(image, tuple(np.broadcast_arrays(*keep)), spots)
    return image[8:-8, 8:-8].astype(np.float32)


def _blurred(image: Float32Array, sigma: float) -> Float32Array:
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(image, sigma), np.float32)


def main() -> None:
    """Run the comparison, print the table, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--coarse", action="store_true", help="a small sensor, as in the tests")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path("calibration-spacing.png"))
    arguments = parser.parse_args()
    camera = Microscope() if arguments.coarse else Microscope((274, 484), 11.6)
    half, spacings = (450.0, 1200.0), (200.0, 400.0, 600.0, 1200.0, None)
    truth, measured, results = compare(camera, spacings, half, step_um=6.0, iterations=arguments.iterations)
    print(f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, {camera.shape[0]} x {camera.shape[1]} pixels")
    for r in results:
        what = "one PSF" if r.spacing_um is None else f"{r.spacing_um / 1e3:.1f} mm"
        print(f"{what:>8}  {r.points:4d} PSFs  PSNR {r.psnr_db:5.2f} dB  {r.seconds:6.1f} s")
    _draw(truth, measured, results, arguments.out)


def _draw(truth: Float32Array, measured: Float32Array, results: list[Result], out: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = [("truth", truth), ("measurement", measured)]
    for r in results:
        name = "one PSF" if r.spacing_um is None else f"{r.points} PSFs every {r.spacing_um / 1e3:.1f} mm"
        panels.append((f"{name}: {r.psnr_db:.1f} dB", r.image * metrics.scale_to(r.image, truth)))
    for index, (title, image) in enumerate(panels):
        axes = figure.add_subplot(2, 4, index + 1)
        axes.imshow(image, cmap="gray", vmin=0, vmax=np.quantile(truth if index != 1 else image, 0.995))
        axes.set_title(title, fontsize=10)
        axes.axis("off")
    figure.suptitle("Spacing of calibration points (after Kuo 2020, Fig. 5.3), SIMULATED")
    figure.savefig(out, dpi=110)
    print(f"Wrote {out}")


if __name__ == "__main__":
    main()
