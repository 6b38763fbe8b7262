"""Photograph a lit scene as the reconstruction wants it: well exposed, dark frame and hot pixels removed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration_routines.errors import CalibrationError, RunEndedError
from calibration_routines.psf.analysis import DarkModel, channels_first, replace_hot
from calibration_routines.psf.exposure import AutoExposure, ExposureOutcome, auto_expose, hot_pixels
from instrument.bench.bench import Bench
from instrument.plan import OFF, Part, Plan
from instrument.runs.acquire import acquire
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import RunControl
from instrument.runs.runner import RunProgress
from recon.base.blocks import block_mean


@dataclass(frozen=True, slots=True)
class Photograph:
    """A measurement of a scene.

    Attributes
    ----------
    measurement : ndarray, float32, (height, width) or (height, width, 3)
        Mean of the frames minus the mean dark frame, counts; hot pixels replaced by their neighbours' median,
        then binned. Negative values are kept: they balance the noise.
    raw : ndarray, uint8 or uint16
        The first frame as the camera gave it.
    exposure_ms : float
    saturated_pixels : int
        Pixels at full scale in any frame, hot ones excepted.
    run : Run
    """

    measurement: npt.NDArray[np.float32]
    raw: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    exposure_ms: float
    saturated_pixels: int
    run: Run


def expose_scene(bench: Bench, *, target: float = 0.7) -> AutoExposure:
    """Auto-expose the lit scene as a PSF is: 99.9th percentile to ``target``, nothing saturated; ends dark.

    Raises
    ------
    CalibrationError
        When the scene saturates at the shortest exposure or flickers. A scene too dark for ``target`` is
        photographed at the longest exposure.
    """
    bench.source_off()
    bench.scene_off()
    dark = bench.camera.snap()
    bench.scene_on()
    try:
        found = auto_expose(bench.camera, target=target, hot=hot_pixels(dark.image, dark.full_scale))
    finally:
        bench.scene_off()
    if found.outcome in (ExposureOutcome.TOO_BRIGHT, ExposureOutcome.UNSTEADY):
        raise CalibrationError(found.message)
    return found


def photograph_plan(exposure_ms: float, average: int, dark_frames: int) -> Plan:
    """Return the plan of a photograph: the lit scene, then dark frames."""
    return Plan(
        label="photograph",
        parts=(
            Part(label="scene", scene_lit=True, exposures_ms=(exposure_ms,), repeats=average),
            Part(label="dark", light=(OFF,), exposures_ms=(exposure_ms,), repeats=dark_frames),
        ),
    )


def photograph(
    bench: Bench,
    exposure_ms: float | None = None,
    folder: Path | str | None = None,
    *,
    average: int = 1,
    dark_frames: int = 4,
    binning: int = 1,
    on_progress: RunProgress | None = None,
    control: RunControl | None = None,
) -> Photograph:
    """Photograph the scene into a run; ends with everything dark.

    Parameters
    ----------
    bench : Bench
        Open.
    exposure_ms : float, optional
        By default what :func:`expose_scene` finds.
    folder : path, optional
        Where the run's folder is made; the bench's data folder by default.
    average, dark_frames : int
        Frames with and without light; all are stored.
    binning : int
        Software binning, on top of the camera's; the same as the calibration's.
    on_progress : callable, optional
    control : RunControl, optional
        To pause, abort or stop the run from another thread.

    Raises
    ------
    PlanError, DeviceError, RunError
        See :func:`instrument.runs.acquire.acquire`.
    CalibrationError
        When the run was ended before its last frame.
    """
    if exposure_ms is None:
        exposure_ms = expose_scene(bench).exposure_ms
    plan = photograph_plan(exposure_ms, average, dark_frames)
    run = acquire(bench, plan, folder, on_progress=on_progress, control=control)
    if run.condition is not RunCondition.COMPLETED:
        raise RunEndedError("The run", run)
    frames = run.images("scene")
    full_scale = (1 << run.metadata(0).significant_bits) - 1
    dark = DarkModel((exposure_ms,), (run.images("dark"),), full_scale)
    light = frames.mean(axis=0, dtype=np.float32) - dark.at(exposure_ms)
    binned = block_mean(channels_first(replace_hot(light, dark.hot)), binning)
    saturated = (frames >= full_scale).any(axis=0) & ~dark.hot
    return Photograph(
        measurement=np.ascontiguousarray(np.moveaxis(binned, 0, -1)) if frames.ndim == 4 else binned[0],
        raw=frames[0],
        exposure_ms=run.metadata(0).exposure_ms,
        saturated_pixels=int(np.count_nonzero(saturated)),
        run=run,
    )
