"""Picture quality against time on a dense scene of 1.3 megapixels: the solvers of one depth, side by side.

    python benchmarks/dense_2d.py [--height 1024] [--width 1280] [--seconds 60] [--photons 1e4]
    [--psf FILE] [--dark 34] [--out FOLDER]

Scene and PSF are made on a grid three times finer than the sensor's, blurred there and binned, with photon
noise (``--photons`` in the mean pixel: 1e4 is 1 %). The scene fills twice the sensor's field in height and
width, so that half of the light comes from where no picture is made of. ``--psf`` takes a calibrated PSF
image in the place of the synthetic caustic. Every solver minimises the same objective (total variation,
non-negative, weight half the noise) in float32; "converged" is the exact-data ADMM after 200 iterations.
Seconds include setting the solver up, not compiling it. Writes a picture, the curves as CSV, and prints when
each came within 0.1 dB of converged for good and within 1 % of the least objective.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

FINE = 3
REFERENCE_ITERATIONS = 200


def binned(image):
    """Average the fine pixels of each sensor pixel."""
    height, width = image.shape
    return image.reshape(height // FINE, FINE, width // FINE, FINE).mean(axis=(1, 3), dtype=np.float64)


def dense_scene(height: int, width: int, seed: int):
    """Return a photograph tiled in mirror images, textured, with hundreds of leaves of all sizes over it."""
    import cv2
    import matplotlib.cbook
    import matplotlib.image
    from scipy import fft

    rng = np.random.default_rng(seed)
    with matplotlib.cbook.get_sample_data("grace_hopper.jpg") as file:
        photograph = (matplotlib.image.imread(file) @ np.array([0.3, 0.59, 0.11]) / 255) ** 2.2
    tile = np.block([[photograph, photograph[:, ::-1]], [photograph[::-1], photograph[::-1, ::-1]]])
    scale = height / (1.5 * len(tile))
    tile = cv2.resize(tile.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    scene = np.tile(tile, (-(-height // tile.shape[0]), -(-width // tile.shape[1])))[:height, :width].copy()
    frequency = np.hypot(fft.fftfreq(height)[:, None], fft.rfftfreq(width)[None])
    frequency[0, 0] = 1
    noise = fft.rfft2(rng.standard_normal((height, width), dtype=np.float32), workers=2)
    texture = fft.irfft2(noise / frequency**1.2, s=(height, width), workers=2)
    texture = np.exp(0.25 * texture / texture.std())
    scene *= texture
    for leaf in range(900):
        size = height / 6144 * 60 / np.sqrt(rng.uniform(0.004, 1))
        cy, cx, angle = rng.uniform(0, height), rng.uniform(0, width), rng.uniform(0, np.pi)
        box = np.s_[max(0, int(cy - size)) : int(cy + size) + 1, max(0, int(cx - size)) : int(cx + size) + 1]
        y, x = np.ogrid[box[0].start : min(height, box[0].stop), box[1].start : min(width, box[1].stop)]
        along = (y - cy) * np.cos(angle) + (x - cx) * np.sin(angle)
        across = (x - cx) * np.cos(angle) - (y - cy) * np.sin(angle)
        disc = along**2 + across**2 < size**2
        inside = disc if leaf % 2 else (abs(along) < 0.7 * size) & (abs(across) < 0.25 * size)
        value = rng.uniform(0, 1) ** 2
        scene[box][inside] = value if leaf % 3 == 0 else value * texture[box][inside]
    return np.clip(scene, 0, 2).astype(np.float32)


def caustic(height: int, width: int, seed: int):
    """Count rays through a smooth random height map, on a grid of ``height`` x ``width``."""
    import cv2

    rng = np.random.default_rng(seed)
    surface = rng.standard_normal((height // 4, width // 4)).astype(np.float32)
    surface = cv2.GaussianBlur(surface, (0, 0), 34 * height / 1024 / 4)
    surface = cv2.GaussianBlur(cv2.resize(surface, (width, height), interpolation=cv2.INTER_CUBIC), (0, 0), 4)
    slope_y, slope_x = np.gradient(surface)
    focus = 1 / np.gradient(slope_y, axis=0).std()
    margin_y, margin_x = height // 20, width // 20
    counts = np.zeros(height * width)
    for dy, dx in np.ndindex(2, 2):
        y = np.rint(np.arange(height)[:, None] + dy / 2 - 0.25 + focus * slope_y).astype(np.int64)
        x = np.rint(np.arange(width)[None] + dx / 2 - 0.25 + focus * slope_x).astype(np.int64)
        y, x = (v[margin_y : height - margin_y, margin_x : width - margin_x] for v in (y, x))
        lands = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        counts += np.bincount((y * width + x)[lands], minlength=height * width)
    return cv2.GaussianBlur(counts.reshape(height, width).astype(np.float32), (0, 0), 1.2)


def photograph(args: argparse.Namespace):
    """Return measurement, PSF and truth on the sensor's grid."""
    import cv2
    import tifffile
    from scipy import fft

    height, width = FINE * args.height, FINE * args.width
    scene = dense_scene(2 * height, 2 * width, seed=0)
    if args.psf:
        image = np.clip(tifffile.imread(args.psf).astype(np.float32) - args.dark, 0, None)
        psf = np.clip(cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC), 0, None)
    else:
        psf = caustic(height, width, seed=1)
    psf /= psf.sum(dtype=np.float64)
    padded = np.zeros(scene.shape, np.float32)
    padded[:height, :width] = psf
    # Fine pixels of one sensor pixel must stay together: the centre pixel is pixel n // 2 of the sensor.
    shift = [-(FINE * (n // 2)) for n in (args.height, args.width)]
    spectrum = fft.rfft2(np.roll(padded, shift, (0, 1)), workers=2) * fft.rfft2(scene, workers=2)
    light = fft.irfft2(spectrum, s=scene.shape, workers=2)
    top, left = (FINE * (n // 2) for n in (args.height, args.width))
    clean = binned(light[top : top + height, left : left + width])
    rng = np.random.default_rng(2)
    counts = rng.poisson(clean * args.photons / clean.mean()) / args.photons * clean.mean()
    coarse = rng.poisson(binned(psf) * FINE**2 * 2e4 * clean.size) / (2e4 * clean.size)
    truth = binned(scene)
    rows, columns = (slice(n // 2, n // 2 + n) for n in (args.height, args.width))
    return counts.astype(np.float32), coarse.astype(np.float32), truth[rows, columns]


def main() -> None:
    """Make the photograph, run the solvers, report."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--height", type=int, default=1024)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--seconds", type=float, default=60, help="for each of the other solvers")
    parser.add_argument("--photons", type=float, default=1e4)
    parser.add_argument("--psf", type=Path)
    parser.add_argument("--dark", type=float, default=34, help="subtracted from --psf")
    parser.add_argument("--out", type=Path, default=Path("dense-2d"))
    args = parser.parse_args()

    from recon.base.metrics import psnr
    from recon.camera.convolution import Convolution
    from recon.priors import NonNegativity, TotalVariation
    from recon.solvers import Admm, Fista, SensorAdmm, StoppingRules

    measurement, psf, truth = photograph(args)
    noise = float(measurement.mean() / np.sqrt(args.photons))
    energy = float(np.linalg.norm(psf))
    camera = Convolution((psf / energy)[None], measurement.shape)
    data = (measurement / noise)[None].astype(np.float32)
    (row, column), (height, width) = camera.centre, camera.sensor_shape
    top, left = row - height // 2, column - width // 2

    def picture(x):
        return x[0, top : top + height, left : left + width] * (noise / energy)

    def run(make, iterations: int | None, seconds: float | None):
        prior = TotalVariation(0.5) + NonNegativity()
        make(camera, data, prior).compile()
        began = time.perf_counter()
        solver = make(camera, data, prior)
        setup = time.perf_counter() - began
        curve = []

        def judge(solver, record):
            i = record.iteration
            if i <= 20 or (i <= 100 and i % 5 == 0) or i % 25 == 0:
                x = solver.solution
                misfit = 0.5 * float(np.sum((camera.forward(x) - data) ** 2, dtype=np.float64))
                value = misfit + prior.value(x)
                curve.append((i, setup + record.seconds, psnr(picture(x), truth), value))

        rules = StoppingRules(iterations=iterations, time_s=seconds, tolerance=0)
        return solver.run(rules, callback=judge).solution, np.array(curve)

    curves = {}
    best, curves["exact data, on the sensor"] = run(SensorAdmm, REFERENCE_ITERATIONS, None)
    _, curves["splitting"] = run(Admm, None, args.seconds)
    _, curves["FISTA"] = run(Fista, None, args.seconds)
    report(args, curves, truth, picture(best))


def report(args: argparse.Namespace, curves: dict, truth, best) -> None:
    """Print the table, write curves and picture."""
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    reference = curves["exact data, on the sensor"]
    converged, least = reference[-1, 2], min(c[:, 3].min() for c in curves.values())
    args.out.mkdir(parents=True, exist_ok=True)
    with (args.out / "dense-2d.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("solver", "iteration", "seconds", "psnr_db", "objective"))
        writer.writerows((name, *row) for name, curve in curves.items() for row in curve)
    print(
        f"{args.height} x {args.width}, {os.cpu_count()} CPUs ({platform.processor() or platform.machine()})"
    )
    print(f"converged: {converged:.2f} dB, least objective {least:.6g}")
    for name, c in curves.items():
        settled = first_for_good(c, c[:, 2] >= converged - 0.1)
        near = first_for_good(c, c[:, 3] <= 1.01 * least)
        pace = np.median(np.diff(c[:, 1]) / np.diff(c[:, 0]))
        print(
            f"{name:28s} {1000 * pace:5.0f} ms/iteration  within 0.1 dB: {settled}  "
            f"objective within 1 %: {near}  end {c[-1, 2]:.2f} dB at {c[-1, 1]:.0f} s"
        )
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.5), layout="constrained")
    for name, c in curves.items():
        axes[0].semilogx(c[:, 1], c[:, 2], label=name)
    axes[0].axhline(converged - 0.1, color="0.7", lw=0.8)
    axes[0].set(xlabel="seconds", ylabel="PSNR (dB)", ylim=(max(0, converged - 16), converged + 1))
    axes[0].legend()
    for axis, (title, image) in zip(axes[1:], (("truth", truth), ("reconstruction", best)), strict=True):
        axis.imshow(image, cmap="gray", vmax=np.percentile(truth, 99.5), vmin=0)
        axis.set(title=title, xticks=(), yticks=())
    figure.savefig(args.out / "dense-2d.png", dpi=100, bbox_inches="tight")
    print(f"curves and picture in {args.out}")


def first_for_good(curve, holds) -> str:
    """Say from which row on a condition holds to the end."""
    if not holds[-1]:
        return "not reached"
    start = 0 if holds.all() else int(np.flatnonzero(~holds)[-1]) + 1
    return f"{curve[start, 1]:.1f} s (iteration {curve[start, 0]:.0f})"


if __name__ == "__main__":
    main()
