"""What is charted: a test scene, a photograph, or a picture to be shown as a hologram."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from instrument.bench.config import BenchConfig
from instrument.display.bench_display import bench_display, slm_size
from instrument.display.hologram import field_words, prepare_target, read_picture
from instrument.files.errors import BenchError
from instrument.files.sample_images import SAMPLES
from instrument.reconstruction.job import Job
from recon.base.noise import NoiseModel, averaged_noise
from recon.camera.camera_model import one_depth
from recon.errors import InputError
from recon.evaluation.chart_hologram import HologramProblem
from recon.evaluation.chart_reconstruction import ChartProblem
from recon.evaluation.own_calibrations import OwnCalibration, OwnCalibrationsProblem
from recon.evaluation.scene import make_scene

_SQUARE = "a square one is shown whole"
EXPANSIONS = (4, 16)
"""Charted beside the bench's own."""


def problem_of_scene(family: str, size: int, seed: int) -> tuple[ChartProblem, dict[str, Any]]:
    """Return a test scene to chart on, and what to say of it.

    Raises InputError when there is no such scene.
    """
    scene = make_scene(family, size=size, seed=seed, grid=3)  # type: ignore[arg-type]
    problem = ChartProblem.of_scene(scene)
    about = {"scene": family, "size": size, "seed": seed, "simulated": True}
    return problem, {**about, "left_out": list(problem.left_out())}


def problem_of_job(job: Job, z_um: float | None, *, volume: bool) -> tuple[ChartProblem, dict[str, Any]]:
    """Return a photograph to chart on: the mean of its colours."""
    measurement = job.measurement if job.measurement.ndim == 2 else job.measurement.mean(axis=2)
    valid = None if job.valid is None else (job.valid if job.valid.ndim == 2 else job.valid.all(axis=2))
    calibration = job.calibration
    if calibration.psfs.shape[1] > 1:
        calibration = replace(calibration, psfs=calibration.psfs.mean(axis=1, keepdims=True), background=None)
    if not volume:
        calibration = one_depth(calibration, z_um)
    problem = ChartProblem(
        np.ascontiguousarray(measurement, np.float32),
        calibration,
        volume,
        None if valid is None or valid.all() else np.logical_not(np.asarray(valid, bool)),
        _noise_of_mean(job),
    )
    about = {"inputs": dict(job.provenance), "simulated": job.simulated}
    return problem, {**about, "left_out": list(problem.left_out())}


def problem_of_calibrations(
    jobs: Mapping[Path, Job], z_um: float | None, *, volume: bool
) -> tuple[OwnCalibrationsProblem, dict[str, Any]]:
    """Return calibrations to compare on one photograph, by their folders, and what to say of them.

    Raises BenchError when they do not bring the photograph to the same pixels.
    """
    own = []
    for folder, job in jobs.items():
        problem, _ = problem_of_job(job, z_um, volume=volume)
        calibration = job.calibration
        slides = calibration.quality.get("beads_found")
        sweep = calibration.provenance.get("sweep") or {}
        own.append(
            OwnCalibration(
                _label(folder, jobs),
                problem,
                len(slides) / len(calibration.psfs) if slides else float(sweep.get("average", 1)),
                whole=bool(slides),
            )
        )
    first = next(iter(jobs.values()))
    about = {
        "calibrations": [str(folder) for folder in jobs],
        "inputs": dict(first.provenance),
        "simulated": any(job.simulated for job in jobs.values()),
    }
    try:
        return OwnCalibrationsProblem(tuple(own)), about
    except InputError as error:
        raise BenchError(str(error)) from error


def _label(folder: Path, others: Iterable[Path]) -> str:
    """Return the name of a calibration's folder, or of the run it lies in; the path where that is no name."""

    def short(path: Path) -> str:
        whole = path.resolve()
        return whole.parent.name if whole.name == "calibration" else whole.name

    name = short(folder)
    return name if [short(other) for other in others].count(name) == 1 else str(folder)


def _noise_of_mean(job: Job) -> NoiseModel | float | None:
    """Return what the photograph's metadata say of its noise, of the mean of its colours."""
    noise = job.binned_noise(None)
    if job.measurement.ndim == 2 or not isinstance(noise, NoiseModel):
        return noise
    return averaged_noise(noise, job.measurement.shape[2])


def problem_of_pictures(
    config: BenchConfig,
    pictures: Sequence[str],
    z_mm: Sequence[float],
    expansions: Sequence[int],
    frames: Sequence[int],
    slm: tuple[int, int] | None = None,
) -> tuple[HologramProblem, dict[str, Any]]:
    """Return pictures to chart holograms of, one a plane, and what to say of them.

    Raises BenchError or FileError.

    Parameters
    ----------
    config : BenchConfig
        Of a bench with an SLM.
    pictures : sequence of str
        Files, or names of sample pictures.
    z_mm : sequence of float
        Depth of each; empty: one picture in focus.
    expansions : sequence of int
        Empty: the bench's own, and :data:`EXPANSIONS`.
    slm : (int, int), optional
        Rows and columns to compute for, on the bench's SLM's pitch. Default: the SLM's own.
    """
    depths = list(z_mm) if z_mm else [0.0] * len(pictures)
    if len(depths) != len(pictures) or (len(pictures) > 1 and not z_mm):
        raise BenchError(f"Give --z-mm once for each of the {len(pictures)} targets (found {len(z_mm)}).")
    if len(set(depths)) != len(depths):
        raise BenchError(f"Each target has a depth of its own; --z-mm has {depths}.")
    read = [_picture(name) for name in pictures]
    shape, pitch_um = slm_size(config)
    if slm is not None:
        shape = (slm[0] * config.display.slm_binning, slm[1] * config.display.slm_binning)
    factors = sorted(set(expansions) or {config.display.expansion, *EXPANSIONS})
    displays = tuple(bench_display(config, (shape, pitch_um), expansion=q) for q in factors)
    targets = tuple(
        tuple(prepare_target(pixels, d, z_mm=z) for pixels, z in zip(read, depths, strict=True))
        for d in displays
    )
    about = {
        "pictures": [str(name) for name in pictures],
        "z_mm": depths,
        "bench": config.label,
        "expansions": factors,
        "cropped": next(filter(None, (field_words(pixels, "cover", _SQUARE) for pixels in read)), None),
        "simulated": True,
    }
    return HologramProblem(displays, targets, tuple(sorted(set(frames)))), about


def _picture(name: str) -> Any:
    if name in SAMPLES and not Path(name).exists():
        return np.asarray(SAMPLES[name].load())
    if not Path(name).exists() and not Path(name).suffix:
        raise BenchError(f"{name}: there is no such file, and no such sample picture ({', '.join(SAMPLES)}).")
    return read_picture(Path(name)).pixels
