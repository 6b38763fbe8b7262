"""Do the defaults need tuning? Volumes of different size, exposure, density and depth count, beside a search.

    python benchmarks/defaults_3d.py [--iterations 150]

For every scene the default (``reconstruct`` with nothing but the prior) is compared with the best tau
of a search over three decades. PSNR against the true scene on the voxel grid, in decibels.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lenslet_scene import Camera, beads, expose, tilted_bars

from recon import Calibration, reconstruct
from recon.base.threads import set_threads

SCENES = (
    ("few beads", 64, 8, "l1", 10, 3000.0),
    ("few beads, dim", 64, 8, "l1", 10, 100.0),
    ("many beads", 64, 16, "l1", 120, 3000.0),
    ("many beads, larger", 128, 16, "l1", 200, 10000.0),
    ("bars", 64, 8, "tv", 0, 3000.0),
    ("bars, dim", 64, 8, "tv", 0, 200.0),
    ("bars, many depths", 64, 24, "tv", 0, 3000.0),
    ("bars, larger", 128, 12, "tv", 0, 10000.0),
)
"""Name, sensor size, depths, prior, beads (0: tilted bars), photons at the brightest pixel."""


def psnr(volume: np.ndarray, truth: np.ndarray) -> float:
    """Return decibels after the best scale."""
    a, b = volume.astype(float), truth.astype(float)
    scale = np.vdot(a, b) / max(np.vdot(a, a), 1e-30)
    return float(10 * np.log10(b.max() ** 2 / np.mean((scale * a - b) ** 2)))


def main() -> None:
    """Compare and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--iterations", type=int, default=150)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--factors", type=float, nargs="+", default=[0.03, 0.1, 0.3, 3.0, 10.0, 30.0])
    a = parser.parse_args()
    set_threads(a.threads)
    print("| scene | voxels | prior | default: dB (tau) | best: dB (tau) | difference |")
    print("|---|---|---|---|---|---|")
    for name, size, depths, prior, count, photons in SCENES:
        camera = Camera(size, depths)
        points = beads(camera, count) if count else tilted_bars(camera)
        counts = expose(camera.render(points), photons)
        calibration = Calibration(camera.psfs(), np.full((depths, 3), np.nan))
        truth = camera.grid(points, (depths, size, size), (size // 2, size // 2))

        def judged(
            tau: float | None, counts=counts, calibration=calibration, prior=prior, truth=truth
        ) -> tuple[float, float]:
            r = reconstruct(counts, calibration, prior=prior, tau=tau, iterations=a.iterations)
            return psnr(r.volume, truth), r.tau

        default, tau = judged(None)
        tries = [judged(tau * factor) for factor in a.factors]
        best, best_tau = max([(default, tau), *tries])
        print(
            f"| {name} | {size} x {size} x {depths} | {prior} | {default:.2f} ({tau:.1e}) "
            f"| {best:.2f} ({best_tau:.1e}) | {best - default:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
