"""Active illumination from runs to a picture: the scene's run, and the same plan's run of a plain sheet."""

from __future__ import annotations

import io
import threading
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.calibration_file import load_calibration
from instrument.files.errors import BenchError, FileError
from instrument.plan.model import DARK, PATTERN
from instrument.reconstruction.job import Job, find_calibration, reduced_calibration
from instrument.reconstruction.preparation import reduce
from instrument.reconstruction.request import refocused
from instrument.runs.run import Run
from recon import Measurement, reconstruct
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.result import Reconstruction
from recon.solvers.base import IterationRecord
from recon.types import Calibration

Floats = npt.NDArray[np.float32]

SHEET_ITERATIONS = 60
"""A sheet's picture is smooth, and smoothed afterwards: more add nothing."""

SMOOTHING_SHARE = 0.03
"""Width of the patterns' smoothing relative to the picture's short side: light of LEDs varies slowly, the
noise of a sheet's picture does not."""

LEAST_LIGHT = 0.05
"""Where the sheet, lit by all groups together, shines less than this share of its bright part, its patterns
are not known, and nothing is reconstructed."""

BRIGHT_PERCENTILE = 99.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PatternedRequest:
    """What a picture is reconstructed from, and how."""

    run: Path
    """Of a plan of :func:`instrument.plan.model.illumination_plan`, the scene in place."""
    sheet: Path
    """A run of the same plan, a plain white sheet in the scene's place; or patterns themselves as ``.npy``,
    (n_patterns, height, width) on the calibration's pixels."""
    calibration: Path
    binning: int = 1
    """Of the calibration's pixels."""
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)


@dataclass(frozen=True, slots=True)
class PreparedPatterned:
    """Everything on the picture's pixels."""

    job: Job
    """Its measurement is the sum of all frames: the scene in even light."""
    frames: Floats
    patterns: Floats
    """float32, (n_patterns, height, width): counts less dark; shares of the light of all groups together."""
    request: PatternedRequest


def prepare_patterned(
    request: PatternedRequest, on_progress: Callable[[int, int], object] = lambda _done, _total: None
) -> PreparedPatterned:
    """Read both runs, and reconstruct the patterns from the sheet's.

    ``on_progress``: ``on_progress(patterns done, patterns)`` after each.

    Raises FileError, BenchError or InputError when something cannot be used, or the runs do not belong
    together.
    """
    folder = find_calibration(request.calibration)
    calibration = _grey(load_calibration(folder), request.binning)
    run = Run.open(request.run)
    frames = _frames(run, calibration, request.binning)
    warnings = list(_saturation(run))
    simulated = run.is_simulated or bool(calibration.provenance.get("simulated"))
    job = Job(
        frames.sum(axis=0),
        calibration,
        {
            "Calibration": f"{folder}: PSFs of {frames.shape[1]} x {frames.shape[2]}",
            "Image": f"{run.path}: {len(frames)} patterns",
            "Sheet": str(request.sheet),
        },
        warnings=(),
        provenance={
            "run": str(run.path.resolve()),
            "sheet": str(request.sheet.resolve()),
            "calibration": str(folder.resolve()),
            "binning": request.binning,
        },
        simulated=simulated,
    )
    if request.options.z_um is not None:
        job = refocused(job, request.options.z_um)
    if request.sheet.suffix.lower() == ".npy":
        patterns = _patterns_from_file(request.sheet, frames.shape)
    else:
        sheet = Run.open(request.sheet)
        if sheet.path.samefile(run.path):
            raise FileError(
                request.sheet,
                "is the scene's own run: its patterns would be the scene's.",
                "Run the same plan with a plain white sheet in the scene's place, and give that run.",
            )
        _require_same_plan(run, sheet)
        warnings += _saturation(sheet)
        patterns = _patterns_of(_frames(sheet, calibration, request.binning), job, request, on_progress)
    return PreparedPatterned(replace(job, warnings=tuple(warnings)), frames, patterns, request)


def solve_patterned(
    prepared: PreparedPatterned,
    *,
    watch: Callable[[IterationRecord], object] | None = None,
    cancel: threading.Event | None = None,
) -> Reconstruction:
    """Reconstruct the one picture that explains all frames, in the brightness of all groups together."""
    request = prepared.request
    return reconstruct(
        Measurement(prepared.frames, patterns=prepared.patterns),
        prepared.job.calibration,
        request.options,
        on_progress=None if watch is None else lambda record, _: watch(record),
        cancel=cancel,
    )


