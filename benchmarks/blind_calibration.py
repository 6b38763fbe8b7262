"""Compressive calibration against measured PSFs (Kuo 2020, Fig. 5.4).

The simulated microscope with a smaller aperture of finer lenslets, so that the whole pattern falls on the
sensor over the field, as in the Randoscope. Light is propagated for every bead at its own place; nine images
of 20 beads at unknown places, each with read noise at 34 dB below its peak. A dense picture is reconstructed
with the PSF at the centre (mean of nine images), with nine PSFs interpolated, with the 25 of the blind
deconvolution, and with 25 true PSFs. Measured PSFs are cut to the same window as the blind ones and keep
their negative noise (clipped, it would sum to a haze). Every PSF has unit light; pictures are compared with
the light that reaches the sensor, after the best gain and shift, between pixels too (a blind calibration has
no zero).

    python benchmarks/blind_calibration.py --out docs/benchmarks/blind_calibration.jpg
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from drivers.simulated.options import WorldOptions
from drivers.simulated.scenes import LUMINANCE, sample_picture
from drivers.simulated.world import SimulatedWorld
from recon import reconstruct
from recon.base.threads import set_threads
from recon.blind import BlindSettings, calibrate_from_beads
from recon.blind.points import support_of
from recon.camera.registration import displacement, shifted
from recon.optics.scene import bead_volume, picture
from recon.types import Calibration, Geometry

GREEN = (0.0, 1.0, 0.0)
Z_UM = 2500.0
PSNR_DB = 34.0
FIELD_PX = 0.42  # of the sensor's sides: where beads, PSFs and the picture are


@dataclass(frozen=True)
class Bench:
    """The simulated camera at one binning, cropped to a square."""

    world: SimulatedWorld
    binning: int

    @property
    def pitch_um(self) -> float:
        """Pitch of the binned pixels."""
        return self.world.sensor.pitch_um * self.binning

    @property
    def object_um(self) -> float:
        """Pixel in the object."""
        return self.pitch_um * Z_UM / self.world.distance_um

    def cropped(self, image: np.ndarray) -> np.ndarray:
        """Cut the sensor to a square about its centre."""
        height, width = image.shape
        left = width // 2 - height // 2
        return np.array(image[:, left : left + height])

    @property
    def size(self) -> int:
        """Pixels along a side."""
        return self.world.sensor.shape[0] // self.binning

    @property
    def field_um(self) -> float:
        """Side of the field with beads and picture."""
        return FIELD_PX * self.size * self.object_um

    def psf(self, row: float, column: float) -> np.ndarray:
        """PSF of a source that shifts the pattern by so many pixels."""
        return self.cropped(
            self.world.psf((-column * self.object_um, -row * self.object_um, Z_UM), GREEN, self.binning)
        )

    def slide(self, number: int) -> np.ndarray:
        """Image of 20 beads at random places."""
        self.world.set_scene(bead_volume(20, (self.field_um, self.field_um), (Z_UM, Z_UM), seed=100 + number))
        self.world.scene_lit = True
        light = self.world.photons_per_s(GREEN, self.binning)
        assert light is not None
        return self.cropped(light)

    def dense(self) -> np.ndarray:
        """Image of a photograph."""
        portrait = (sample_picture() @ LUMINANCE)[40:552]
        self.world.set_scene(picture(portrait, Z_UM, self.field_um))
        self.world.scene_lit = True
        light = self.world.photons_per_s(GREEN, self.binning)
        assert light is not None
        return self.cropped(light)

    def truth(self, shift: tuple[float, float]) -> np.ndarray:
        """Light of the photograph that reaches the sensor, for pixels that look (row, column) aside."""
        source = (-shift[1] * self.object_um, -shift[0] * self.object_um, Z_UM)
        return self.world.ground_truth(
            (self.size, self.size), self.pitch_um, source_um=source, collected=True
        )


def noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Scale to a peak of 1 and add read noise at :data:`PSNR_DB`."""
    return (image / image.max() + rng.normal(0, 10 ** (-PSNR_DB / 20), image.shape)).astype(np.float32)


def calibration(bench: Bench, psfs: np.ndarray, points: np.ndarray) -> Calibration:
    """Make a calibration of PSFs as seen on the sensor, each with unit light."""
    light = psfs.sum(axis=(1, 2), keepdims=True)
    places = [(-c * bench.object_um, -r * bench.object_um, Z_UM) for r, c in points]
    return Calibration(
        np.ascontiguousarray((psfs / light)[:, None], np.float32),
        np.array(places),
        geometry=Geometry(bench.pitch_um, 1e-3 * bench.world.distance_um),
    )


def measured(
    bench: Bench, k: int, rng: np.random.Generator | None, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """PSFs on a k x k grid over the field, one noisy image each (no noise without ``rng``)."""
    axis = np.linspace(-0.5, 0.5, k) * FIELD_PX * bench.size
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2).round()
    psfs = np.stack([bench.psf(r, c) for r, c in points])
    if rng is not None:
        psfs = np.stack(
            [windowed(noisy(p, rng), r, c, window) for p, (r, c) in zip(psfs, points, strict=True)]
        )
    return psfs, points


