"""Photograph a lit scene as the reconstruction wants it: well exposed, dark frame and hot pixels removed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration_routines.options import Checked
from calibration_routines.planned import outlook_of
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure, require_whereabouts
from calibration_routines.psf.analysis import (
    ambient_findings,
    channels_first,
    dark_model,
    full_scale,
    light_frames,
)
from calibration_routines.psf.exposure import expose_scene
from calibration_routines.psf.sweep_plan import DARK
from calibration_routines.purpose import Purpose, completed
from calibration_routines.routine import Routine
from calibration_routines.scatter import STEADY, Scatter, pooled
from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.files.images import write_image
from instrument.files.record import RecordFormat, plain
from instrument.plan import OFF, Part, Plan, check
from instrument.runs.acquire import abilities_of, acquire
from instrument.runs.results import PHOTOGRAPH_FILE
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.arrays import Float32Array
from recon.base.arguments import require_argument
from recon.base.blocks import block_mean
from recon.base.declare import RARE, option


@dataclass(frozen=True, slots=True)
class Photograph:
    """A measurement of a scene."""

    measurement: Float32Array
    """(height, width) or (height, width, 3): mean of the frames minus the mean dark frame, counts;
    hot pixels replaced by their neighbours' median, then binned. Negative values are kept: they balance the
    noise."""
    raw: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    """Uint8 or uint16: the first frame as the camera gave it."""
    exposure_ms: float
    saturated_pixels: int
    """Pixels at full scale in any frame, hot ones excepted."""
    run: Run
    scatter: Scatter = STEADY
    """Of the frames; where they shook they were put onto one another."""
    ambient: float = 0.0
    """Share of its mean light by which the last dark frames are brighter than the first."""

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong with light and place, in words; its brightness is its own."""
        return photograph_findings([self])


def photograph_findings(taken: Sequence[Photograph]) -> tuple[str, ...]:
    """Return what is wrong with light and place of photographs whose brightness is each one's own.

    Light that flickers is said only where it saturated a frame.
    """
    scatter = pooled([one.scatter for one in taken])
    if not any(one.saturated_pixels for one in taken):
        scatter = replace(scatter, flicker=0.0)
    other = max((one.ambient for one in taken), key=abs)
    return (*scatter.findings("photograph"), *ambient_findings(other))


def photograph_plan(exposure_ms: float, average: int, dark_frames: int) -> Plan:
    """Return the plan of a photograph: the lit scene, and dark frames, half of them before it."""
    late = dark_frames - dark_frames // 2
    first, last = (
        (Part(label=DARK, light=(OFF,), exposures_ms=(exposure_ms,), repeats=n),) if n else ()
        for n in (dark_frames - late, late)
    )
    lit = Part(label="scene", scene_lit=True, exposures_ms=(exposure_ms,), repeats=average)
    return Plan(label="photograph", parts=(*first, lit, *last))


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
        Told of each step and frame.

    Returns
    -------
    Photograph
        ``measurement`` float32, (height, width[, 3]), counts less the dark frames'; its run and exposure.

    Raises
    ------
    CalibrationError
        When the run was ended before its last frame; others as :func:`instrument.runs.acquire.acquire`.
    """
    require_argument("bench", bench, Bench, "'with db.bench() as bench:' opens one.")
    require_argument("exposure_ms", exposure_ms, float | None, above=0)
    require_argument("average", average, int, least=1)
    require_argument("dark_frames", dark_frames, int, least=1)
    require_argument("binning", binning, int, least=1)
    require_whereabouts(folder, control, listener)
    control, listener = control or RunControl(), listener or Listener()
    if exposure_ms is None:
        listener.step("finding the scene's exposure")
        exposure_ms = expose_scene(bench).exposure_ms
        control.check()
    listener.step("photographing")
    plan = photograph_plan(exposure_ms, average, dark_frames)
    return photograph_of(
        completed(acquire(bench, plan, folder, on_progress=listener.frame, control=control)), binning
    )


def photograph_of(run: Run, binning: int = 1) -> Photograph:
    """Return the measurement that a complete run of :func:`photograph_plan` gives, binned in software."""
    frames = run.images("scene")
    dark = dark_model(run)
    steady = light_frames(frames, dark.at(run.metadata(0).exposure_ms), dark.hot)
    binned = block_mean(channels_first(steady.mean), binning)
    saturated = (frames >= full_scale(run)).any(axis=0) & ~dark.hot
    ambient = dark.brightening_per_ms * run.metadata(0).exposure_ms / max(float(steady.mean.mean()), 1e-9)
    return Photograph(
        measurement=np.ascontiguousarray(np.moveaxis(binned, 0, -1)) if frames.ndim == 4 else binned[0],
        raw=frames[0],
        exposure_ms=run.metadata(0).exposure_ms,
        saturated_pixels=int(np.count_nonzero(saturated)),
        run=run,
        scatter=steady.scatter,
        ambient=ambient,
    )


# Procedure -------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class PhotographRecord:
    """How a photograph is made of its run's frames."""

    bench: str
    simulated: bool
    binning: int


PHOTOGRAPH = Purpose(
    PhotographRecord,
    "photograph_run.json",  # photograph.json would be the record of a reconstruction of that name
    PHOTOGRAPH_FILE,
    RecordFormat(
        "diffuserbench photograph",
        "run of calibrate photograph",
        restore="The frames beside it stay.",
    ),
)


def _finish(run: Run, _bench: Bench | None, _control: RunControl, _listener: Listener) -> Outcome:
    """Write the picture that ``reconstruct`` takes into the folder of a complete run."""
    record = PHOTOGRAPH.read(run.path)
    taken = photograph_of(run, record.binning)
    good = taken.saturated_pixels == 0 and not taken.findings
    file = PHOTOGRAPH.place(run.path, doubted=not good)
    first = run.metadata(run.steps("scene")[0])
    facts = {"exposure_ms": taken.exposure_ms, "dark": "taken off", "scatter": taken.scatter}
    facts |= {"light": "scene", "utc": first.utc}
    if record.binning == 1:  # binned, a mosaic's colours are mixed
        facts["pixel_format"] = first.pixel_format
    write_image(file, taken.measurement, plain(record) | plain(facts))
    words = f"Photograph: {taken.exposure_ms:.4g} ms, {taken.saturated_pixels} saturated pixels"
    return Outcome(
        verdict=(*(f"Quality: {finding}" for finding in taken.findings), words),
        good=good,
        runs=(run.path,),
        files=(file,),
        result=taken,
    )


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
        exposure_ms = self.exposure_ms
        if exposure_ms is None:
            listener.step("finding the scene's exposure")
            exposure_ms = expose_scene(bench).exposure_ms
            control.check()
        listener.step("photographing")
        plan = photograph_plan(exposure_ms, self.average, self.dark_frames)
        record = PhotographRecord(bench.label, bool(bench.simulated_kinds), self.binning)
        runner = PHOTOGRAPH.prepare(bench, plan, folder, record, control, listener)
        return _finish(completed(runner.execute()), bench, control, listener)


ROUTINES = (
    Routine(
        name="photograph",
        title="Photograph of the scene",
        help="Photograph the lit scene as a reconstruction wants it: well exposed, dark frames taken off.",
        details="Finds the exposure at which nothing saturates unless one is given. Writes photograph.tif "
        "into the run's folder.",
        options=PhotographProcedure,
        procedure=lambda options: options,
        purpose=PHOTOGRAPH,
        finish=_finish,
        examples=("diffuserbench calibrate photograph", "diffuserbench calibrate photograph --binning 2"),
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
