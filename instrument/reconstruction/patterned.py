"""Active illumination from runs to a picture: the scene's run, and the same plan's run of a plain sheet."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.calibration_file import find_calibration, load_calibration
from instrument.files.decoding import require_npy
from instrument.files.errors import BenchError, FileError, count
from instrument.files.images import ImageFile
from instrument.plan.illumination import DARK, PATTERN
from instrument.reconstruction.forecast import Forecast, forecast
from instrument.reconstruction.job import Job, job_with, matching_binning
from instrument.reconstruction.mosaic import pattern_of
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.request import refocused
from instrument.runs.run import Run
from recon import Measurement, reconstruct
from recon.arrays import BoolArray, Float32Array
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Stage
from recon.reconstruction.result import Reconstruction
from recon.solvers.base import IterationRecord, Keeper
from recon.solvers.memory import MemoryMeter
from recon.types import Calibration

WHOLE_COLOURS = (
    "each with all colours of the mosaic (--bin 1: the sensor's own, a quarter of them red or blue)"
)
SHEET_ITERATIONS = 60
"""A sheet's picture is smooth, and smoothed afterwards: more add nothing."""

SMOOTHING_SHARE = 0.03
"""Width of the patterns' smoothing relative to the picture's short side: light of LEDs varies slowly, the
noise of a sheet's picture does not."""

SWAPPED = 1.5
"""Times as rough as the scene is a sheet that is taken for one."""

LEAST_LIGHT = 0.05
"""Where the sheet, lit by all groups together, shines less than this share of its bright part, its patterns
are not known, and nothing is reconstructed."""

BRIGHT_PERCENTILE = 99.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PatternedRequest:
    """What a picture is reconstructed from, and how."""

    run: Path
    """Of a plan of :func:`instrument.plan.illumination.illumination_plan`, the scene in place."""
    sheet: Path
    """A run of the same plan, a plain white sheet in the scene's place; or patterns themselves as ``.npy``,
    (n_patterns, height, width) on the calibration's pixels."""
    calibration: Path
    inputs: InputOptions = field(default_factory=InputOptions)
    """How every frame becomes part of the measurement; the plan has its own dark frame."""
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)


@dataclass(frozen=True, slots=True)
class PreparedPatterned:
    """Everything on the picture's pixels."""

    job: Job
    """Its measurement is the sum of all frames: the scene in even light."""
    measurement: Measurement
    """All frames, with what is known of them, under the patterns: shares of the light of all groups."""
    request: PatternedRequest
    seconds: float
    """That preparing took, the patterns included."""
    meter: MemoryMeter
    """Begun before it."""


def prepare_patterned(
    request: PatternedRequest, on_progress: Callable[[int, int], object] = lambda _done, _total: None
) -> PreparedPatterned:
    """Read both runs, and reconstruct the patterns from the sheet's.

    ``on_progress``: ``on_progress(patterns done, patterns)`` after each.

    Raises FileError, BenchError or InputError when something cannot be used, or the runs do not belong
    together.
    """
    meter, began_s = MemoryMeter(), time.perf_counter()
    folder = find_calibration(request.calibration)
    calibration = replace(load_calibration(folder), background=None)
    run = Run.open(request.run)
    from_file = request.sheet.suffix.lower() == ".npy"
    # A file's patterns have the frames' own pixels.
    inputs = request.inputs if from_file else _whole_colours(request.inputs, run, calibration, folder)
    lit = _Lit.of(run, calibration, folder, inputs)
    job = replace(
        lit.job,
        measurement=lit.frames.sum(axis=0),
        notes={
            **{name: text for name, text in lit.job.notes.items() if name not in ("Image", "Dark")},
            "Image": f"{run.path}: {len(lit.frames)} patterns",
            "Sheet": str(request.sheet),
        },
        provenance={
            **{key: found for key, found in lit.job.provenance.items() if key != "image"},
            "dark": {**lit.job.provenance["dark"], "from": f"the frames {DARK!r} of the run"},
            "run": str(run.path.resolve()),
            "sheet": str(request.sheet.resolve()),
        },
        simulated=lit.job.simulated or run.is_simulated,
    )
    if request.options.z_um is not None:
        job = refocused(job, request.options.z_um)
    warnings = [*job.warnings, *_saturation(run)]
    if inputs is not request.inputs:
        job = replace(job, notes={**job.notes, "Pixels": f"{job.notes['Pixels']}; {WHOLE_COLOURS}"})
    if from_file:
        patterns = _patterns_from_file(request.sheet, lit.frames.shape[:3])
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
        white = _Lit.of(sheet, calibration, folder, inputs)
        patterns, rough = _patterns_of(white, job, request, on_progress)
        even = None if lit.erased is None else lit.erased.any(axis=0)
        if rough > SWAPPED * _roughness(_look(Measurement(job.measurement, erasures=even), job, request)):
            warnings.append(
                f"{sheet.path} is rougher than {run.path}, as a scene is and a plain sheet is not: the two "
                "may be swapped."
            )
    noise = job.binned_noise(request.inputs.noise)
    measurement = Measurement(lit.frames, noise, erasures=lit.erased, patterns=patterns)
    job = replace(job, warnings=tuple(warnings))
    return PreparedPatterned(job, measurement, request, time.perf_counter() - began_s, meter)