def windowed(image: np.ndarray, row: float, column: float, window: int) -> np.ndarray:
    """Keep the window that holds the pattern of a source at (row, column)."""
    result = np.zeros_like(image)
    corner = [n // 2 - window // 2 + round(at) for n, at in zip(image.shape, (row, column), strict=True)]
    kept = tuple(slice(max(c, 0), c + window) for c in corner)
    result[kept] = image[kept]
    return result


def score(image: np.ndarray, bench: Bench) -> tuple[float, np.ndarray]:
    """PSNR in dB within the picture against the truth as its pixels see it, and the image with the best gain.

    A blind calibration has no zero: its picture lies a fraction of a pixel beside that of measured PSFs. The
    shift is found, and the truth rendered for it.
    """
    truth = bench.truth((0.0, 0.0))
    rows, columns = displacement(image, truth)
    whole = shifted(image, -rows, -columns)
    lit = truth > 0
    spectrum = np.fft.rfft2(whole)
    f_y, f_x = np.fft.fftfreq(image.shape[0])[:, None], np.fft.rfftfreq(image.shape[1])[None]

    def misfit(shift: np.ndarray) -> float:
        phase = np.exp(-2j * np.pi * (f_y * shift[0] + f_x * shift[1]))
        moved = np.fft.irfft2(spectrum * phase, s=image.shape)
        gain = float((moved * truth)[lit].sum() / (moved[lit] ** 2).sum())
        return float(np.sqrt(np.mean((gain * moved - truth)[lit] ** 2)) / truth.max())

    start = np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4]])
    options = {"initial_simplex": start, "xatol": 0.01, "fatol": 1e-6}
    by = minimize(misfit, start[0], method="Nelder-Mead", options=options).x
    seen = bench.truth((float(by[0]) - rows, float(by[1]) - columns))
    lit = seen > 0
    gain = float((image * seen)[lit].sum() / (image[lit] ** 2).sum())
    error = float(np.sqrt(np.mean((gain * image - seen)[lit] ** 2)))
    return 20 * np.log10(float(seen.max()) / error), gain * whole


def on_support(psfs: np.ndarray) -> np.ndarray:
    """Cut measured PSFs to where they have light above their noise, as the blind ones are."""
    return np.stack([psf * support_of(psf) for psf in psfs])


def main() -> None:
    """Calibrate, reconstruct, compare, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--binning", type=int, default=6)
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--degree", type=int, default=2)
    parser.add_argument("--tau", type=float, default=0.01)
    parser.add_argument("--keep", type=Path, help="keep images and PSFs in this .npz")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    set_threads(1)
    world = SimulatedWorld(
        WorldOptions(preset="microscope", time_scale=0.0, aperture_mm=(0.5, 0.5), lenslet_um=100.0)
    )
    bench = Bench(world, a.binning)
    rng = np.random.default_rng(0)
    raw = np.stack([noisy(bench.slide(k), rng) for k in range(9)])
    window = int(500 * (1 + world.distance_um / Z_UM) / bench.pitch_um * 1.12) // 2 * 2 + 1
    began = time.perf_counter()
    settings = BlindSettings(
        ranks=a.ranks, iterations=a.iterations, tau=a.tau, reach=FIELD_PX, degree=a.degree
    )
    found = calibrate_from_beads(
        raw,
        (window, window),
        settings,
        on_progress=lambda what, share: print(f"{share:4.0%} {what}", flush=True),
    )
    seconds = time.perf_counter() - began
    print(
        f"blind: misfits on the grid {[f'{m:.3f}' for m in found.misfits]}, of points "
        f"{[f'{m:.3f}' for m in found.point_misfits]}, {[len(b) for b in found.beads]} beads, {seconds:.0f} s"
    )
    mean = np.mean([noisy(bench.psf(0, 0), rng) for _ in range(9)], axis=0)
    centre = windowed(mean, 0, 0, window)
    nine, nine_points = measured(bench, 3, rng, window)
    true, true_points = measured(bench, 5, None, window)
    image = noisy(bench.dense(), rng)
    truth = bench.truth((0.0, 0.0))
    if a.keep is not None:
        np.savez(a.keep, raw=raw, image=image, truth=truth, centre=centre, nine=nine, found=found.psfs)
    methods = {
        "centre only": calibration(bench, centre[None], np.zeros((1, 2))),
        "9 PSFs": calibration(bench, nine, nine_points),
        "9 PSFs, noise cut": calibration(bench, on_support(nine), nine_points),
        f"blind, {len(found.psfs)} PSFs": calibration(bench, found.on_sensor(), found.points),
        "true, 25 PSFs": calibration(bench, true, true_points),
    }
    shown = {}
    for name, made in methods.items():
        model = "local" if len(made.psfs) > 1 else "convolution"
        result = reconstruct(image, made, model=model, estimate_background=False, iterations=150)
        psnr, shown[name] = score(result.volume[0], bench)
        print(f"{name}: {psnr:.2f} dB", flush=True)
        shown[f"{name}\n{psnr:.1f} dB"] = shown.pop(name)
    if a.out is not None:
        _draw(raw[0], shown, truth, bench, a.out)


def _draw(raw: np.ndarray, shown: dict[str, np.ndarray], truth: np.ndarray, bench: Bench, out: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 3.4))
    axes = figure.subplots(1, len(shown) + 2)
    half = int(0.55 * FIELD_PX * bench.size)
    middle = slice(bench.size // 2 - half, bench.size // 2 + half)
    pictures = {"one of 9 bead images": raw}
    pictures |= {name: image[middle, middle][::-1, ::-1] for name, image in shown.items()}
    pictures["truth (light collected)"] = truth[middle, middle][::-1, ::-1]
    for axis, (name, image) in zip(axes, pictures.items(), strict=True):
        white = truth.max() if image is not raw else image.max()
        axis.imshow(np.clip(image / white, 0, 1) ** 0.6, cmap="gray", vmin=0, vmax=1)
        axis.set_title(name, fontsize=10)
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(out, dpi=90)


if __name__ == "__main__":
    main()
