"""The other side of ``against_lensless.py``: runs lensless' ADMM in an environment that has it.

Started by the benchmark with that environment's interpreter; nothing of this project is imported here, and
nothing of lensless there. Takes one JSON object a line on standard input, answers each with one:

``{"do": "make", "name", "folder", "mu1", "mu2", "mu3", "tau", "workers"}``: a solver for ``psf.npy``
(1, height, width, channels) and ``data.npy`` (height, width, channels), both float32. Answers ``seconds``.
``{"do": "run", "name", "iterations"}``: goes on from where it is. Answers ``wall`` and ``cpu``, seconds.
``{"do": "save", "name", "file"}``: writes the object on the padded grid, and its non-negative split variable,
as an array (2, height, width, channels).
``{"do": "light", "name", "file"}``: writes what the object casts on the sensor, (height, width, channels).
``{"do": "forget", "name"}``: frees it.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft
from lensless import ADMM


def make(folder: Path, mu1: float, mu2: float, mu3: float, tau: float) -> tuple[Any, float]:
    """Return a solver with its data set, and the seconds that took."""
    psf, data = np.load(folder / "psf.npy"), np.load(folder / "data.npy")
    began = time.perf_counter()
    solver = ADMM(psf, dtype="float32", mu1=mu1, mu2=mu2, mu3=mu3, tau=tau)
    solver.set_data(data)
    return solver, time.perf_counter() - began


def advance(solver: Any, iterations: int) -> dict[str, float]:
    """Iterate without starting over; return wall and CPU seconds of the iterations alone."""
    wall, cpu = time.perf_counter(), time.process_time()
    for iteration in range(iterations):
        solver._update(iteration)  # what apply() calls, less its cropping and plotting
    return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def answer(solvers: dict[str, tuple[Any, int]], do: str, name: str, **given: Any) -> dict[str, float]:
    """Do what is asked."""
    if do == "make":
        workers = given.pop("workers")
        solver, seconds = make(Path(given.pop("folder")), **given)
        solvers[name] = (solver, workers)
        return {"seconds": seconds}
    if do == "forget":
        del solvers[name]
        return {}
    solver, workers = solvers[name]
    if do == "run":
        with scipy.fft.set_workers(workers):
            return advance(solver, given["iterations"])
    if do == "save":
        np.save(given["file"], np.stack([solver._image_est[0, 0], solver._W[0, 0]]))
    elif do == "light":
        light = solver._convolver._crop(solver._forward_out)
        np.save(given["file"], light.reshape(light.shape[-3:]))
    else:
        raise ValueError(f"Unknown request {do!r}.")
    return {}


def main() -> None:
    """Answer requests until standard input ends."""
    answers = sys.stdout
    sys.stdout = sys.stderr  # should the library print, it must not be taken for an answer
    solvers: dict[str, tuple[Any, int]] = {}
    print(json.dumps({"lensless": version("lensless"), "numpy": np.__version__}), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(answer(solvers, **json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main()
