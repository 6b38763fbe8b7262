"""Do 95 % intervals hold the truth? Standard deviations of pictures against scenes of known truth.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/uncertainty.py [--size 64] [--seeds 101 102]

Scenes are rendered point by point, through lenslets in closed form and through the measured PSFs of the hand
and the USAF set (left out where those are not there), never by the model that reconstructs them. Beside the
uncertainty that ``reconstruct(..., uncertainty=True)`` gives stand others, of the same picture:

* ``noise``: the picture itself photographed and reconstructed again (parametric bootstrap), bias included;
* ``posterior``: standard deviation of a Gaussian with the picture's own differences as scales, which is what
  total variation as a prior comes to about its solution (samples by perturbation and conjugate gradients).

``held`` is the share of pixels whose truth lies in its 95 % interval, of those where truth or picture exceeds
2 % of the brightest (black around strokes is held by any interval), ``all`` of all; ``width`` the root mean
square of the deviations over that of the errors: 1 is right.

The truth of lenslet scenes is what the one PSF on the axis can tell: less light from off the axis (cosines
and the pixels' response), which is for a calibration of several places to know.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon import InputError, Measurement, Options, Problem, choose, solve
from recon.evaluation.content import PICTURES
from recon.evaluation.lenslets import LensletCamera
from recon.evaluation.scene import TestScene, make_scene
from recon.reconstruction.part import Part, parts_of
from recon.reconstruction.uncertainty import REPEATS, Replicas, smoothed

OPTICS = ("random", "smooth", "hand", "usaf")
PHOTONS = (500.0, 5000.0)
LIT = 0.02
Array = np.ndarray[Any, Any]


def apparent(scene: TestScene) -> Array:
    """Return the truth as one PSF on the axis has it: as much as reaches the sensor from its place."""
    camera = scene.camera
    if not isinstance(camera, LensletCamera):
        return scene.truth
    from scipy.interpolate import RectBivariateSpline

    (height, width), z = camera.shape, float(scene.z_um[0])
    wide = replace(camera, shape=(3 * height, 3 * width))
    rows, columns = np.linspace(0, height - 1, 7), np.linspace(0, width - 1, 7)
    to_scene = -camera.pitch_um * z / camera.distance_um

    def seen(row: float, column: float) -> float:
        place = [(column - width // 2) * to_scene, (row - height // 2) * to_scene, z, 1.0]
        return float(wide.light([place]).sum())

    grid = np.array([[seen(row, column) for column in columns] for row in rows])
    fall_off = RectBivariateSpline(rows, columns, grid / seen(height // 2, width // 2))
    return np.asarray(scene.truth * fall_off(np.arange(height), np.arange(width)))


def posterior(problem: Problem, object_: Array, part: Part, rng: np.random.Generator) -> Array:
    """Return standard deviations of the Gaussian about total variation's solution, in scaled units.

    Its precision is ``A^H A + D^H diag(weight / |D x|) D``, with differences that the noise leaves at least.
    """
    operator = part.operator
    least = 1.0 / np.sqrt(float(np.vdot(operator.adjoint(part.solved_data), object_)) / object_.size + 1)
    scales = [part.weight / np.maximum(np.abs(d), least) for d in _differences(object_)]

    def precision(x: Array) -> Array:
        weighed = [s * d for s, d in zip(scales, _differences(x), strict=True)]
        return operator.adjoint(operator.forward(x)) + _back(*weighed)

    total = np.zeros(object_.shape)
    for _ in range(2 * REPEATS):
        draws = [np.sqrt(s) * rng.standard_normal(s.shape).astype(np.float32) for s in scales]
        noise = rng.standard_normal(part.data.shape).astype(np.float32)
        total += _conjugate_gradients(precision, operator.adjoint(noise) + _back(*draws)) ** 2
    rows, columns = problem.window
    return np.sqrt(smoothed(total[0, :, rows, columns] / (2 * REPEATS)))


def _differences(x: Array) -> list[Array]:
    down, across = np.zeros_like(x), np.zeros_like(x)
    down[..., :-1, :], across[..., :-1] = np.diff(x, axis=-2), np.diff(x, axis=-1)
    return [down, across]


def _back(down: Array, across: Array) -> Array:
    x = -down - across
    x[..., 1:, :] += down[..., :-1, :]
    x[..., 1:] += across[..., :-1]
    return x


def _conjugate_gradients(precision: Any, right: Array, steps: int = 150) -> Array:
    x = np.zeros_like(right)
    rest, way = right.copy(), right.copy()
    size = begun = float(np.vdot(rest, rest))
    for _ in range(steps):
        if size < 1e-4 * begun:
            break
        image = precision(way)
        length = size / float(np.vdot(way, image))
        x, rest = x + length * way, rest - length * image
        size, before = float(np.vdot(rest, rest)), size
        way = rest + size / before * way
    return x


def rows_of(
    family: str, optics: str, photons: float, seed: int, options: Options, size: int
) -> Iterator[dict[str, Any]]:
    """Yield what each way holds of one scene."""
    scene = make_scene(family, optics=optics, photons=photons, seed=seed, size=size)  # type: ignore[arg-type]
    problem = choose(Problem.of(Measurement(scene.measurement, scene.noise), scene.calibration, options))
    result = solve(problem)
    truth, found = apparent(scene), result.image
    solved, small = result.basis or (problem, result)
    replicas = Replicas(solved, small)
    lift = solved.reduction.volume if solved.reduction is not None else np.asarray
    part = Part(solved, parts_of(solved)[0])
    part.weigh(options.tau)
    shape = part.camera.domain_shape
    object_ = solved.start(small, part.channels, (shape[2], shape[3]))

    def repeated(times: int) -> Array:
        errors = [replicas.squared_error(seed, times) for seed in range(REPEATS)]
        return np.asarray(np.mean(errors, axis=0))

    own = repeated(replicas.shrink)
    scaled = posterior(solved, object_, part, np.random.default_rng(seed))
    ways = {
        "noise": lift(np.sqrt(smoothed(repeated(1))).astype(np.float32)),
        "posterior": lift((scaled * float(solved.image_scale.ravel()[0])).astype(np.float32)),
        "own": lift(replicas.deviation(own)),
    }
    misfit = max(r / small.noise_norm for r in small.residuals)
    lit = np.maximum(truth / truth.max(), found / found.max()) > LIT
    error = found - truth
    for way, deviation in ways.items():
        held = np.abs(error) <= 1.96 * deviation[0]
        yield {
            "family": family,
            "optics": optics,
            "photons": photons,
            "seed": seed,
            "misfit": misfit,
            "error": float(np.linalg.norm(error) / np.linalg.norm(truth)),
            "way": way,
            "held": float(held[lit].mean()),
            "all": float(held.mean()),
            "width": float(np.sqrt(np.mean(deviation**2) / np.mean(error**2))),
        }


def main() -> None:
    """Print the tables; keep every row in a CSV where one is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--prior", default="tv")
    parser.add_argument("--optics", nargs="+", default=OPTICS)
    parser.add_argument("--families", nargs="+", default=list(PICTURES))
    parser.add_argument("--csv", type=Path)
    asked = parser.parse_args()
    found: list[dict[str, Any]] = []
    for optics in asked.optics:
        for family in asked.families:
            for photons in PHOTONS:
                for seed in asked.seeds:
                    try:
                        more = list(
                            rows_of(family, optics, photons, seed, Options(prior=asked.prior), asked.size)
                        )
                    except InputError as error:
                        print(f"{optics} {family}: {error}")
                        continue
                    found += more
                    said = ", ".join(f"{r['way']} {r['held']:.3f}" for r in more)
                    print(
                        f"{optics} {family} {photons:g} {seed}: misfit {more[0]['misfit']:.2f}; {said}",
                        flush=True,
                    )
    if asked.csv is not None and found:
        with asked.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(found[0]))
            writer.writeheader()
            writer.writerows(found)


if __name__ == "__main__":
    main()
