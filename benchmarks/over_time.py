"""Priors over time on beads that flash while they stand, drift or run: where they help, and where they hurt.

    python benchmarks/over_time.py [--frames 16] [--out FILE.png]

Light is cast lenslet by lenslet from points at continuous places (recon/evaluation/lenslets.py). For each
speed and each number of photons in the brightest pixel: squared error of the pictures against the beads' true
light (blurred by one pixel, brightness fitted), relative to frames solved alone by the same solver with as
many iterations.
"""

from __future__ import annotations

import argparse
import os
import platform
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from activity import SHAPE, expose, points
from scipy import ndimage

from recon.base.threads import set_threads
from recon.evaluation.lenslets import build_camera
from recon.streams.joint import OVER_TIME, solve_together
from recon.streams.video import stream_problem

SPEEDS_PX = (0.0, 0.1, 0.3, 1.0, 3.0)
PHOTONS = (30.0, 300.0)
BEADS = 30
ITERATIONS = 30


def block(frames: int, speed: float, photons: float, seed: int = 0):
    """Return PSF, noisy frames and true pictures of beads that move along rows and flash now and then."""
    rng = np.random.default_rng(seed)
    camera = build_camera(SHAPE, seed=1)
    psf = camera.light([[0, 0, camera.focus_um, 1.0]])
    places = rng.uniform(-0.35, 0.35, (BEADS, 2)) * SHAPE
    light = rng.uniform(0.5, 1.5, (BEADS, 1)) * (1 + (rng.random((BEADS, frames)) < 0.1))
    raw, truth = [], []
    brightest = float(camera.light(points(camera, places, light[:, 0])).max())
    for t in range(frames):
        at = places + np.array([0.0, speed * (t - frames / 2)])
        clean = camera.light(points(camera, at, light[:, t]))
        raw.append(expose(clean / brightest, photons, rng))
        truth.append(_picture(at, light[:, t]))
    return psf, np.stack(raw), np.stack(truth)


def _picture(places: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return points as a picture, each shared by its four nearest pixels, blurred by one pixel."""
    image = np.zeros(SHAPE)
    for (row, column), value in zip(places + np.array(SHAPE) // 2, light, strict=True):
        y, x = int(np.floor(row)), int(np.floor(column))
        for dy, dx in np.ndindex(2, 2):
            if 0 <= y + dy < SHAPE[0] and 0 <= x + dx < SHAPE[1]:
                share = (1 - abs(row - y - dy)) * (1 - abs(column - x - dx))
                image[y + dy, x + dx] += value * share
    return ndimage.gaussian_filter(image, 1.0)


def error(pictures: np.ndarray, truth: np.ndarray) -> float:
    """Return the squared error relative to the truth's power, pictures blurred alike, brightness fitted."""
    soft = np.stack([ndimage.gaussian_filter(picture, 1.0) for picture in pictures])
    gain = float(np.vdot(soft, truth) / np.vdot(soft, soft))
    return float(np.sum((gain * soft - truth) ** 2) / np.sum(truth**2))


def draw(found: dict[tuple[float, str], list[float]], path: Path) -> None:
    """Draw the squared errors relative to frames alone against the speed."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(7, 4), layout="constrained")
    axes = page.add_subplot()
    for (photons, name), ratios in found.items():
        style = "o-" if name == "tv" else "s--"
        axes.plot(SPEEDS_PX, ratios, style, label=f"{name}, {photons:g} photons")
    axes.axhline(1, color="0.6", lw=0.8)
    axes.set_xscale("symlog", linthresh=0.1)
    axes.set_xlim(-0.01, 1.2 * SPEEDS_PX[-1])
    axes.set_xticks(SPEEDS_PX, [f"{speed:g}" for speed in SPEEDS_PX])
    axes.set_xlabel("speed (pixels a frame)")
    axes.set_ylabel("squared error relative to frames alone")
    axes.legend()
    page.savefig(path, dpi=100)


def main() -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    set_threads(1)
    print(f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {os.cpu_count()} cores, {platform.machine()}")
    found: dict[tuple[float, str], list[float]] = {}
    for photons in PHOTONS:
        for speed in SPEEDS_PX:
            psf, raw, truth = block(options.frames, speed, photons)
            camera = stream_problem(raw[0], psf)
            alone = error(solve_together(camera, raw, "tv", weight=0.0, iterations=ITERATIONS), truth)
            line = f"{photons:g} photons, {speed:g} px a frame: alone {alone:.4f}"
            for name in OVER_TIME:
                ratio = error(solve_together(camera, raw, name, iterations=ITERATIONS), truth) / alone
                found.setdefault((photons, name), []).append(ratio)
                line += f", {name} x {ratio:.2f}"
            print(line, flush=True)
    if options.out:
        draw(found, options.out)


if __name__ == "__main__":
    main()
