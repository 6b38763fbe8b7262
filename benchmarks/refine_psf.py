"""PSFs refined by the photograph: planted errors and how they are recovered.

    python benchmarks/refine_psf.py [--sets simulated stack hand usaf] [--size 128] [--seeds 2]

Plants 2 % of scale, 2 degrees, a shift of 5 pixels, alone and together, and prints what is found and what the
picture is worth: of simulated scenes, whose diffuser moves between calibration and photograph and is rendered
lenslet by lenslet, against the truth; of the measured hand and USAF target (``DIFFUSERBENCH_DATA``, else
``../shared/data``), where the right PSF is not known, against what is found of the PSF as it came; of a
picture asked for at each depth of a stack of six, of which none is its own (1 degree planted). PSNR is
after the best shift, as a moved PSF moves the picture, and the best gain.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Literal

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon import Calibration, reconstruct
from recon.base.blocks import block_mean
from recon.base.threads import set_threads
from recon.camera.registration import aligned, register
from recon.camera.transformed import Transformation, transformed
from recon.evaluation.measured_sets import measured_set
from recon.evaluation.scene import make_scene
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.psf_refinement import Refinement, refine_psf

PLANTED = (
    Transformation(),
    Transformation(scale=1.02),
    Transformation(rotation_deg=2.0),
    Transformation(5.0, 5.0),
    Transformation(5.0, 5.0, 1.02, 2.0),
)
FAMILIES = ("text", "sparse-picture", "dense-picture", "texture")
EDGE = 12
"""Pixels at the picture's border that are not compared: a shift brings others there."""


def psnr(picture: np.ndarray, truth: np.ndarray) -> float:
    """Return the PSNR (dB) of a picture after the best shift and gain, without its border."""
    back = aligned(picture, register(picture, truth))
    a, b = (image[EDGE:-EDGE, EDGE:-EDGE].astype(np.float64) for image in (back, truth))
    error = a * (np.vdot(a, b) / max(np.vdot(a, a), 1e-30)) - b
    return float(10 * np.log10(b.max() ** 2 / np.mean(error**2)))


def refined(image: np.ndarray, calibration: Calibration) -> tuple[Refinement, float]:
    """Return what is found, and its processor seconds."""
    began = time.process_time()
    return refine_psf(Problem.of(image, calibration)), time.process_time() - began


def told(name: str, planted: Transformation, found: Refinement, seconds: float, rest: str) -> None:
    """Print one row."""
    how = found.transformation
    error = "-" if found.scale_error is None else f"{100 * found.scale_error:.2f}"
    print(
        f"| {name} | {planted} | {100 * (how.scale - 1):+.2f} +- {error} | "
        f"{how.rotation_deg:+.2f} +- {found.rotation_error_deg:.2f} | {found.given:.2f}, {found.found:.2f} | "
        f"{'yes' if found.helps else 'no'} | {rest} | {seconds:.0f} |",
        flush=True,
    )


def simulated(family: str, size: int, seed: int) -> None:
    """Move the diffuser after the calibration of a simulated scene, print what is found and gained."""
    right = None
    for planted in PLANTED:
        scene = make_scene(
            family,
            size=size,
            seed=seed,
            drift_px=planted.rows,
            drift_scale=planted.scale - 1,
            drift_deg=planted.rotation_deg,
        )
        found, seconds = refined(scene.measurement, scene.calibration)
        calibrations = (scene.calibration, found.of(scene.calibration))
        given, mended = (psnr(reconstruct(scene.measurement, c).image, scene.truth) for c in calibrations)
        right = given if right is None else right
        told(f"{family}, seed {seed}", planted, found, seconds, f"{given:.1f}, {mended:.1f}, {right:.1f}")


def in_a_stack(family: str, optics: Literal["random", "smooth"], size: int, seed: int) -> None:
    """Ask for a picture at every depth that was calibrated, print which depth is found and what is gained."""
    scene = make_scene(family, size=size, seed=seed, depths=6, optics=optics, drift_deg=1.0)
    true_um = 2 / (1 / scene.z_um[0] + 1 / scene.z_um[-1])
    truth = scene.truth.sum(axis=0) if scene.truth.ndim == 3 else scene.truth
    for z_um in scene.z_um:
        options = ReconstructionOptions(z_um=float(z_um), model="convolution", iterations=60, judged=False)
        pictures = [
            reconstruct(scene.measurement, scene.calibration, options, refine_psf=fit)
            for fit in (False, True)
        ]
        found = pictures[1].refinement
        print(
            f"| {family}, {optics}, seed {seed} | {z_um / 1e3:.2f} | {true_um / 1e3:.2f} | {found} | "
            f"{psnr(pictures[0].image, truth):.1f}, {psnr(pictures[1].image, truth):.1f} |",
            flush=True,
        )


def measured(name: str, binning: int) -> None:
    """Transform the PSFs of a measured set, print what is found, and pictures beside the first's."""
    psfs, image = (block_mean(a, binning) for a in measured_set(name))
    first = None
    for planted in PLANTED:
        # Planted on the binned pixels: 5 pixels are 5 * binning of the camera's.
        wrong = Calibration(transformed(psfs, planted)[:, None], np.full((len(psfs), 3), np.nan))
        found, seconds = refined(image, wrong)
        rest = "-"
        if len(psfs) == 1:
            given, mended = (reconstruct(image, c).image for c in (wrong, found.of(wrong)))
            first = mended if first is None else first
            rest = f"{psnr(given, first):.1f}, {psnr(mended, first):.1f}, -"
        told(f"{name}, bin {binning}", planted, found, seconds, rest)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=["simulated", "stack", "hand", "usaf"])
    parser.add_argument("--families", nargs="+", default=list(FAMILIES))
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--threads", type=int, default=1)
    a = parser.parse_args()
    set_threads(a.threads)
    columns = (
        "photograph", "planted", "scale found, %", "turn found, degrees", "left, held out: given, found",
        "taken", "PSNR: given, refined, right", "CPU s",
    )  # fmt: skip
    if {*a.sets} - {"stack"}:
        print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|", flush=True)
    if "simulated" in a.sets:
        for family in a.families:
            for seed in range(a.seeds):
                simulated(family, a.size, seed)
    if "hand" in a.sets:
        measured("hand", 4)
    if "usaf" in a.sets:
        measured("usaf", 4)
    if "stack" in a.sets:
        of_stack = ("photograph", "asked for, mm", "true, mm", "found", "PSNR: given, refined")
        print(f"\n| {' | '.join(of_stack)} |\n{'|---' * len(of_stack)}|", flush=True)
        for seed in range(a.seeds):
            for optics in ("random", "smooth"):
                in_a_stack("sparse-picture", optics, min(a.size, 64), seed)


if __name__ == "__main__":
    main()
