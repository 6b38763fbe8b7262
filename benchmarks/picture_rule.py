"""Which method for a picture? ``admm`` against ``admm-sensor`` on scenes held out, and what might tell.

    OPENBLAS_NUM_THREADS=1 python benchmarks/picture_rule.py [--size 128]

None of these scenes served to set either method: strokes and discs, leaves that fill the field, single lights
at whole and at continuous places, through random, regular and smooth diffusers, rendered point by point. Both
methods run with default settings to their own end. ``edges per light`` is what a rule could go by: total
variation over the sum of ``admm-sensor``'s picture after 16 iterations (4 for a single pixel on black,
towards 0 for large areas), whatever the exposure and the number of pixels.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.lenslet_scene import Camera, expose
from recon import reconstruct
from recon.arrays import Array
from recon.base.threads import set_threads
from recon.evaluation.chart_judge import score
from recon.evaluation.scene import make_scene

LOOK_AT = 16
"""Iterations of ``admm-sensor`` after which the edges are measured."""

BEYOND, STRAY = {"field": 1.6}, {"background": 0.5}
"""Light from beyond the sensor's field; a smooth background that nobody takes off."""


@dataclass(frozen=True)
class Case:
    """A photograph, its PSF or calibration, the truth."""

    name: str
    measurement: Array
    psf: object
    truth: Array
    erasures: Array | None = None


def lights(size: int, seed: int, count: int, photons: float, *, between: bool, radius: float = 0.0) -> Case:
    """Return single lights, or discs of a radius in pixels, through random lenslets."""
    camera = Camera(size, 1, lenses=60, seed=seed)
    rng = np.random.default_rng(seed)
    y, x = rng.uniform(-0.33, 0.33, (2, count)) * size
    if not between:
        y, x = np.round(y), np.round(x)
    power = rng.uniform(0.4, 1.2, count)
    if radius:
        steps = np.arange(-radius, radius + 0.1, 0.5)
        rows, columns = (v.ravel() for v in np.meshgrid(steps, steps))
        inside = np.hypot(rows, columns) <= radius
        y = (y[:, None] + rows[inside]).ravel()
        x = (x[:, None] + columns[inside]).ravel()
        power = np.repeat(power, inside.sum()) / inside.sum()
    magnification = float(camera.magnifications[0])
    points = np.stack([y, x, np.full(y.size, magnification), power], axis=1)
    photograph = expose(camera.render(points), photons, seed=seed + 5)
    psf = camera.render(np.array([[0, 0, magnification, 1.0]]))
    truth = camera.grid(points, (1, size, size), (size // 2, size // 2))[0]
    name = f"{count} lights" + (f" of radius {radius:g}" if radius else "")
    place = "" if between else ", on pixels"
    return Case(f"{name}{place}, {photons:g} photons", photograph, psf, truth)


def cases(size: int) -> Iterator[Case]:
    """Yield every scene."""
    kinds = [
        {"density": density, "optics": optics, "seed": int(10 * density) + len(optics)}
        for density in (0.2, 1, 3)
        for optics in ("random", "smooth", "regular")
    ]
    kinds += [
        {"seed": 50, **change}
        for change in ({"photons": 200}, {"photons": 4e4}, {"erased": 0.5}, BEYOND, STRAY)
    ]
    for family in ("sparse-picture", "dense-picture"):
        for kind in kinds:
            scene = make_scene(family, size=size, **kind)
            text = ", ".join(f"{k} {v}" for k, v in kind.items() if k != "seed")
            yield Case(f"{family}, {text}", scene.measurement, scene.calibration, scene.truth, scene.erasures)
    yield lights(size, 1, 25, 3000, between=False)
    for seed, count, photons in ((1, 25, 3000), (2, 120, 3000), (3, 600, 3000), (4, 25, 200), (5, 25, 6e4)):
        yield lights(size, seed, count, photons, between=True)
    for radius in (1.5, 3.0, 6.0):
        yield lights(size, 6, 25, 3000, between=True, radius=radius)


def run(case: Case, method: str, iterations: int = 300) -> tuple[int, float, Array]:
    """Return iterations, processor seconds and the picture."""
    began = time.process_time()
    result = reconstruct(
        case.measurement,
        case.psf,
        solver=method,
        model="convolution",
        erasures=case.erasures,
        iterations=iterations,
        tolerance=None if iterations > LOOK_AT else 0.0,
        judged=False,
    )
    return len(result.history), time.process_time() - began, result.image


def edges_per_light(image: Array) -> float:
    """Total variation over the sum."""
    image = image.astype(np.float64)
    tv = sum(float(np.abs(np.diff(image, axis=axis)).sum()) for axis in (0, 1))
    return tv / max(float(image.sum()), 1e-30)


def main() -> None:
    """Run both methods on every scene."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, default=128)
    size = parser.parse_args().size
    set_threads(1)
    print("| scene | edges per light | admm: it., s, dB | admm-sensor: it., s, dB | difference, dB |")
    print("|---|---|---|---|---|")
    for method in ("admm", "admm-sensor"):  # compiles
        run(lights(32, 1, 5, 1000, between=True), method, 3)
    for case in cases(size):
        edges = edges_per_light(run(case, "admm-sensor", LOOK_AT)[2])
        found = [run(case, method) for method in ("admm", "admm-sensor")]
        quality = [score(image, case.truth, volume=False).psnr_db for *_, image in found]
        cells = [f"{n}, {s:.2f}, {db:.2f}" for (n, s, _), db in zip(found, quality, strict=True)]
        print(
            f"| {case.name} | {edges:.2f} | {' | '.join(cells)} | {quality[1] - quality[0]:+.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
