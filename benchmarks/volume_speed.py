"""Seconds per iteration and peak memory of the volume solvers, 512 x 512 x 128 voxels unless told otherwise.

    python benchmarks/volume_speed.py [--sensor 256] [--depths 128] [--iterations 6] [--threads 2] [--rounds
    2]

Each method runs in a process of its own (its peak memory is the process's), in rounds, one after the other,
so that a busy machine is unjust to none. The best of the rounds' medians counts. ``naive`` is the
dissertation's algorithm as it stands in NumPy (``tests/recon/solvers/literal_volume.py``), ``fused``
the same written well (``benchmarks/literal_fused.py``), both with three-dimensional FFTs.

Processor seconds are what a busy machine leaves comparable; on two quiet cores an iteration takes a little
more than half of them. Beside them the bound: two transforms a plane that lies in the core's cache, and the
volumes that pass through memory at the rate of ``a += b``, both measured in the same run.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

METHODS = ("lean TV", "l1 (Douglas-Rachford)", "literal TV, fused", "literal l1, fused", "literal TV, naive")


def problem(sensor: int, depths: int):
    """Return an operator with random microlens-like PSFs that grow with nearness, and a measurement."""
    import numpy as np

    from recon.camera.convolution import Convolution

    operator = Convolution(lenslet_psfs(sensor, depths), (sensor, sensor))
    data = np.random.default_rng(0).poisson(100, (1, sensor, sensor)).astype(np.float32)
    return operator, data


def lenslet_psfs(sensor: int, depths: int):
    """Return PSFs of random lenslets, (depths, 1, sensor, sensor)."""
    import numpy as np

    rng = np.random.default_rng(0)
    lenses = rng.uniform(-0.36, 0.36, (400, 2)) * sensor
    psfs = np.zeros((depths, 1, sensor, sensor), np.float32)
    for z in range(depths):
        rows, columns = np.round(lenses * (1 + 0.3 * z / depths) + sensor / 2).astype(int).T
        np.add.at(psfs[z, 0], (rows % sensor, columns % sensor), 0.05)
    return psfs


def solver(method: str, operator, data):
    """Return a solver by its name in METHODS."""
    from recon.priors import L1, NonNegativity, TotalVariation
    from recon.solvers.douglas_rachford import SparseDouglasRachford
    from recon.solvers.tv_admm_volume import LeanTotalVariation
    from tests.recon.solvers.literal_volume import LiteralAdmm

    if method == "lean TV":
        return LeanTotalVariation(operator, data, TotalVariation.of_volume(10.0) + NonNegativity())
    if method == "l1 (Douglas-Rachford)":
        return SparseDouglasRachford(operator, data, L1(10.0) + NonNegativity())
    if method == "literal TV, naive":
        return LiteralAdmm(operator, data, 10.0, penalties=(1.0, 1.0, 1.0))
    from literal_fused import FusedLiteralAdmm

    return FusedLiteralAdmm(operator, data, 10.0, tv="TV" in method, penalties=(1.0, 1.0, 1.0))


TRAFFIC = {"lean TV": 14, "l1 (Douglas-Rachford)": 4}
"""Volumes of real numbers that an iteration reads and writes: X four times, g twice, four states twice; z
twice, H twice."""


def limits(sensor: int, depths: int) -> dict[str, float]:
    """Return processor seconds that an iteration's transforms take, and that each volume's way does."""
    import numpy as np

    from recon.base import fft
    from recon.base.threads import set_threads

    set_threads(1)
    plane = np.ones((2 * sensor, 2 * sensor), np.float32)
    spectrum = fft.rfft(plane)
    many = np.ones((2, 50_000_000), np.float32)

    def best(job: Callable[[], object]) -> float:
        times = []
        for _ in range(10):
            began = time.process_time()
            job()
            times.append(time.process_time() - began)
        return min(times)

    there = best(lambda: fft.rfft(plane, out=spectrum))
    back = best(lambda: fft.irfft(spectrum, plane.shape[1], out=plane))
    rate = 3 * many[0].nbytes / best(lambda: np.add(many[0], many[1], out=many[0]))
    return {"transforms": depths * (there + back), "volume": depths * plane.nbytes / rate}


def measure(method: str, sensor: int, depths: int, iterations: int, threads: int) -> dict[str, float]:
    """Run one method in this process."""
    from recon.base.threads import set_threads

    set_threads(threads)
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    solver(method, *problem(16, 4)).step()  # compile
    began = time.perf_counter()
    s = solver(method, *problem(sensor, depths))
    prepared = time.perf_counter() - began
    wall, cpu = [], []
    for i in range(iterations + 1):
        before = time.process_time()
        began = time.perf_counter()
        s.step()
        if i:  # the first touches fresh memory
            wall.append(time.perf_counter() - began)
            cpu.append(time.process_time() - before)
        if hasattr(s, "iteration"):
            s.iteration += 1
    wall.sort()
    cpu.sort()
    return {
        "seconds": wall[len(wall) // 2],
        "best_seconds": wall[0],
        "cpu_seconds": cpu[len(cpu) // 2],
        "setup_seconds": prepared,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def main() -> None:
    """Measure all methods and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sensor", type=int, default=256)
    parser.add_argument("--depths", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=6)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.one:
        print(json.dumps(measure(a.one, a.sensor, a.depths, a.iterations, a.threads)))
        return
    results: dict[str, dict[str, float]] = {}
    for _ in range(a.rounds):
        for method in a.methods:
            command = [sys.executable, __file__, "--one", method]
            for name in ("sensor", "depths", "iterations", "threads"):
                command += [f"--{name}", str(getattr(a, name))]
            answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            found = json.loads(answer.splitlines()[-1])
            old = results.setdefault(method, found)
            results[method] = {k: min(v, old[k]) for k, v in found.items()}
    grid = 2 * a.sensor
    print(f"{grid} x {grid} x {a.depths} voxels (sensor {a.sensor}), {a.threads} threads")
    bound = limits(a.sensor, a.depths)
    transforms, way = bound["transforms"], bound["volume"]
    print(f"planes' transforms in cache {transforms:.3f} CPU s, each volume's way {way:.4f} CPU s")
    print("| method | s per iteration (median) | best | CPU s | bound, CPU s | setup s | peak GiB |")
    print("|---|---|---|---|---|---|---|")
    for method, r in results.items():
        ways = TRAFFIC.get(method)
        least = f"{transforms + ways * way:.2f}" if ways else ""
        print(
            f"| {method} | {r['seconds']:.2f} | {r['best_seconds']:.2f} | {r['cpu_seconds']:.3f} | {least} "
            f"| {r['setup_seconds']:.1f} | {r['peak_gib']:.2f} |"
        )


if __name__ == "__main__":
    main()
