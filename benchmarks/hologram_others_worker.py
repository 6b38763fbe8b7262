"""The other side of ``hologram_others.py``: runs other packages' optimisers in an environment that has them.

Started by the benchmark with that environment's interpreter; nothing of this project is imported here.
Reads ``wanted.npy`` (intensities over the field, mean 1, the axis in the middle) from the folder named, and
writes for every method and number of iterations ``METHOD-N.npy``, the SLM's phases, and ``times.json``, the
processor seconds of each.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import odak.learn.wave.classical as odak
import torch
from slmsuite.holography.algorithms import Hologram


def slmsuite(
    method: str, wanted: np.ndarray, start: np.ndarray, iterations: int, **flags: Any
) -> Callable[[], Any]:
    """Return what runs slmsuite's optimiser, prepared."""
    hologram = Hologram(np.sqrt(wanted).astype(np.float32), phase=start.copy(), slm_shape=wanted.shape)

    def run() -> Any:
        hologram.optimize(method=method, maxiter=iterations, verbose=False, **flags)
        return hologram.get_phase()

    return run


def by_odak(wanted: np.ndarray, iterations: int, rate: float) -> Callable[[], Any]:
    """Return what runs odak's gradient descent (Adam) for a far field on the SLM's own grid."""
    n = len(wanted)
    pitch_m, wavelength_m = 8e-6, 660e-9
    # At this distance the mean intensity is 1, as wanted. odak's transform has the first pixel as its axis.
    distance_m = pitch_m**2 * n / wavelength_m
    target = torch.from_numpy(wanted.astype(np.float32))

    def run() -> Any:
        torch.manual_seed(0)
        found, _ = odak.stochastic_gradient_descent(
            target, wavelength_m, distance_m, pitch_m, "Fraunhofer", iterations, learning_rate=rate
        )
        return np.fft.ifftshift(np.angle(found.detach().numpy()))

    return run


def unpadded(propagate: Callable[..., Any]) -> Callable[..., Any]:
    """Return odak's propagation without its padding, so that the far field has the SLM's own grid."""

    def propagated(*given: Any, **named: Any) -> Any:
        return propagate(*given, **{**named, "zero_padding": [False, False, False]})

    return propagated


def main() -> None:
    """Run every method for every number of iterations."""
    folder, counts = Path(sys.argv[1]), [int(n) for n in sys.argv[2:]]
    torch.set_num_threads(1)
    odak.propagate_beam = unpadded(odak.propagate_beam)
    wanted = np.load(folder / "wanted.npy")
    phases = np.random.default_rng(1).uniform(-np.pi, np.pi, wanted.shape).astype(np.float32)
    adam = {"optimizer": "Adam", "optimizer_kwargs": {"lr": 0.1}}
    methods: dict[str, Callable[[int], Callable[[], Any]]] = {
        "slmsuite GS": partial(slmsuite, "GS", wanted, phases),
        "slmsuite WGS-Leonardo": partial(slmsuite, "WGS-Leonardo", wanted, phases),
        "slmsuite WGS-Kim": partial(slmsuite, "WGS-Kim", wanted, phases),
        "slmsuite CG": lambda n: slmsuite("CG", wanted, phases, n, **adam),
        **{f"odak SGD {rate:g}": lambda n, rate=rate: by_odak(wanted, n, rate) for rate in (0.03, 0.1, 0.3)},
    }
    times: dict[str, Any] = {"versions": {name: version(name) for name in ("slmsuite", "odak", "torch")}}
    for name, prepared in methods.items():
        prepared(2)()  # what is loaded late
        for count in counts:
            run = prepared(count)
            began = time.process_time()
            found = run()
            times[f"{name}-{count}"] = time.process_time() - began
            np.save(folder / f"{name}-{count}.npy", np.asarray(found, np.float32))
    (folder / "times.json").write_text(json.dumps(times))


if __name__ == "__main__":
    main()
