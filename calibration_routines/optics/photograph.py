"""Photograph a lit scene as the reconstruction wants it: well exposed, dark frame and hot pixels removed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration_routines.procedure import (
    Checked,
    Listener,
    Outcome,
    Outlook,
    Procedure,
    Routine,
    completed,
    outlook_of,
)
from calibration_routines.psf.analysis import channels_first, dark_model, full_scale, replace_hot
from calibration_routines.psf.exposure import expose_scene
from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.files.images import write_image
from instrument.plan import OFF, Part, Plan, check
from instrument.runs.acquire import abilities_of, acquire
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.base.blocks import block_mean
from recon.base.declare import RARE, option

PHOTOGRAPH_FILE = "photograph.tif"


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
    control: RunControl | None = None,
    listener: Listener | None = None,
) -> Photograph:
    """Photograph the scene into a run; ends with everything dark.

    Parameters
    ----------
    bench : Bench
        Open.
    exposure_ms : float, optional
        By default what :func:`~calibration_routines.expose_scene` finds.
    folder : path, optional
        Where the run's folder is made; the bench's data folder by default.
    average, dark_frames : int
        Frames with and without light; all are stored.
    binning : int
        Software binning, on top of the camera's; the same as the calibration's.
    control : RunControl, optional
        To pause, abort or stop the run from another thread.
    listener : Listener, optional

    Raises
    ------
    PlanError, DeviceError, RunError
        See :func:`instrument.runs.acquire.acquire`.
    CalibrationError
        When the run was ended before its last frame.
    """
    control, listener = control or RunControl(), listener or Listener()
    if exposure_ms is None:
        listener.step("finding the exposure")
        exposure_ms = expose_scene(bench).exposure_ms
        control.check()
    listener.step("photographing")
    plan = photograph_plan(exposure_ms, average, dark_frames)
    run = completed(acquire(bench, plan, folder, on_progress=listener.frame, control=control))
    frames = run.images("scene")
    dark = dark_model(run)
    light = frames.mean(axis=0, dtype=np.float32) - dark.at(run.metadata(0).exposure_ms)
    binned = block_mean(channels_first(replace_hot(light, dark.hot)), binning)
    saturated = (frames >= full_scale(run)).any(axis=0) & ~dark.hot
    return Photograph(
        measurement=np.ascontiguousarray(np.moveaxis(binned, 0, -1)) if frames.ndim == 4 else binned[0],
        raw=frames[0],
        exposure_ms=run.metadata(0).exposure_ms,
        saturated_pixels=int(np.count_nonzero(saturated)),
        run=run,
    )


# Procedure -------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class PhotographProcedure(Checked, Procedure):
    """Photograph the lit scene for a reconstruction: exposure, frames, dark frames taken off."""

    exposure_ms: float | None = option(
        None, unit="ms", above=0, help="Of each frame.", default_words="found, so that nothing saturates"
    )
    average: int = option(4, least=1, label="Frames", help="Frames; all are stored, their mean is taken.")
    dark_frames: int = option(4, least=1, help="Frames without light.")
    binning: int = option(
        1, least=1, help="In software, on top of the camera's; the same as the calibration's.", group=RARE
    )

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold exposure, frames and disk against the bench."""
        folder = folder or bench.config.data_folder
        present_ms = self.exposure_ms or bench.camera.exposure_ms
        low, high = bench.camera.exposure_limits_ms
        if not low <= present_ms <= high:
            words = f"{present_ms:g} ms is outside the camera's {low:g} to {high:g} ms"
            raise SettingsError([("exposure_ms", words)])
        plan = photograph_plan(present_ms, self.average, self.dark_frames)
        check(plan, abilities_of(bench, folder))
        found = "as given" if self.exposure_ms is not None else "found at the start"
        return outlook_of(bench, plan, folder, [f"The exposure is {found}."])

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Photograph, and write the picture that ``reconstruct`` takes into the run's folder."""
        taken = photograph(
            bench,
            self.exposure_ms,
            folder,
            average=self.average,
            dark_frames=self.dark_frames,
            binning=self.binning,
            control=control,
            listener=listener,
        )
        file = taken.run.path / PHOTOGRAPH_FILE
        facts = {"bench": bench.label, "simulated": bool(bench.simulated_kinds), "binning": self.binning}
        write_image(file, taken.measurement, facts | {"exposure_ms": taken.exposure_ms, "dark": "taken off"})
        words = f"Photograph: {taken.exposure_ms:.4g} ms, {taken.saturated_pixels} saturated pixels"
        return Outcome(
            verdict=(words,),
            good=taken.saturated_pixels == 0,
            runs=(taken.run.path,),
            files=(file,),
            result=taken,
        )


ROUTINES = (
    Routine(
        name="photograph",
        title="Photograph of the scene",
        help="Photograph the lit scene as a reconstruction wants it: well exposed, dark frames taken off.",
        details="Finds the exposure at which nothing saturates unless one is given. Writes photograph.tif "
        "into the run's folder.",
        options=PhotographProcedure,
        procedure=lambda options: options,
        examples=("diffuserbench calibrate photograph", "diffuserbench calibrate photograph --binning 2"),
    ),
)
"""Row of :data:`calibration_routines.procedure.routines`."""
