"""Which method for pictures: ``admm`` against ``admm-sensor`` with default settings on scenes of every kind.

    python benchmarks/picture_method.py [--width 320] [--hand-width 480] [--only NAME ...] [--out FILE.csv]

Each scene is reconstructed by ``recon.reconstruct`` as a user would, up to its own stopping rule (at most 300
iterations), once by either method. Printed are iterations, processor seconds, the objective after 100
iterations of either (``--objective-at``), and PSNR against the truth, where it is known, when the method
stopped, beside the best of ``--taus`` weights with 300 iterations of either method.

Scenes are photographed on a grid three times finer than the sensor's, by full-size convolution that knows
nothing of the reconstruction's grid (``dense_2d.py``, and single lights). The hand is the measured one
(``DIFFUSERBENCH_DATA``).
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


from benchmarks.admm_hand import DATA, inputs
from benchmarks.against_lensless import resized
from benchmarks.dense_2d import binned, caustic, photograph
from recon import Measurement, Problem, Reconstruction, reconstruct
from recon.base.metrics import psnr
from recon.priors import TotalVariation
from recon.reconstruction.part import Part

METHODS = ("admm", "admm-sensor")
FINE = 3


@dataclass(frozen=True)
class Case:
    """A photograph with its PSF, and the truth on the sensor's grid where it is known."""

    measurement: np.ndarray
    psf: np.ndarray
    truth: np.ndarray | None = None
    erasures: np.ndarray | None = None
    noise: float | None = None


def dense(width: int, photons: float) -> Case:
    """Return a scene that fills twice the field."""
    height = width * 4 // 5
    measurement, psf, truth = photograph(
        SimpleNamespace(height=height, width=width, photons=photons, psf=None, dark=0.0)
    )
    return Case(measurement, psf, truth)


def drawn(width: int, snr: float, lights: bool, erased: float = 0.0) -> Case:
    """Return blocks on black, or single lights of a pixel, inside the field."""
    from scipy.signal import fftconvolve

    height = width * 4 // 5 | 1
    width |= 1  # odd: the fine grid's centre pixel lies in the middle of the sensor's
    rng = np.random.default_rng(3)
    psf = caustic(FINE * height // 4 * 4, FINE * width // 4 * 4, seed=1)
    psf = np.pad(psf, [(0, FINE * n - m) for n, m in zip((height, width), psf.shape, strict=True)])
    scene = np.zeros((FINE * height, FINE * width))
    for _ in range(25 if lights else 24):
        y, x = (int(rng.uniform(0.2, 0.8) * n) for n in (height, width))
        h, w = (1, 1) if lights else rng.integers(3, height // 5, 2)
        scene[FINE * y : FINE * (y + h), FINE * x : FINE * (x + w)] = rng.uniform(0.3, 1)
    clean = np.maximum(binned(fftconvolve(scene, psf / psf.sum(), mode="same")), 0)
    noise = float(clean.mean() / snr)
    coarse = binned(psf)
    truth = binned(scene)
    valid = np.random.default_rng(4).random(clean.shape) >= erased
    return Case(
        (clean + noise * rng.standard_normal(clean.shape)).astype(np.float32),
        coarse.astype(np.float32),
        truth,
        None if not erased else ~valid,
        noise,
    )


def hand(width: int) -> Case:
    """Return the measured hand."""
    psf, raw = (resized(image, width * 9 // 16, width) for image in inputs(1))
    return Case(raw, np.maximum(psf, 0))


def cases(width: int, hand_width: int) -> dict[str, object]:
    """Return what makes each scene."""
    return {
        "dense, 1 % noise": lambda: dense(width, 1e4),
        "dense, 0.3 % noise": lambda: dense(width, 1e5),
        "dense, 5 % noise": lambda: dense(width, 400),
        "blocks, SNR 100": lambda: drawn(width // 2, 100, lights=False),
        "blocks, SNR 1000": lambda: drawn(width // 2, 1000, lights=False),
        "lights, SNR 100": lambda: drawn(width // 2, 100, lights=True),
        "lights, half erased": lambda: drawn(width // 2, 100, lights=True, erased=0.5),
        **({"measured hand": lambda: hand(hand_width)} if DATA.is_dir() else {}),
    }


def quality(case: Case, image: np.ndarray) -> float:
    """Return PSNR after one least-squares factor; NaN without a truth."""
    if case.truth is None:
        return np.nan
    factor = float(np.vdot(image, case.truth) / max(np.vdot(image, image), 1e-30))
    return float(psnr(factor * image, case.truth))


def objective(case: Case, result: Reconstruction) -> float:
    """Judge a result's non-negative object, by one function for both methods."""
    problem = Problem.of(Measurement(case.measurement, case.noise, erasures=case.erasures), case.psf)
    part = Part(problem, slice(0, problem.n_channels))
    weight = float(result.tau or 0.0) * part.peak()
    x = np.asarray(result.state / problem.image_scale)
    misfit = part.operator.forward(x) - part.data
    return 0.5 * float(np.sum(misfit**2, dtype=np.float64)) + TotalVariation(weight).value(x)


def run(case: Case, method: str, at: int, taus: list[float]) -> dict[str, float]:
    """Reconstruct with defaults; then with other weights."""
    given = {"erasures": case.erasures, "noise": case.noise, "solver": method}
    tiny = np.random.default_rng(0).random((2, 9, 9))
    reconstruct(*tiny, solver=method, iterations=3)  # compiles
    began = time.process_time()
    result = reconstruct(case.measurement, case.psf, iterations=300, **given)
    seconds = time.process_time() - began
    longer = reconstruct(case.measurement, case.psf, iterations=at, tolerance=0, **given)
    values = [
        quality(case, reconstruct(case.measurement, case.psf, iterations=300, tau=tau, **given).image)
        for tau in taus
        if case.truth is not None
    ]
    return {
        "iterations": len(result.history),
        "processor_s": seconds,
        "objective": objective(case, longer),
        "psnr_db": quality(case, result.image),
        "brightest": float(result.image.max()),
        "best_psnr_db": max(values, default=np.nan),
        "tau": float(result.tau or 0.0),
    }


def main() -> None:
    """Run every scene by either method."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--hand-width", type=int, default=480)
    parser.add_argument("--objective-at", type=int, default=100)
    parser.add_argument("--taus", type=float, nargs="*", default=[])
    parser.add_argument("--only", nargs="+", help="parts of the scenes' names")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    print(
        "| scene | method | iterations | processor s | objective after "
        f"{options.objective_at} | PSNR | best weight's |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, make in cases(options.width, options.hand_width).items():
        if options.only and not any(part in name for part in options.only):
            continue
        case = make()
        for method in METHODS:
            row = run(case, method, options.objective_at, options.taus)
            rows.append({"scene": name, "method": method, **row})
            print(
                f"| {name} | {method} | {row['iterations']} | {row['processor_s']:.2f} | "
                f"{row['objective']:.4g} | {row['psnr_db']:.2f} | {row['best_psnr_db']:.2f} |",
                flush=True,
            )
    if options.out:
        with options.out.open("w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)


if __name__ == "__main__":
    main()