def _whole_colours(inputs: InputOptions, run: Run, calibration: Calibration, folder: Path) -> InputOptions:
    """Return how a mosaic's raw frames are read where nothing is said of pixels: every colour in each.

    Red and blue have a quarter of the sensor's own pixels, by which the iterations come on slowly. Where a
    pixel of the calibration is several of the frames', it has every colour by itself.
    """
    steps = [] if run.plan is None else run.steps(PATTERN)
    if inputs.binning is not None or not steps or steps[0].index not in run.records:
        return inputs
    told = {"pixel_format": run.metadata(steps[0].index).pixel_format}
    frame = ImageFile(run.path, run.frame(steps[0]), metadata=told)
    mosaic = None if frame.is_colour else pattern_of(inputs.mosaic, frame)
    if mosaic is None or matching_binning(frame, calibration.psfs.shape[-2:], folder) > 1:
        return inputs
    return replace(inputs, binning=2)


def solve_patterned(
    prepared: PreparedPatterned,
    *,
    watch: Callable[[IterationRecord], object] | None = None,
    cancel: threading.Event | None = None,
    keeper: Keeper | None = None,
) -> Reconstruction:
    """Reconstruct the one picture that explains all frames, in the brightness of all groups together."""
    request = prepared.request
    return reconstruct(
        prepared.measurement,
        prepared.job.calibration,
        request.options,
        on_progress=None if watch is None else lambda record, _: watch(record),
        cancel=cancel,
        keeper=keeper,
    )


def forecast_patterned(prepared: PreparedPatterned, on_stage: Stage | None = None) -> Forecast:
    """Say what time and memory all of it takes, its patterns too; errors as :func:`solve_patterned`."""
    told = forecast(prepared.measurement, prepared.job.calibration, prepared.request.options, on_stage)
    taken = prepared.meter.peak_mib() * 2**20
    return replace(told, beside_s=told.beside_s + prepared.seconds, memory_bytes=taken)


@dataclass(frozen=True, slots=True)
class _Lit:
    """A run's pattern frames on the picture's pixels."""

    job: Job
    """Of the first one."""
    frames: Float32Array
    """(n_patterns, height, width[, 3]): less the dark frame."""
    erased: BoolArray | None

    @classmethod
    def of(cls, run: Run, calibration: Calibration, folder: Path, inputs: InputOptions) -> _Lit:
        """Bring each frame to the calibration as a photograph is brought; grey ones have grey PSFs."""
        labels = {step.label for step in run.steps()} if run.plan is not None else set()
        if not {DARK, PATTERN} <= labels:
            raise FileError(
                run.path,
                f"is no run of active illumination: it has no frames called {DARK!r} and {PATTERN!r}.",
                "diffuserbench plan illumination writes a plan that has them; diffuserbench run carries it "
                "out.",
            )
        if run.missing():
            raise FileError(
                run.path, f"lacks {len(run.missing())} frames.", "diffuserbench resume takes the rest."
            )
        jobs = []
        images = run.images(DARK)
        dark = ImageFile(
            Path(f"{run.path} dark"), images[0] if len(images) == 1 else images.mean(axis=0, dtype=np.float32)
        )
        for index, step in enumerate(run.steps(PATTERN)):
            told = {"pixel_format": run.metadata(step.index).pixel_format}
            frame = ImageFile(Path(f"{run.path} pattern {index}"), run.frame(step), metadata=told)
            if not (frame.is_colour or pattern_of(inputs.mosaic, frame)):
                calibration = replace(calibration, psfs=calibration.psfs.mean(axis=1, keepdims=True))
            jobs.append(job_with(calibration, folder, frame, replace(inputs, dark=dark)))
        frames = np.stack([job.measurement for job in jobs])
        if all(job.valid is None for job in jobs):
            return cls(jobs[0], frames, None)
        valid = np.ones(frames.shape, bool)
        for seen, job in zip(valid, jobs, strict=True):
            if job.valid is not None:
                seen &= job.valid if job.valid.ndim == seen.ndim else job.valid[..., None]
        return cls(jobs[0], frames, ~valid)


