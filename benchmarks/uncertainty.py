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

from recon import InputError, Measurement, Options, Problem, choose, reconstruct, solve
from recon.base.blocks import block_mean
from recon.blind import psf_from_pictures
from recon.evaluation.content import PICTURES
from recon.evaluation.lenslets import LensletCamera
from recon.evaluation.measured_sets import measured_pairs
from recon.evaluation.scene import TestScene, make_scene
from recon.reconstruction.part import Part, parts_of
from recon.reconstruction.point_errors import points_of, points_problem
from recon.reconstruction.uncertainty import REPEATS, Replicas, smoothed

OPTICS = ("random", "smooth", "hand", "usaf")
PHOTONS = (500.0, 5000.0)
LIT = 0.02
Array = np.ndarray[Any, Any]


def fall_off(scene: TestScene) -> Array:
    """Return how much of the light reaches the sensor from the place of each pixel, relative to the axis."""
    camera = scene.camera
    if not isinstance(camera, LensletCamera):
        return np.ones(scene.spec.shape)
    from scipy.interpolate import RectBivariateSpline

    (height, width), z = camera.shape, float(scene.z_um[0])
    wide = replace(camera, shape=(3 * height, 3 * width))
    rows, columns = np.linspace(0, height - 1, 7), np.linspace(0, width - 1, 7)
    to_scene = -camera.pitch_um * z / camera.distance_um

    def seen(row: float, column: float) -> float:
        place = [(column - width // 2) * to_scene, (row - height // 2) * to_scene, z, 1.0]
        return float(wide.light([place]).sum())

    grid = np.array([[seen(row, column) for column in columns] for row in rows])
    relative = RectBivariateSpline(rows, columns, grid / seen(height // 2, width // 2))
    return np.asarray(relative(np.arange(height), np.arange(width)))


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
    truth, found = scene.truth * fall_off(scene), result.image
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


def beads(optics: str, photons: float, seeds: list[int], size: int) -> str:
    """Return how error bars of points fare on beads in one plane, in words."""
    scores, deviations, found, made_up, true_count = [], [], 0, 0, 0
    for seed in seeds:
        scene = make_scene(
            "beads",
            optics=optics,  # type: ignore[arg-type]
            photons=photons,
            seed=seed,
            size=round(1.5 * size),
            depths=1,
            layers=(0.5, 0.5),
            density=0.5,
        )
        measurement = Measurement(scene.measurement, scene.noise)
        problem = choose(Problem.of(measurement, scene.calibration, Options(prior="l1", judged=False)))
        own = points_problem(problem)
        if own is None:
            continue
        result = solve(problem)
        points = points_of(result, own)
        to_pixels = -scene.camera.distance_um / scene.points[:, 2] / scene.camera.pitch_um
        places = scene.points[:, 1::-1] * to_pixels[:, None] + result.grid.centre
        rows, columns = np.clip(np.round(places).astype(int), 0, round(1.5 * size) - 1).T
        unit = float(scene.truth.sum()) / float(scene.points[:, 3].sum())
        light = unit * scene.points[:, 3] * fall_off(scene)[rows, columns]
        distance = np.linalg.norm(points.places[:, None] - places, axis=2)
        near = distance.argmin(axis=1)
        hit = distance.min(axis=1) < 1.5
        error = np.column_stack([points.places - places[near], points.light - light[near]])
        scores.append((np.abs(error) / points.deviations)[hit])
        deviations.append(np.column_stack([points.deviations[:, :2], points.deviations[:, 2] / points.light]))
        found, made_up = found + len(set(near[hit])), made_up + int(np.count_nonzero(~hit))
        true_count += len(places)
    if not scores:
        return f"| {optics} | {photons:g} | no points: more than one PSF |"
    held = (np.concatenate(scores) <= 1.96).mean(axis=0)
    median = np.median(np.concatenate(deviations), axis=0)
    return (
        f"| {optics} | {photons:g} | {found} of {true_count}, {made_up} | {(held[0] + held[1]) / 2:.0%} "
        f"({median[:2].mean():.3f} px) | {held[2]:.0%} ({median[2]:.1%}) |"
    )


def measured_pairs_held(binning: int) -> Iterator[str]:
    """Yield what intervals of measured photographs hold of their truths, through a lens, as a table's rows.

    Each through the PSF that the other six pairs give; the truth at the best shift by whole pixels, gain and
    offset a channel.
    """
    names, photographs, pictures = measured_pairs()
    data, truths = (block_mean(stack, binning, about_axis=True) for stack in (photographs, pictures))
    yield "| pair | misfit | held | width | trusted |"
    yield "|---|---|---|---|---|"
    for number, name in enumerate(names):
        others = [k for k in range(len(names)) if k != number]
        psf = psf_from_pictures(data[others], truths[others]).psf
        options = Options(judged=False, uncertainty=True)
        result = reconstruct(np.moveaxis(data[number], 0, -1), np.moveaxis(psf, 0, -1), options)
        found = result.uncertainty
        assert found is not None
        held, size, error = 0.0, 0.0, 0.0
        for channel, truth in enumerate(truths[number]):
            picture = result.image[..., channel]
            fits = [
                _fitted(np.roll(truth, (down, across), (0, 1)), picture)
                for down in range(-3, 4)
                for across in range(-3, 4)
            ]
            off = picture - min(fits, key=lambda fit: float(np.sum((fit - picture) ** 2)))
            deviation = found.deviation[0, ..., channel]
            held += float(np.mean(np.abs(off) <= 1.96 * deviation)) / len(truths[number])
            size, error = size + float(np.sum(deviation**2)), error + float(np.sum(off**2))
        width, trusted = np.sqrt(size / error), "yes" if found.trusted else "no"
        yield f"| {name} | {found.misfit:.2f} | {held:.3f} | {width:.2f} | {trusted} |"


def _fitted(truth: Array, picture: Array) -> Array:
    """Return a truth with the gain and offset that bring it nearest to a picture."""
    columns = np.column_stack([truth.ravel(), np.ones(truth.size)])
    return np.asarray(
        (columns @ np.linalg.lstsq(columns, picture.ravel(), rcond=None)[0]).reshape(truth.shape)
    )


def table(found: list[dict[str, Any]]) -> Iterator[str]:
    """Yield lines of Markdown: what each way holds, a row for each optics and sort of scene."""
    yield "| optics | scene | error | misfit | held | all | width | held by `noise` | by `posterior` |"
    yield "|---|---|---|---|---|---|---|---|---|"
    ways: dict[tuple[str, str], dict[str, list[dict[str, Any]]]] = {}
    for row in found:
        ways.setdefault((row["optics"], row["family"]), {}).setdefault(row["way"], []).append(row)
    for (optics, family), by_way in ways.items():

        def shown(name: str, way: str = "own", digits: int = 2, rows: Any = by_way) -> str:
            return ", ".join(f"{float(row[name]):.{digits}f}" for row in rows[way])

        yield (
            f"| {optics} | {family} | {shown('error')} | {shown('misfit')} | {shown('held', digits=3)} | "
            f"{shown('all', digits=3)} | {shown('width')} | {shown('held', 'noise')} | "
            f"{shown('held', 'posterior')} |"
        )


def draw(out: Path, size: int, seed: int) -> None:
    """Draw truth, picture, its error and its deviation for four scenes."""
    from matplotlib.figure import Figure

    shown = (("random", "dense-picture"), ("hand", "texture"), ("usaf", "sparse-picture"), ("smooth", "text"))
    figure = Figure(figsize=(9, 9.4), layout="constrained")
    axes = figure.subplots(len(shown), 4)
    for row, (optics, family) in zip(axes, shown, strict=True):
        scene = make_scene(family, optics=optics, seed=seed, size=size, photons=500)  # type: ignore[arg-type]
        options = Options(judged=False, uncertainty=True)
        result = reconstruct(Measurement(scene.measurement, scene.noise), scene.calibration, options)
        assert result.uncertainty is not None
        truth, white = scene.truth * fall_off(scene), float(result.image.max())
        error = np.abs(result.image - truth)
        images = (truth, result.image, error, result.uncertainty.deviation[0])
        for axis, image, top in zip(row, images, (white, white, white / 2, white / 2), strict=True):
            axis.imshow(image, cmap="gray", vmin=0, vmax=top)
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(f"{family}, {optics}")
    for axis, words in zip(
        axes[0], ("truth", "picture", "error (white: half)", "deviation (the same)"), strict=True
    ):
        axis.set_title(words)
    figure.savefig(out, dpi=80)


def main() -> None:
    """Print the tables; keep every row in a CSV where one is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--prior", default="tv")
    parser.add_argument("--optics", nargs="+", default=OPTICS)
    parser.add_argument("--families", nargs="+", default=list(PICTURES))
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--points", action="store_true", help="error bars of points only")
    parser.add_argument("--pairs", type=int, metavar="BIN", help="measured pairs only, binned so much")
    parser.add_argument("--figure", type=Path, help="draw four scenes there, no tables")
    asked = parser.parse_args()
    if asked.figure:
        draw(asked.figure, asked.size, asked.seeds[0])
        return
    if asked.pairs:
        for line in measured_pairs_held(asked.pairs):
            print(line, flush=True)
        return
    if asked.points:
        print("| optics | photons | found, made up | place held (deviation) | light held (deviation) |")
        print("|---|---|---|---|---|")
        for optics in asked.optics:
            for photons in (40.0, 300.0, 3000.0):
                print(beads(optics, photons, asked.seeds, asked.size), flush=True)
        return
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
    print("\n".join(table(found)))
    if asked.csv is not None and found:
        with asked.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(found[0]))
            writer.writeheader()
            writer.writerows(found)


if __name__ == "__main__":
    main()
