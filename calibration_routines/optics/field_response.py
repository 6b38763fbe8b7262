"""How bright the camera sees a source off its axis, measured by moving it (Kuo 2020, Fig. 3.5).

The convolution model gives every direction the same PSF, so a photograph comes out darker towards its edges:
less light passes the aperture and the pixels take less of what arrives at an angle. For objects far from the
camera this is a factor on the picture (Kuo 2020, Sec. 5.1), and it can be divided out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration_routines.procedure import Listener
from calibration_routines.psf.analysis import ambient_findings, dark_model, drift_of, images_of
from calibration_routines.psf.psf_quality import MAX_CLIPPED, measure_psf
from calibration_routines.psf.sampling import Position
from calibration_routines.psf.sweep_options import PointSweep
from calibration_routines.psf.sweep_plan import PSF, sweep_plan
from calibration_routines.purpose import CalibrationError, completed
from instrument.bench.bench import Bench
from instrument.runs.acquire import acquire
from instrument.runs.run import Run
from recon.arrays import Float32Array

_KIND = "field response"
_THEN = "The response of all its frames: calibration_routines.field_response_of(RUN)."


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

    def __call__(self, tan_y: npt.NDArray[np.floating], tan_x: npt.NDArray[np.floating]) -> Float32Array:
        """Return the response in a direction given by its tangents (broadcast against each other)."""
        return np.exp(-(self.along_x * tan_x**2 + self.along_y * tan_y**2)).astype(np.float32)

    def on_grid(
        self,
        shape: tuple[int, int],
        sensor_pitch_um: float,
        diffuser_distance_um: float,
        *,
        lambertian: bool = False,
    ) -> Float32Array:
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

    Raises PlanError when a place is out of reach (nothing moved); RunEndedError when the run ended early, of
    which :func:`field_response_of` gives the response once ``diffuserbench resume`` has taken the rest;
    others as that.
    """
    half_y, half_x = half_field_um
    places = (
        (0.0, 0.0, z_um),
        (half_x, 0.0, z_um),
        (0.0, half_y, z_um),
        (-half_x, 0.0, z_um),
        (0.0, -half_y, z_um),
    )
    sweep = PointSweep(points_um=places, kind=_KIND, average=average, dark_frames=2 * average)
    plan = sweep_plan(sweep, [exposure_ms] * len(places))
    try:
        run = acquire(bench, plan, folder, on_progress=None if listener is None else listener.frame)
    except BaseException as error:
        if getattr(error, "__notes__", ()):  # a run was begun
            error.add_note(_THEN)
        raise
    return field_response_of(run)


def field_response_of(run: Run | Path | str) -> FieldResponse:
    """Return the response that the frames of a complete run of :func:`measure_field_response` give.

    Raises CalibrationError when the sensor's edge cuts the pattern at one of the places, the light flickers
    too much for what was averaged, other light comes, the last visit to the centre disagrees with the first,
    or the run is of something else or ended early; RunError when it is no run.
    """
    run = run if isinstance(run, Run) else Run.open(run)
    if run.label != f"{_KIND} sweep":
        raise CalibrationError(
            f"{run.path} is a run named {run.label!r}: a response over the field is had of a {_KIND} sweep, "
            "which measure_field_response takes."
        )
    run = completed(run, remedy=f"To take the rest: diffuserbench resume {run.path}. {_THEN}")
    points = tuple(dict.fromkeys(step.source_um for step in run.steps(PSF) if step.source_um is not None))
    sweep = PointSweep(points_um=points, kind=_KIND)
    dark = dark_model(run)
    drift = drift_of(run, sweep, dark)
    images, scatter = images_of(run, sweep, dark, drift)
    for place, image in zip(points, images, strict=True):
        _require_whole(image, place)
    steady_place = replace(scatter, motion_px=0.0)  # all light is summed, wherever it falls
    ambient = dark.brightening_per_ms * run.metadata(run.steps(PSF)[0]).exposure_ms
    other = ambient_findings(ambient / max(float(images[0].mean()), 1e-9))
    moved = () if drift is None else drift.findings
    if findings := (*steady_place.findings("place"), *other, *moved):
        raise CalibrationError(f"The response over the field cannot be measured: {' '.join(findings)}")
    return fit_field_response(points, [float(image.sum(dtype=np.float64)) for image in images])


def _require_whole(light: Float32Array, place: Position) -> None:
    clipped = measure_psf(light[np.newaxis], z_um=place[2], noise=0.0).clipped
    if clipped > MAX_CLIPPED:
        raise CalibrationError(
            f"With the source at x = {place[0] / 1e3:g}, y = {place[1] / 1e3:g} mm the pattern reaches over "
            f"{clipped:.0%} of the sensor's edge, so its light cannot be measured: choose a smaller field."
        )
