"""CPU time to accuracy of the volume solvers on two scenes, as a table and as curves.

    python benchmarks/time_to_accuracy_3d.py [--sensor 128] [--depths 32] [--scenes beads bars] [--picture
    FILE]

The default (lean TV, its own penalties) against the literal ADMM of A.3 written well (``literal_fused.py``),
with its best constants of a search on the same scene and with residual balancing, and FISTA with Haar TV.
Scenes are rendered point by point at continuous positions (``lenslet_scene.py``). All solve the same problem
with TV; the literal one wraps around in depth, which the empty outermost planes keep from mattering.

Accuracy: PSNR against the true scene on the voxel grid, and the objective's gap to the best value found by
any method. Times are CPU seconds on one thread, so that other work on the
machine does not count.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lenslet_scene import Camera, beads, expose, tilted_bars
from literal_fused import FusedLiteralAdmm

from recon.base.threads import set_threads
from recon.camera.convolution import Convolution
from recon.priors import HaarTotalVariation, NonNegativity, TotalVariation
from recon.solvers import Fista
from recon.solvers.tv_admm_volume import LeanTotalVariation
from tests.recon.solvers.literal_volume import LiteralAdmm


@dataclass
class Scene:
    """A measurement in units of its noise, with the truth."""

    name: str
    operator: Convolution
    data: np.ndarray
    truth: np.ndarray
    window: tuple[slice, slice, slice]
    weight: float

    def psnr(self, x: np.ndarray) -> float:
        """In decibels, inside the sensor's field, after the best scale."""
        a, b = x[0][self.window].astype(float), self.truth[self.window].astype(float)
        scale = np.vdot(a, b) / max(np.vdot(a, a), 1e-30)
        return float(10 * np.log10(b.max() ** 2 / np.mean((scale * a - b) ** 2)))

    def objective(self, x: np.ndarray) -> float:
        """Return data term and TV, without wrapping in depth."""
        v = x[0]
        tv = sum(float(np.abs(np.roll(v, -1, axis) - v).sum(dtype=np.float64)) for axis in (1, 2))
        tv += float(np.abs(np.diff(v, axis=0)).sum(dtype=np.float64))
        misfit = self.operator.forward(x) - self.data
        return 0.5 * float(np.vdot(misfit, misfit)) + self.weight * tv


@dataclass
class Curve:
    """What a method reached at which CPU second."""

    seconds: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)
    objective: list[float] = field(default_factory=list)


def scene(name: str, size: int, depths: int, photons: float = 3000) -> Scene:
    """Render and scale a scene."""
    camera = Camera(size, depths)
    points = beads(camera, 60) if name == "beads" else tilted_bars(camera)
    counts = expose(camera.render(points), photons)
    psfs = camera.psfs()
    deviation = np.float32(np.sqrt(counts.mean() + 4))
    energy = np.float32(np.sqrt(np.mean(np.sum(psfs**2, axis=(2, 3)))))
    operator = Convolution(psfs / energy, (size, size))
    truth = camera.grid(points, operator.domain_shape[1:], operator.centre)
    half, (row, column) = size // 2, operator.centre
    window = (slice(None), slice(row - half, row + half), slice(column - half, column + half))
    return Scene(name, operator, counts[None] / deviation, truth, window, 1.0)


def follow(
    curve: Curve, s: Scene, step: Callable[[], object], solution: Callable[[], np.ndarray], budget: float
) -> None:
    """Run a solver until ``budget`` CPU seconds, looking at it ever more seldom; looking is not counted."""
    spent, iteration, due = curve.seconds[-1] if curve.seconds else 0.0, 0, 1.0
    while spent < budget:
        began = time.process_time()
        step()
        spent += time.process_time() - began
        iteration += 1
        if iteration >= due:
            due = max(iteration + 1, iteration * 1.12)
            x = solution()
            curve.seconds.append(spent)
            curve.psnr.append(s.psnr(x))
            curve.objective.append(s.objective(x))


