"""What leaving out empty depth planes gains with l1, and that it changes nothing.

    python benchmarks/empty_planes.py [--sensor 128] [--depths 64] [--beads 60] [--iterations 300]

Beads in two thin layers, rendered lenslet by lenslet at continuous positions (``lenslet_scene.py``). The same
reconstruction with and without planes left out, to the same tolerance; processor time, objective of the
results (one forward model for both), and the certificate: the optimality condition on the planes left out.
Beside it, how many planes total variation of the same weight leaves empty.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lenslet_scene import Camera, expose

from recon.base.threads import set_threads
from recon.camera.convolution import Convolution
from recon.priors import L1, NonNegativity, TotalVariation
from recon.solvers import StoppingRules
from recon.solvers.douglas_rachford import SparseDouglasRachford
from recon.solvers.splitting import Tuning
from recon.solvers.tv_admm_volume import LeanTotalVariation


def layers(camera: Camera, count: int, seed: int = 1) -> np.ndarray:
    """Return beads in two layers, a twentieth of the depth each."""
    rng = np.random.default_rng(seed)
    y, x = rng.uniform(-0.42, 0.42, (2, count)) * camera.size
    depth = rng.choice([0.3, 0.7], count) + rng.uniform(-0.025, 0.025, count)
    return np.stack([y, x, 1 + camera.span * depth, rng.uniform(0.5, 1.5, count)], axis=1)


def main() -> None:
    """Compare and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sensor", type=int, default=128)
    parser.add_argument("--depths", type=int, default=64)
    parser.add_argument("--beads", type=int, default=60)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--tolerance", type=float, default=1e-4)
    parser.add_argument("--tau", type=float, default=0.02, help="relative to max |A^H b|")
    parser.add_argument("--threads", type=int, default=1)
    a = parser.parse_args()
    set_threads(a.threads)
    camera = Camera(a.sensor, a.depths)
    counts = expose(camera.render(layers(camera, a.beads)), 3000.0)
    psfs = camera.psfs()
    psfs /= np.sqrt(np.mean(np.sum(psfs.astype(float) ** 2, axis=(1, 2, 3)))).astype(np.float32)
    operator = Convolution(psfs, counts.shape)
    weight = a.tau * max(float(p.max()) for p in operator.adjoint_planes(counts[None]))
    prior = L1(weight) + NonNegativity()
    SparseDouglasRachford(operator, counts[None], prior).step()  # compile
    rules = StoppingRules(iterations=a.iterations, tolerance=a.tolerance)
    print("| planes | iterations | processor s | objective | left out | certificate |")
    print("|---|---|---|---|---|---|")
    for name, drop in (("all", False), ("empty ones left out", True)):
        solver = SparseDouglasRachford(operator, counts[None], prior, tuning=Tuning(drop_empty=drop))
        began = time.process_time()
        shown: list[str] = []

        def note(s, record, shown=shown) -> None:
            if record.iteration in (20, 40, 80, 160, 320):
                shown.append(f"{record.iteration}: {int(s.watch.active.sum())}")

        outcome = solver.run(rules, callback=note)
        seconds = time.process_time() - began
        x = outcome.solution
        misfit = 0.5 * float(np.sum((operator.forward(x)[0] - counts).astype(float) ** 2))
        objective = misfit + weight * float(np.sum(x, dtype=float))
        empty = solver.empty
        print(
            f"| {name} | {len(outcome.history)} ({outcome.stop_reason.name.lower()}) | {seconds:.2f} "
            f"| {objective:.6g} | {len(empty.planes)} of {a.depths} (taking part at {', '.join(shown)}) "
            f"| largest correlation {empty.worst:.3f} tau: {'holds' if empty.certified else 'MISSED'} |",
            flush=True,
        )

    tv = LeanTotalVariation(operator, counts[None], TotalVariation.of_volume(weight) + NonNegativity())
    tv.compile()
    volume = tv.run(rules).solution[0]
    light = volume.sum(axis=(1, 2), dtype=float)
    print(
        f"Total variation of the same weight: {np.count_nonzero(light <= 1e-6 * light.max())} of "
        f"{len(light)} planes empty, the dimmest has {light.min() / light.max():.1%} of the light of the "
        "brightest."
    )


if __name__ == "__main__":
    main()
