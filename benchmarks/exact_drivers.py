"""One picture (total variation, non-negative) by the three exact drivers of iterations, on one thread.

    python benchmarks/exact_drivers.py [--height 192] [--width 240] [--scene dense]

Prints processor time an iteration, and until the objective is within 3, 1 and 0.3 % of the best
that any reached.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter

from recon.base import threads
from recon.camera.convolution import Convolution
from recon.priors import NonNegativity, TotalVariation
from recon.solvers import Admm, SensorAdmm
from recon.solvers.base import Solver
from recon.solvers.splitting import SensorData
from recon.solvers.tv_admm_volume import LeanTotalVariation

ITERATIONS = 300


def main() -> None:
    """Simulate a photograph, solve it three times."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--scene", choices=("dense", "sparse"), default="dense")
    a = parser.parse_args()
    threads.set_threads(1)
    rng, shape = np.random.default_rng(0), (a.height, a.width)
    speckle = gaussian_filter(rng.standard_normal(shape), 3)
    psf = np.maximum(speckle - 1.2 * speckle.std(), 0).astype(np.float32) ** 2
    psf /= np.linalg.norm(psf)
    flat, deep = Convolution(psf[None], shape), Convolution(psf[None, None], shape)
    counts = flat.forward(_scene(rng, flat, dense=a.scene == "dense"))
    data = counts / (0.02 * counts.mean()) + rng.standard_normal(counts.shape).astype(np.float32)
    weight = 2e-3 * float(np.abs(flat.adjoint(data)).max())
    prior = TotalVariation(weight) + NonNegativity()
    of_volume = TotalVariation.of_volume(weight) + NonNegativity()

    def objective(x: np.ndarray) -> float:
        x = x.reshape(flat.domain_shape)
        return 0.5 * float(np.linalg.norm(flat.forward(x) - data)) ** 2 + TotalVariation(weight).value(x)

    made: dict[str, Callable[[], Solver]] = {
        "Admm": lambda: Admm(flat, data, prior),
        "SensorAdmm": lambda: SensorAdmm(flat, data, prior),
        "LeanTotalVariation": lambda: LeanTotalVariation(deep, SensorData(data), of_volume),
    }
    traces = {name: _trace(make, objective) for name, make in made.items()}
    best = min(value for trace in traces.values() for _, value in trace)
    for name, trace in traces.items():
        each = 1e3 * trace[-1][0] / len(trace)
        reached = []
        for apart in (0.03, 0.01, 0.003):
            k = next((k for k, (_, value) in enumerate(trace) if value < best * (1 + apart)), None)
            reached.append(
                f"{apart:.1%}: " + ("-" if k is None else f"{k + 1} it., {1e3 * trace[k][0]:.0f} ms")
            )
        print(f"{name:20} {each:6.2f} ms an iteration; to {'; '.join(reached)}")


def _scene(rng: np.random.Generator, camera: Convolution, *, dense: bool) -> np.ndarray:
    height, width = (n // 2 for n in camera.sensor_shape)
    scene = np.zeros((height, width), np.float32)
    if dense:
        cloud = gaussian_filter(rng.standard_normal((height, width)), 4)
        scene += 10 + 50 * (cloud > cloud.mean())
    else:
        scene[rng.integers(0, height, 60), rng.integers(0, width, 60)] = 3000
    x = np.zeros(camera.domain_shape, np.float32)
    top, left = camera.centre[0] - height // 2, camera.centre[1] - width // 2
    x[0, top : top + height, left : left + width] = scene
    return x


def _trace(make: Callable[[], Solver], objective: Callable[[np.ndarray], float]) -> list[tuple[float, float]]:
    """Return processor time so far and objective after each iteration; compilation is done before."""
    warm = make()
    warm.compile()
    warm.advance()
    solver, spent, trace = make(), 0.0, []
    for _ in range(ITERATIONS):
        began = time.process_time()
        solver.advance()
        spent += time.process_time() - began
        trace.append((spent, objective(solver.solution)))
    return trace


if __name__ == "__main__":
    main()
