"""How fast the local model's solver converges: a picture of bars under a PSF that falls off over the field.

    python benchmarks/local_solver.py [--size 256] [--budget 40] [--picture FILE]

Bars as dense points, each cast lenslet by lenslet at its continuous position, weighted by the sensor's
angular response about the source (Kuo 2020, Eq. 5.1); photon and read noise. 25 PSFs calibrated on a 5 x 5
grid, taken through registration as a user's would be. ``OperatorAdmm`` and ``Fista`` on the same problem with
TV; PSNR against the true scene over processor seconds, on one thread. And one PSF for the whole field.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from pathlib import Path

import numpy as np
from numba import njit

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lenslet_scene import expose

from recon import Calibration, Measurement, NoiseModel, Options, Problem
from recon.base.threads import set_threads
from recon.evaluation.lenslets import stamp
from recon.priors import NonNegativity, TotalVariation
from recon.reconstruction.part import Part
from recon.reconstruction.solvers import SOLVERS
from recon.solvers import Fista, Solver, StoppingRules

READ_NOISE = 2.0


@njit(nogil=True)
def _cast(image, points, lenses, brightness, fall_off):
    half = image.shape[0] // 2
    for p in range(points.shape[0]):
        y, x, light = points[p]
        for k in range(lenses.shape[0]):
            row, column = y + lenses[k, 0], x + lenses[k, 1]
            # The response is centred beneath the source, across the axis from its pattern.
            response = np.exp(-((row + y) ** 2 + (column + x) ** 2) / (2 * fall_off**2))
            if -9 < row + half < image.shape[0] + 9 and -9 < column + half < image.shape[1] + 9:
                stamp(image, row + half, column + half, 1.0, light * brightness[k] * response)


def cast(size: int, points: np.ndarray) -> np.ndarray:
    """Return the noise-free measurement of points ``(y, x, light)``."""
    rng = np.random.default_rng(0)
    lenses = rng.uniform(-0.12, 0.12, (60, 2)) * size
    image = np.zeros((size, size), np.float32)
    _cast(image, np.asarray(points, float), lenses, rng.uniform(0.5, 1.5, 60), 0.6 * size)
    return image


def bars(size: int) -> np.ndarray:
    """Return bars of falling width, as points half a pixel apart."""
    points, x, width = [], -0.4 * size, size / 16
    while x + width < 0.4 * size:
        y, c = np.meshgrid(np.arange(-0.35 * size, 0.35 * size, 0.5), np.arange(x, x + width, 0.5))
        points.append(np.stack([y.ravel(), c.ravel(), np.full(y.size, 0.25)], axis=1))
        x, width = x + 2 * width, max(0.85 * width, 2.0)
    return np.concatenate(points)


def truth_of(size: int, points: np.ndarray) -> np.ndarray:
    """Return the points' light on the pixel grid, shared bilinearly."""
    image = np.zeros((size, size))
    y, x, light = points.T
    row, column = np.floor(y).astype(int), np.floor(x).astype(int)
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dy - (y - row)) * np.abs(1 - dx - (x - column))
            np.add.at(image, (row + dy + size // 2, column + dx + size // 2), light * weight)
    return image


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Return decibels after the best scale."""
    scale = np.vdot(image, truth) / max(np.vdot(image, image), 1e-30)
    return float(10 * np.log10(truth.max() ** 2 / np.mean((scale * image - truth) ** 2)))


def main() -> None:
    """Run, tabulate, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--budget", type=float, default=40.0, help="processor seconds of each method")
    parser.add_argument("--picture", type=Path, default=Path("local_solver.png"))
    a = parser.parse_args()
    set_threads(1)
    size = a.size
    points = bars(size)
    truth = truth_of(size, points)
    counts = expose(cast(size, points), 4000.0, READ_NOISE)
    places = [(r, c) for r in np.linspace(-0.4, 0.4, 5) * size for c in np.linspace(-0.4, 0.4, 5) * size]
    psfs = np.stack([cast(size, np.array([[r, c, 1.0]]))[None] for r, c in places])
    positions = np.array([(-10 * c, -10 * r, 20_000.0) for r, c in places])
    measurement = Measurement(counts, NoiseModel(READ_NOISE, 1.0))
    top = size - 1 - size // 2  # of the sensor's part of a field of sensor and PSF
    window = slice(top, top + size)
    curves: dict[str, list[tuple[float, float]]] = {}
    for model, method in (("local", "OperatorAdmm"), ("local", "Fista"), ("convolution", "one PSF")):
        options = Options(model=model, prior="tv", solver="admm")
        part = Part(Problem.of(measurement, Calibration(psfs, positions), options), slice(0, 1))
        part.weigh(None)

        def build(part=part, method=method) -> Solver:
            if method != "Fista":
                return SOLVERS["admm"].make(part, None)
            tv = TotalVariation(
                part.weight, axis_weights=(0.0, 1.0, 1.0), wrap=(False,) * 3, tolerance=1e-4, max_inner=20
            )
            return Fista(part.operator, part.data, tv + NonNegativity())

        build().step()  # compile
        curve: list[tuple[float, float]] = []
        looked = [0.0]
        cancel = threading.Event()
        solver = build()
        began = time.process_time()

        def note(s, _, curve=curve, looked=looked, began=began, cancel=cancel) -> None:
            now = time.process_time()
            seconds = now - began - looked[0]
            if len(curve) < 8 or seconds > 1.08 * curve[-1][0]:
                curve.append((seconds, psnr(s.solution[..., window, window].squeeze().astype(float), truth)))
            if seconds > a.budget:
                cancel.set()
            looked[0] += time.process_time() - now

        outcome = solver.run(StoppingRules(iterations=5000, tolerance=0), callback=note, cancel=cancel)
        curves[method] = curve
        print(f"{method}: {len(outcome.history)} iterations", flush=True)
    best = max(curve[-1][1] for curve in curves.values())
    print("\n| method | processor s to within 0.1 dB of the best | PSNR at the end |\n|---|---|---|")
    for method, curve in curves.items():
        near = next((f"{s:.1f}" for s, decibels in curve if decibels >= best - 0.1), "not reached")
        print(f"| {method} | {near} | {curve[-1][1]:.2f} dB |")
    _draw(curves, a.picture)


def _draw(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 4.2))
    for name, curve in curves.items():
        axis.plot([s for s, _ in curve], [d for _, d in curve], ".-", label=name)
    axis.set(xlabel="processor seconds", xscale="log", ylabel="PSNR (dB)")
    axis.grid(alpha=0.3)
    axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
