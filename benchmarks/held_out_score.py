"""Rank correlation of the score on held-out pixels with the true error.

    python benchmarks/held_out_score.py [--size 32] [--seeds 1] [--scenes sparse-picture beads ...]

Every setting of ``diffuserbench chart`` at some counts of iterations, on simulated scenes with their truth;
prints Spearman's rank correlation between the error on held-out pixels and NRMSE for each scene, for all
settings and for those of one model and binning, and what choosing by it costs.
"""

from __future__ import annotations

import argparse
import platform
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scipy.stats import spearmanr

from recon.chart.reconstruction import ChartProblem, run_setting, settings_for
from recon.chart.scored import Point
from recon.scenes import make_scene
from recon.threads import set_threads

SCENES = ("sparse-picture", "dense-picture", "beads")
COUNTS = (3, 10, 30, 90)


def points_of(family: str, size: int, seed: int) -> list[Point]:
    """Run every setting but the local model's and float64 (others differ from them by little)."""
    depths = {} if family.endswith("picture") else {"depths": 4}
    scene = make_scene(family, size=size, seed=seed, grid=3, fall_off_deg=20.0, **depths)
    problem = ChartProblem(
        scene.measurement,
        scene.calibration,
        not scene.spec.is_picture,
        scene.erasures,
        scene.noise,
        scene.truth,
    )
    return [
        point
        for setting in settings_for(problem)
        if setting.model != "local" and setting.binning == 1 and setting.precision == "float32"
        for point in run_setting(problem, setting, counts=COUNTS).points
    ]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    arguments = parser.parse_args()
    set_threads(1)
    print(f"{datetime.now(UTC):%Y-%m-%d}, {platform.processor() or platform.machine()}")
    for family in arguments.scenes:
        for seed in range(201, 201 + arguments.seeds):
            points = points_of(family, arguments.size, seed)
            held = np.array([p.held_out for p in points])
            error = np.array([p.nrmse for p in points])
            even = np.array([" convolution " in f" {p.setting} " for p in points])
            cost = points[int(np.argmin(held))].psnr_db - max(p.psnr_db for p in points)
            print(
                f"{family:16} seed {seed}: {len(points)} points, rank correlation "
                f"{spearmanr(held, error).statistic:.2f} (convolution alone "
                f"{spearmanr(held[even], error[even]).statistic:.2f}); the best by held-out pixels is "
                f"{cost:+.2f} dB from the best: {points[int(np.argmin(held))].setting}",
                flush=True,
            )


if __name__ == "__main__":
    main()