def _frames(run: Run, calibration: Calibration, binning: int) -> Floats:
    """Return a run's pattern frames less its dark one, grey, on the picture's pixels."""
    labels = {step.label for step in run.steps()} if run.plan is not None else set()
    if not {DARK, PATTERN} <= labels:
        raise FileError(
            run.path,
            f"is no run of active illumination: it has no frames called {DARK!r} and {PATTERN!r}.",
            "diffuserbench plan illumination writes a plan that has them; diffuserbench run carries it out.",
        )
    if run.missing():
        raise FileError(
            run.path, f"lacks {len(run.missing())} frames.", "diffuserbench resume takes the rest."
        )
    if any("bayer" in r.metadata.pixel_format.lower() for r in run.records.values()):
        raise FileError(run.path, "has raw frames of a colour mosaic; active illumination takes grey frames.")
    dark = _as_grey(run.images(DARK)).mean(axis=0)
    lit = _as_grey(run.images(PATTERN)) - dark
    height, width = (n * binning for n in calibration.psfs.shape[-2:])
    match = max(lit.shape[1] // height, 1)
    # The calibration's own rest, less than a binned pixel, is left out at the right and below.
    fits = [n // match // binning for n in lit.shape[1:]] == list(calibration.psfs.shape[-2:])
    if not fits:
        raise FileError(
            run.path,
            f"has frames of {lit.shape[1]} x {lit.shape[2]}, but the PSFs are {height} x {width}: no whole "
            "binning brings one to the other.",
            "Photograph with the region of interest and binning of the calibration.",
        )
    return np.stack([reduce(frame, 0.0, None, match * binning) for frame in lit])


def _as_grey(images: npt.NDArray[Any]) -> Floats:
    images = images.astype(np.float32)
    return images.mean(axis=-1) if images.ndim == 4 else images


def _grey(calibration: Calibration, binning: int) -> Calibration:
    """Return the calibration with grey PSFs on binned pixels."""
    grey = replace(calibration, psfs=calibration.psfs.mean(axis=1, keepdims=True), background=None)
    return reduced_calibration(grey, None, binning)


def _require_same_plan(run: Run, sheet: Run) -> None:
    """Both must have been lit by the same LEDs in the same order."""

    def lights(which: Run) -> list[Any]:
        return [step.light.leds for step in which.steps(PATTERN)]

    if sheet.plan is None or lights(run) != lights(sheet):
        raise BenchError(
            f"{sheet.path} was not lit by the same groups of LEDs as {run.path}: run the same plan with a "
            "plain sheet in the scene's place."
        )


def _patterns_from_file(path: Path, shape: tuple[int, ...]) -> Floats:
    try:
        patterns = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileError(path, f"cannot be read: {error}.") from None
    if not isinstance(patterns, np.ndarray):
        raise FileError(path, "is an .npz archive by another name; one plain .npy array is expected.")
    if patterns.shape != shape or patterns.dtype.kind not in "fiu":
        raise FileError(
            path,
            f"holds {patterns.dtype} {patterns.shape}; one pattern a frame is expected, numbers {shape}.",
        )
    if not np.isfinite(patterns).all() or patterns.min() < 0:
        raise FileError(path, "holds patterns that are negative or not finite.")
    return _shares(patterns.astype(np.float32), path)


def _patterns_of(
    sheet: Floats, job: Job, request: PatternedRequest, on_progress: Callable[[int, int], object]
) -> Floats:
    """Reconstruct the sheet under each group, smooth, and take the share of each in all of them."""
    from scipy.ndimage import gaussian_filter

    sigma = SMOOTHING_SHARE * min(sheet.shape[1:])
    pictures = []
    on_progress(0, len(sheet))
    for frame in sheet:
        found = reconstruct(
            frame, job.calibration, z_um=request.options.z_um, solver="admm", iterations=SHEET_ITERATIONS,
            model="convolution", judged=False,
        )  # fmt: skip
        pictures.append(np.maximum(gaussian_filter(found.image, sigma), 0))
        on_progress(len(pictures), len(sheet))
    return _shares(np.stack(pictures), request.sheet)


def _shares(patterns: Floats, path: Path) -> Floats:
    """Return what part of the light of all patterns each has; none where there is next to no light."""
    total = patterns.sum(axis=0)
    bright = float(np.percentile(total, BRIGHT_PERCENTILE))
    if not bright > 0:
        raise FileError(path, "is dark: no pattern lights anything.", "Expose longer, or use more LEDs.")
    known = total > LEAST_LIGHT * bright
    return np.where(known, patterns / np.where(known, total, 1), 0).astype(np.float32)


def _saturation(run: Run) -> tuple[str, ...]:
    count = sum(record.metadata.saturated_fraction > 0 for record in run.records.values())
    if not count:
        return ()
    return (f"{run.path}: {count} frames have saturated pixels: expose shorter.",)
