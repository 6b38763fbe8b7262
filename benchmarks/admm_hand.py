"""Seconds per iteration of the ADMM on the measured hand, beside a plain implementation in the same run.

Plain: the literal algorithm of A.3 in float64 with complex ``numpy.fft``
(``tests/recon/solvers/literal_admm.py``).
The two take turns, three iterations each, so that other load on the machine falls on both alike; medians.

    python benchmarks/admm_hand.py [--rounds 15] [--threads N]

Without the measured data (``DIFFUSERBENCH_DATA``, else ``../shared/data``) a synthetic stand-in of the same
size is used, and said so; the time of an iteration does not depend on the values.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import sys
import time
from pathlib import Path

import numpy as np
import tifffile

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon.base.threads import get_threads, set_threads
from recon.camera.convolution import Convolution
from recon.priors import NonNegativity, TotalVariation
from recon.reconstruction.part import Part
from recon.reconstruction.problem import Problem
from recon.solvers import Admm, Solver
from tests.recon.solvers.literal_admm import LiteralAdmm

ROOT = Path(os.environ.get("DIFFUSERBENCH_DATA", Path(__file__).parents[1] / "../shared/data"))
DATA = ROOT / "diffusercam_hand"


def load(name: str, binning: int) -> np.ndarray:
    """Read a frame, subtract the dark offset, bin."""
    image = tifffile.imread(DATA / name).astype(np.float32)
    image -= image[5:15, 5:15].mean()
    height, width = (n // binning for n in image.shape)
    return image.reshape(height, binning, width, binning).mean(axis=(1, 3))


def inputs(binning: int) -> tuple[np.ndarray, np.ndarray]:
    """Return PSF and raw frame: measured, or a sparse random PSF and noise of the same size."""
    if DATA.is_dir():
        return load("psf_sample.tif", binning), load("rawdata_hand_sample.tif", binning)
    rng = np.random.default_rng(0)
    shape = (1200 // binning, 1600 // binning)
    return rng.random(shape) ** 8, 1000 + rng.standard_normal(shape)


def processor() -> str:
    """Name of the CPU."""
    cpuinfo = Path("/proc/cpuinfo")
    for line in cpuinfo.read_text().splitlines() if cpuinfo.exists() else ():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()


def seconds(solver: Solver) -> tuple[float, float]:
    """Wall and CPU seconds of one iteration, mean of three."""
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(3):
        solver.step()
        solver.iteration += 1
    return (time.perf_counter() - wall) / 3, (time.process_time() - cpu) / 3


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=get_threads())
    options = parser.parse_args()
    set_threads(options.threads)

    print(f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}, {processor()}, {os.cpu_count()} CPUs,", end=" ")
    print(f"{options.threads} threads, load {os.getloadavg()[0]:.1f}, Python {platform.python_version()}")
    if not DATA.is_dir():
        print(f"The measured hand is not at {DATA}: a synthetic stand-in of the same size is used.")
    print("  sensor      grid         ours (ms)  CPU (ms)   plain (ms)  CPU (ms)   ratio wall  ratio CPU")
    for binning in (4, 2):
        psf, raw = inputs(binning)
        part = Part(Problem.of(raw, psf), slice(0, 1))
        prior = TotalVariation(1.0) + NonNegativity()
        ours = Admm(part.picture_operator, part.data, prior)
        double = Convolution(np.asarray(psf, np.float64)[None], raw.shape, dtype=np.float64)
        plain = LiteralAdmm(double, part.data, prior)
        seconds(ours)
        seconds(plain)
        times = np.array([[seconds(ours), seconds(plain)] for _ in range(options.rounds)]) * 1e3
        (a_wall, a_cpu), (b_wall, b_cpu) = np.median(times, axis=0)
        height, width = part.camera.domain_shape[2:]
        print(
            f"  {raw.shape[0]:4} x {raw.shape[1]:4} {height:5} x {width:4} {a_wall:10.2f} {a_cpu:9.2f} "
            f"{b_wall:12.1f} {b_cpu:9.1f} {b_wall / a_wall:12.1f} {b_cpu / a_cpu:10.1f}"
        )


if __name__ == "__main__":
    main()
