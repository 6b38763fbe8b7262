"""Bead slides: whether two halves of the photographs tell that the PSFs made from them are right.

    python benchmarks/beads_made_up.py --binning 2 3 4
    python benchmarks/beads_made_up.py --beads 10 --binning 4
    python benchmarks/beads_made_up.py --world 'preset = "microscope"' 'aperture_mm = [0.5, 0.5]' --binning 8

Nine slides are photographed unbinned on the simulated bench (wave optics; photon and read noise), binned, and
solved as ``calibrate beads`` solves them. "On the axis" is the cosine similarity of the PSF found there to
the true one, at its best place between pixels, as beads have no zero; "off" is the least of four places at
0.2 of the sensor's sides. "Halves" is what the routine looks at (``recon.blind.made_up``), "misfit" what it
prints, "noise" its share that photon and read noise explain, from how the frames scatter. ``--noise`` adds
more, relative to the brightest pixel.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration_routines.optics.bead_photographs import BeadSlides, photograph_slides
from calibration_routines.optics.beads import window_for
from calibration_routines.procedure import Listener
from calibration_routines.psf.analysis import binned
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.files.errors import BenchError
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.blind import calibrate_from_beads
from recon.errors import InputError
from recon.types import Geometry

BENCH = """
[camera]
driver = "simulated"
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
time_scale = 0
scene = "beads"
beads = {beads}
{world}
"""
OFF = 0.2
"""Of the sensor's sides: where PSFs off the axis are looked at."""


@dataclass(frozen=True)
class Slides:
    """Photographs, and what a point at their depth looks like."""

    images: Float32Array
    """(n, height, width), unbinned."""
    noise_variance: float
    """Of a pixel of theirs, by how frames scatter."""
    asked: BeadSlides
    geometry: Geometry
    truth: Float32Array
    """(5, height, width): on the axis, and at four places."""


def photographed(world: str, beads: int, asked: BeadSlides) -> Slides:
    """Photograph the slides on the simulated bench."""
    config = parse_config(BENCH.format(world=world, beads=beads), None)
    with tempfile.TemporaryDirectory() as folder, open_bench(config) as bench:
        slides = asked.planned(bench)
        taken = photograph_slides(bench, slides, Path(folder), RunControl(), Listener())
        variance = []
        for run in map(Run.open, taken.runs):
            lit, dark = (run.images(label).astype(np.float64) for label in ("scene", "dark"))
            each = lit.var(axis=0, ddof=1) / len(lit) + dark.var(axis=0, ddof=1) / len(dark)
            variance.append(np.minimum(each, np.quantile(each, 0.999)).mean())  # without hot pixels
        (light,) = (part for part in bench.shared.values() if isinstance(part, SimulatedWorld))
        sides = taken.images.shape[1:]
        um = slides.distance_um * bench.geometry.pixel_pitch_um / (1e3 * bench.geometry.diffuser_distance_mm)
        places = [(0.0, 0.0), *((r, c) for r in (-OFF, OFF) for c in (-OFF, OFF))]
        truth = [
            light.psf((-c * sides[1] * um, -r * sides[0] * um, slides.distance_um), (0.0, 1.0, 0.0))
            for r, c in places
        ]
        return Slides(
            taken.images, float(np.mean(variance)), slides, bench.geometry, np.asarray(truth, np.float32)
        )


def likeness(found: Float32Array, truth: Float32Array, binning: int) -> float:
    """Return how alike a PSF is to the unbinned true one, shifted by unbinned pixels and binned."""
    grid = [2 * n for n in found.shape]
    spectrum = np.fft.rfft2(found, grid)
    best = 0.0
    for by in np.ndindex(binning, binning):
        seen = block_mean(np.roll(truth, by, (0, 1)), binning)
        product = np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(seen, grid)), grid).max()
        best = max(best, float(product / np.linalg.norm(found) / np.linalg.norm(seen)))
    return best


def row(slides: Slides, binning: int, noise: float) -> list[str]:
    """Solve, and return a line of the table."""
    images = block_mean(slides.images, binning)
    added = noise * float(images.max())
    images = np.asarray(images + np.random.default_rng(0).normal(0, 1, images.shape) * added, np.float32)
    explained = (slides.noise_variance / binning**2 + added**2) * images.size
    shape = images.shape[1], images.shape[2]
    window = window_for(slides.asked, binned(slides.geometry, binning), shape)
    try:
        found = calibrate_from_beads(images, window, slides.asked.solver)
    except InputError as error:
        return [f"{binning} x {binning}", "", "", "refused", "", "", str(error).split(".", maxsplit=1)[0]]
    places = [np.array((0.0, 0.0)), *(np.array((r, c)) for r in (-OFF, OFF) for c in (-OFF, OFF))]
    alike = []
    for place, truth in zip(places, slides.truth, strict=True):
        nearest = int(np.argmin(np.hypot(*(found.points - place * shape).T)))
        alike.append(likeness(found.psfs[nearest], truth, binning))
    return [
        f"{binning} x {binning}",
        f"{alike[0]:.3f}",
        f"{min(alike[1:]):.2f}",
        f"{found.halves_alike:.3f}",
        f"{found.point_misfits[-1]:.3f}",
        f"{np.sqrt(explained) / np.linalg.norm(images):.3f}",
        ", ".join(str(len(points)) for points in found.beads),
    ]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world", nargs="+", default=['preset = "tiny"'], help="Lines of [simulated].")
    parser.add_argument("--beads", type=int, default=20, help="A slide.")
    parser.add_argument("--images", type=int, default=9)
    parser.add_argument("--binning", type=int, nargs="+", default=[2, 3, 4])
    parser.add_argument("--degree", type=int, default=BeadSlides().degree)
    parser.add_argument("--noise", type=float, default=0.0)
    asked = parser.parse_args()
    slides = BeadSlides(images=asked.images, degree=asked.degree)
    try:
        taken = photographed("\n".join(asked.world), asked.beads, slides)
    except BenchError as error:
        raise SystemExit(str(error)) from None
    heads = ["binned", "on the axis", "off", "halves", "misfit", "noise", "beads found"]
    print(f"{', '.join(asked.world)}, {asked.images} slides of {asked.beads} beads, degree {asked.degree}:")
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    for binning in asked.binning:
        print(f"| {' | '.join(row(taken, binning, asked.noise))} |", flush=True)


if __name__ == "__main__":
    main()