def _require_same_plan(run: Run, sheet: Run) -> None:
    """Both must have been lit by the same LEDs in the same order."""

    def lights(which: Run) -> list[Any]:
        return [step.light.leds for step in which.steps(PATTERN)]

    if sheet.plan is None or lights(run) != lights(sheet):
        raise BenchError(
            f"{sheet.path} was not lit by the same groups of LEDs as {run.path}: run the same plan with a "
            "plain sheet in the scene's place."
        )


def _patterns_from_file(path: Path, shape: tuple[int, ...]) -> Float32Array:
    try:
        require_npy(path)
        patterns = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FileError(path, f"cannot be read: {error}.") from None
    if patterns.shape != shape or patterns.dtype.kind not in "fiu":
        raise FileError(
            path,
            f"holds {patterns.dtype} {patterns.shape}; one pattern a frame is expected, numbers {shape}.",
        )
    if not np.isfinite(patterns).all() or patterns.min() < 0:
        raise FileError(path, "holds patterns that are negative or not finite.")
    return _shares(patterns.astype(np.float32), path)


def _patterns_of(
    sheet: _Lit, job: Job, request: PatternedRequest, on_progress: Callable[[int, int], object]
) -> tuple[Float32Array, float]:
    """Reconstruct the sheet under each group, smooth, and take the share of each in all of them.

    Beside it: how rough the sheet is in all light.
    """
    pictures = []
    on_progress(0, len(sheet.frames))
    for index, frame in enumerate(sheet.frames):
        erased = None if sheet.erased is None else sheet.erased[index]
        pictures.append(_look(Measurement(frame, erasures=erased), job, request))
        on_progress(len(pictures), len(sheet.frames))
    smooth = np.stack([np.maximum(_smoothed(picture), 0) for picture in pictures])
    return _shares(smooth, request.sheet), _roughness(np.sum(pictures, axis=0))


def _look(measurement: Measurement, job: Job, request: PatternedRequest) -> Float32Array:
    """Return a quick grey picture in one light."""
    image = reconstruct(
        measurement, job.calibration, z_um=request.options.z_um, solver="admm", iterations=SHEET_ITERATIONS,
        model="convolution", judged=False,
    ).image  # fmt: skip
    grey: Float32Array = image.mean(axis=-1) if image.ndim == 3 else image
    return grey


def _smoothed(picture: Float32Array) -> Float32Array:
    from scipy.ndimage import gaussian_filter

    smooth: Float32Array = gaussian_filter(picture, SMOOTHING_SHARE * min(picture.shape))
    return smooth


def _roughness(picture: Float32Array) -> float:
    """Return what smoothing takes off a picture, relative to it."""
    whole = float(np.linalg.norm(picture))
    return float(np.linalg.norm(picture - _smoothed(picture))) / whole if whole > 0 else 0.0


def _shares(patterns: Float32Array, path: Path) -> Float32Array:
    """Return what part of the light of all patterns each has; none where there is next to no light."""
    total = patterns.sum(axis=0)
    bright = float(np.percentile(total, BRIGHT_PERCENTILE))
    if not bright > 0:
        raise FileError(path, "is dark: no pattern lights anything.", "Expose longer, or use more LEDs.")
    known = total > LEAST_LIGHT * bright
    return np.where(known, patterns / np.where(known, total, 1), 0).astype(np.float32)


def _saturation(run: Run) -> tuple[str, ...]:
    number = sum(record.metadata.saturated_fraction > 0 for record in run.records.values())
    if not number:
        return ()
    have = "has" if number == 1 else "have"
    return (f"{run.path}: {count(number, 'frame')} {have} saturated pixels: expose shorter.",)
