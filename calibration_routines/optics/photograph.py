"""Photograph a lit scene as the reconstruction wants it: well exposed, dark frame and hot pixels removed.

And how bright the camera sees a source off its axis, measured by moving it (Kuo 2020, Fig. 3.5). The
convolution model gives every direction the same PSF, so a photograph comes out darker towards its edges: less
light passes the aperture and the pixels take less of what arrives at an angle. For objects far from the
camera this is a factor on the picture (Kuo 2020, Sec. 5.1), and it can be divided out.
"""

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
    drift_of,
    full_scale,
    images_of,
    light_frames,
)
from calibration_routines.psf.exposure import expose_scene
from calibration_routines.psf.psf_quality import MAX_CLIPPED, measure_psf
from calibration_routines.psf.sampling import Position
from calibration_routines.psf.sweep_options import PointSweep
from calibration_routines.psf.sweep_plan import DARK, sweep_plan
from calibration_routines.purpose import CalibrationError, Purpose, completed
from calibration_routines.routine import Routine
from calibration_routines.scatter import STEADY, Scatter, pooled
from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.files.images import write_image
from instrument.files.record import RecordFormat, plain
from instrument.plan import OFF, Part, Plan, check
from instrument.runs.acquire import abilities_of, acquire
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.base.arguments import require_argument
from recon.base.blocks import block_mean
from recon.base.declare import RARE, option

PHOTOGRAPH_FILE = "photograph.tif"


@dataclass(frozen=True, slots=True)
class Photograph:
    """A measurement of a scene."""

    measurement: npt.NDArray[np.float32]
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

    Raises
    ------
    CalibrationError
        When the run was ended before its last frame; others as :func:`instrument.runs.acquire.acquire`.
    """
    require_argument("bench", bench, Bench, "'with db.bench() as bench:' opens one.")
    require_argument("exposure_ms", exposure_ms, float | None, above=0)
    require_argument("average", average, int, least=1)
    require_argument("dark_frames", dark_frames, int, least=0)
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


# Brightness over the field ----------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class FieldResponse:
    """Light received relative to the axis: ``exp(-(a tan_x^2 + b tan_y^2))``.

    A Gaussian in the tangents describes obliquity and pixel response to second order in the angle.
    """

    along_x: float
    along_y: float
    """``a`` and ``b``."""
    largest_tangent: float
    """Half the measured field; beyond it the response is a guess."""
    misfit: float
    """Largest relative departure of the measurements from the fit."""

    def __call__(
        self, tan_y: npt.NDArray[np.floating], tan_x: npt.NDArray[np.floating]
    ) -> npt.NDArray[np.float32]:
        """Return the response in a direction given by its tangents (broadcast against each other)."""
        return np.exp(-(self.along_x * tan_x**2 + self.along_y * tan_y**2)).astype(np.float32)

    def on_grid(
        self,
        shape: tuple[int, int],
        sensor_pitch_um: float,
        diffuser_distance_um: float,
        *,
        lambertian: bool = False,
    ) -> npt.NDArray[np.float32]:
        """Return the response on a reconstruction's grid, whose centre pixel ``n // 2`` is on the axis.

        ``lambertian`` adds what a flat screen has and the point source has not: it sends less light sideways,
        with the cosine of the angle.
        """
        tan_y, tan_x = ((np.arange(n) - n // 2) * sensor_pitch_um / diffuser_distance_um for n in shape)
        response = self(tan_y[:, np.newaxis], tan_x)
        if lambertian:
            response /= np.sqrt(1.0 + tan_y[:, np.newaxis] ** 2 + tan_x**2).astype(np.float32)
        return response


def fit_field_response(
    sources_um: Sequence[tuple[float, float, float]], light: Sequence[float]
) -> FieldResponse:
    """Fit the response to the total light of sources of equal intensity at one depth, counts above dark.

    They are at least three, off axis in x and in y. Raises CalibrationError when the places do not determine
    the fit or a source was not seen.
    """
    x, y, z = np.array(sources_um, np.float64).T
    counts = np.array(light, np.float64)
    if not (counts > 0).all():
        raise CalibrationError(
            "The source was not seen at every place of the field: bring the places nearer."
        )
    tan_x, tan_y = x / z, y / z
    design = np.stack([np.ones_like(x), -(tan_x**2), -(tan_y**2)], axis=1)
    if len(counts) < 3 or np.linalg.matrix_rank(design) < 3:
        raise CalibrationError("A field response needs at least three places, off axis in x and in y.")
    solution, *_ = np.linalg.lstsq(design, np.log(counts), rcond=None)
    misfit = np.abs(counts / np.exp(design @ solution) - 1.0).max()
    return FieldResponse(
        along_x=float(solution[1]),
        along_y=float(solution[2]),
        largest_tangent=float(np.hypot(tan_x, tan_y).max()),
        misfit=float(misfit),
    )


def measure_field_response(
    bench: Bench,
    half_field_um: tuple[float, float],
    z_um: float,
    exposure_ms: float,
    folder: Path | str | None = None,
    *,
    average: int = 2,
    listener: Listener | None = None,
) -> FieldResponse:
    """Move the source to the middle of the field's four edges and to its centre, and fit the light received.

    The centre is visited before and after: light that changes evenly meanwhile is taken out.

    Parameters
    ----------
    bench : Bench
        Open, its stage homed.
    half_field_um : (float, float)
        Half the field's height and width at ``z_um``.
    exposure_ms : float
        One that does not saturate on the axis.
    folder : path, optional
        Where the run's folder is made; the bench's data folder by default.
    average : int
        Frames a place.

    Raises PlanError when a place is out of reach (nothing moved); CalibrationError when the sensor's edge
    cuts the pattern at one of the places, the light flickers too much for what was averaged, other
    light comes, the last visit to the centre disagrees with the first, or the run ended early.
    """
    half_y, half_x = half_field_um
    places = (
        (0.0, 0.0, z_um),
        (half_x, 0.0, z_um),
        (0.0, half_y, z_um),
        (-half_x, 0.0, z_um),
        (0.0, -half_y, z_um),
    )
    sweep = PointSweep(points_um=places, kind="field response", average=average, dark_frames=2 * average)
    plan = sweep_plan(sweep, [exposure_ms] * len(places))
    run = completed(acquire(bench, plan, folder, on_progress=None if listener is None else listener.frame))
    dark = dark_model(run)
    drift = drift_of(run, sweep, dark)
    images, scatter = images_of(run, sweep, dark, drift)
    for place, image in zip(places, images, strict=True):
        _require_whole(image, place)
    steady_place = replace(scatter, motion_px=0.0)  # all light is summed, wherever it falls
    ambient = dark.brightening_per_ms * exposure_ms / max(float(images[0].mean()), 1e-9)
    moved = () if drift is None else drift.findings
    if findings := (*steady_place.findings("place"), *ambient_findings(ambient), *moved):
        raise CalibrationError(f"The response over the field cannot be measured: {' '.join(findings)}")
    return fit_field_response(places, [float(image.sum(dtype=np.float64)) for image in images])


def _require_whole(light: npt.NDArray[np.float32], place: Position) -> None:
    clipped = measure_psf(light[np.newaxis], z_um=place[2], noise=0.0).clipped
    if clipped > MAX_CLIPPED:
        raise CalibrationError(
            f"With the source at x = {place[0] / 1e3:g}, y = {place[1] / 1e3:g} mm the pattern reaches over "
            f"{clipped:.0%} of the sensor's edge, so its light cannot be measured: choose a smaller field."
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
