"""Rank correlation of the score on held-out pixels with the true error.

    python benchmarks/held_out_score.py [--size 32] [--seeds 1] [--scenes sparse-picture beads ...]

Every setting of ``diffuserbench chart`` at some counts of iterations, on simulated scenes with their truth;
prints Spearman's rank correlation between the error on held-out pixels and NRMSE for each scene: of all
points, of the settled ones, and of those of them that estimate no background (which a full picture may be
mistaken for); with the spread of the errors that are ranked, and what choosing by the score costs.
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

from recon.base.threads import set_threads
from recon.evaluation.chart_reconstruction import ChartProblem
from recon.evaluation.scene import make_scene
from recon.evaluation.scored import SETTLED_ITERATIONS, Point, even_with_best

SCENES = ("sparse-picture", "dense-picture", "beads")
COUNTS = (3, 10, 30, 90)


def points_of(family: str, size: int, seed: int) -> list[Point]:
    """Run every setting but the local model's and float64 (others differ from them by little)."""
    depths = {} if family.endswith("picture") else {"depths": 4}
    scene = make_scene(family, size=size, seed=seed, grid=3, fall_off_deg=20.0, **depths)
    problem = ChartProblem.of_scene(scene)
    return [
        point
        for setting in problem.settings()
        if setting.model != "local" and setting.binning == 1 and setting.precision == "float32"
        for point in problem.run(setting, counts=COUNTS).points
    ]


def told(points: list[Point]) -> str:
    """Say how many points there are, how their scores rank, and what choosing by them costs."""
    held = np.array([p.held_out for p in points])
    error = np.array([p.nrmse for p in points])
    cost = points[int(np.argmin(held))].psnr_db - max(p.psnr_db for p in points)
    low, high = np.quantile(error, [0.1, 0.9])
    return f"{len(points):3} {spearmanr(held, error).statistic:5.2f} {low:5.2f} {high:5.2f} {cost:6.2f}"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=301, help="first seed")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    arguments = parser.parse_args()
    set_threads(1)
    print(f"{datetime.now(UTC):%Y-%m-%d}, {platform.processor() or platform.machine()}")
    print("n, rank correlation, NRMSE of the 10 % and 90 % quantile, dB lost by choosing by the score")
    for family in arguments.scenes:
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            points = points_of(family, arguments.size, seed)
            settled = [p for p in points if not 0 < p.iterations < SETTLED_ITERATIONS]
            plain = [p for p in settled if "background" not in p.setting]
            even = even_with_best(points)
            spread = max(p.psnr_db for p in even) - min(p.psnr_db for p in even)
            print(
                f"{family:16} seed {seed}: all {told(points)} | settled {told(settled)} | "
                f"without background {told(plain)} | {len(even)} even with the best, {spread:.1f} dB apart",
                flush=True,
            )


if __name__ == "__main__":
    main()