def best_constants(s: Scene, budget: float) -> tuple[float, float, float]:
    """Search the literal ADMM's penalties for the lowest objective after ``budget`` CPU seconds each."""
    mean = float(s.operator.power().mean())
    best, found = np.inf, (1.0, 1.0, 1.0)
    for mu1 in (0.01, 0.1, 1.0):
        for mu2 in (0.03 * mean * mu1, 0.3 * mean * mu1, 3 * mean * mu1):
            for mu3 in (0.1 * mu2, mu2, 10 * mu2):
                solver = FusedLiteralAdmm(s.operator, s.data, s.weight, penalties=(mu1, mu2, mu3))
                curve = Curve()
                follow(curve, s, solver.step, lambda solver=solver: solver.solution, budget)
                if curve.objective[-1] < best:
                    best, found = curve.objective[-1], (mu1, mu2, mu3)
    return found


def main() -> None:
    """Measure, tabulate, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sensor", type=int, default=128)
    parser.add_argument("--depths", type=int, default=32)
    parser.add_argument("--scenes", nargs="+", default=["beads", "bars"])
    parser.add_argument("--budget", type=float, default=60.0, help="CPU seconds for the slower methods")
    parser.add_argument("--search", type=float, default=4.0, help="CPU seconds for each set of constants")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--picture", type=Path, default=Path("time_to_accuracy_3d.png"))
    a = parser.parse_args()
    set_threads(a.threads)
    all_curves = {}
    for name in a.scenes:
        s = scene(name, a.sensor, a.depths)
        lean = LeanTotalVariation(s.operator, s.data, TotalVariation.of_volume(s.weight) + NonNegativity())
        constants = best_constants(s, a.search)
        fused = FusedLiteralAdmm(s.operator, s.data, s.weight, penalties=constants)
        balanced = LiteralAdmm(s.operator, s.data, s.weight, penalties=constants, balance=True)
        haar = HaarTotalVariation(s.weight, n_axes=3, separable=NonNegativity())
        fista = Fista(s.operator, s.data, haar)

        def step(solver: LeanTotalVariation | LiteralAdmm) -> None:
            solver.step()
            solver.iteration += 1

        curves = {
            "default (lean TV)": (Curve(), lambda s=lean: step(s), lambda s=lean: s.solution, a.budget),
            "literal, best constants": (Curve(), fused.step, lambda s=fused: s.solution, a.budget),
            "literal, balanced": (
                Curve(),
                lambda s=balanced: step(s),
                lambda s=balanced: s.solution,
                a.budget,
            ),
            "FISTA, Haar TV": (Curve(), fista.step, lambda s=fista: s.solution, a.budget),
        }
        for curve, advance, solution, budget in curves.values():
            follow(curve, s, advance, solution, budget)
        all_curves[name] = {k: c[0] for k, c in curves.items()}
        _table(name, all_curves[name], s, constants)
    _draw(all_curves, a.picture)


def _first(curve: Curve, reached: list[bool]) -> float:
    """CPU second from which a condition holds for good."""
    last_miss = max((i for i, ok in enumerate(reached) if not ok), default=-1)
    return curve.seconds[last_miss + 1] if last_miss + 1 < len(reached) else np.inf


def _table(name: str, curves: dict[str, Curve], s: Scene, constants: tuple[float, float, float]) -> None:
    best = min(min(c.objective) for c in curves.values())
    final = curves["default (lean TV)"].psnr[-1]
    print(f"\n{name}: {s.operator.domain_shape[1:]} voxels, literal's best mu {constants}")
    print(f"converged {final:.2f} dB\n\n| method | CPU s to 0.1 dB | CPU s to 1 % gap | end: dB | end: gap |")
    print("|---|---|---|---|---|")
    for method, c in curves.items():
        to_psnr = _first(c, [abs(p - final) <= 0.1 for p in c.psnr])
        to_gap = _first(c, [o <= 1.01 * best for o in c.objective])
        print(
            f"| {method} | {to_psnr:.1f} | {to_gap:.1f} | {c.psnr[-1]:.2f} "
            f"| {c.objective[-1] / best - 1:.2%} |",
            flush=True,
        )


def _draw(all_curves: dict[str, dict[str, Curve]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(all_curves), figsize=(6.5 * len(all_curves), 8), squeeze=False)
    for column, (name, curves) in enumerate(all_curves.items()):
        best = min(min(c.objective) for c in curves.values())
        for method, c in curves.items():
            axes[0, column].semilogx(c.seconds, c.psnr, label=method)
            axes[1, column].loglog(c.seconds, [max(o / best - 1, 1e-6) for o in c.objective], label=method)
        axes[0, column].set(title=name, ylabel="PSNR (dB)")
        axes[1, column].set(xlabel="CPU seconds", ylabel="objective above the best, relative")
        axes[0, column].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
