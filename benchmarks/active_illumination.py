"""Active illumination: what a picture gains from being lit part by part, against the number of frames.

    python benchmarks/active_illumination.py [--side 64] [--out FILE.png]

A dense scene (recon/evaluation) of points at continuous places, cast lenslet by lenslet: no grid, no
convolution. Patterns are soft spots of light on a lattice that add up to even light; the reconstruction
knows each only to 5 % in brightness. Every frame has the same exposure, so that n patterns give the scene
as much light in all as one even frame does, and read noise is paid n times. The even frame n times over,
averaged, has n times the light: it is the alternative for the same time. PSNR against the true picture,
brightness fitted, mean over scenes.
"""

from __future__ import annotations

import argparse
import os
import platform
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from recon import Measurement, reconstruct
from recon.base.metrics import psnr
from recon.base.threads import set_threads
from recon.evaluation.content import dense_picture
from recon.evaluation.lenslets import build_camera

COUNTS = (1, 4, 9, 16, 36)
PHOTONS = (300.0, 10000.0)
READ_NOISE = 2.0
PATTERN_ERROR = 0.05
ITERATIONS = 150


def spots(count: int, side: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return patterns at places given relative to the picture's side, (count, places), adding up to one."""
    n = round(np.sqrt(count))
    centres = (np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), -1).reshape(-1, 2) + 0.5) / n
    distance = (rows / side - centres[:, :1]) ** 2 + (columns / side - centres[:, 1:]) ** 2
    light = np.exp(-distance * n**2 / 0.5)
    return light / light.sum(axis=0)


def case(side: int, count: int, photons: float, seed: int, even_frames: int = 1) -> float:
    """Return the PSNR of one scene; ``even_frames`` even frames averaged when there is one pattern."""
    rng = np.random.default_rng(seed)
    camera = build_camera(side, seed=1)
    scale = camera.pitch_um * camera.focus_um / camera.distance_um
    picture = dense_picture(np.random.default_rng(100 + seed), 2 * side, 1.0)
    rows, columns = ((i + 0.5) / 2 for i in np.mgrid[: 2 * side, : 2 * side].reshape(2, -1).astype(float))
    points = np.column_stack(
        [
            -(columns - 0.5 - side // 2) * scale,
            -(rows - 0.5 - side // 2) * scale,
            np.full(rows.size, camera.focus_um),
            picture.ravel() / 4,
        ]
    )
    psf = camera.light([[0, 0, camera.focus_um, 1.0]])
    lit = spots(count, side, rows, columns)
    clean = np.stack([camera.light(np.column_stack([points[:, :3], points[:, 3] * p])) for p in lit])
    scale_counts = photons / float(clean.sum(axis=0).max())
    frames = np.mean(
        [
            rng.poisson(clean * scale_counts) + rng.normal(0, READ_NOISE, clean.shape)
            for _ in range(even_frames)
        ],
        axis=0,
    )
    pixel_rows, pixel_columns = (i + 0.5 for i in np.mgrid[:side, :side].reshape(2, -1).astype(float))
    known = spots(count, side, pixel_rows, pixel_columns).reshape(count, side, side)
    known = known * (1 + PATTERN_ERROR * rng.standard_normal((count, 1, 1)) * (count > 1))
    found = reconstruct(Measurement(frames, patterns=known), psf, iterations=ITERATIONS).image
    truth = picture.reshape(side, 2, side, 2).mean(axis=(1, 3))
    gain = float(np.vdot(found, truth) / np.vdot(found, found))
    return float(psnr(gain * found, truth))


def main() -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--side", type=int, default=64)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    set_threads(1)
    print(f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {os.cpu_count()} cores, {platform.machine()}")
    curves: dict[str, list[float]] = {}
    for photons in PHOTONS:
        for count in COUNTS:
            seeds = range(options.scenes)
            patterned = float(np.mean([case(options.side, count, photons, seed) for seed in seeds]))
            even = float(np.mean([case(options.side, 1, photons, seed, count) for seed in seeds]))
            curves.setdefault(f"patterns, {photons:g} photons", []).append(patterned)
            curves.setdefault(f"even light, {photons:g} photons", []).append(even)
            print(
                f"{photons:g} photons, {count} frames: patterns {patterned:.2f} dB, even light {even:.2f} dB",
                flush=True,
            )
    if options.out:
        from matplotlib.figure import Figure

        page = Figure(figsize=(6, 4), layout="constrained")
        axes = page.add_subplot()
        for name, values in curves.items():
            axes.plot(COUNTS, values, "o-" if name.startswith("patterns") else "s--", label=name)
        axes.set_xscale("log")
        axes.set_xticks(COUNTS, [str(n) for n in COUNTS])
        axes.set_xlabel("frames")
        axes.set_ylabel("PSNR (dB)")
        axes.legend()
        page.savefig(options.out, dpi=100)


if __name__ == "__main__":
    main()
