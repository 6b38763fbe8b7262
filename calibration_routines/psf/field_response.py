"""How bright the camera sees a source off its axis: measured by moving the source (Kuo 2020, Fig. 3.5).

The convolution model gives every direction the same PSF, so a photograph comes out darker towards its edges:
less light passes the aperture and the pixels take less of what arrives at an angle. For objects far from the
camera this is a factor on the picture (Kuo 2020, Sec. 5.1), and it can be divided out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration_routines.procedure import CalibrationError, Listener, completed
from calibration_routines.psf.analysis import dark_model, light_of
from calibration_routines.psf.psf_quality import MAX_CLIPPED, measure_psf
from calibration_routines.psf.sweep_plan import DARK, PSF
from instrument.bench.bench import Bench
from instrument.plan import OFF, SOURCE, Part, Plan, SourcePoints
from instrument.runs.acquire import acquire
from instrument.runs.run import Run


@dataclass(frozen=True, slots=True)
class FieldResponse:
    """Light received relative to the axis: ``exp(-(a tan_x^2 + b tan_y^2))``.

    A Gaussian in the tangents describes obliquity and pixel response to second order in the angle.

    Attributes
    ----------
    along_x, along_y : float
        ``a`` and ``b``.
    largest_tangent : float
        Half the measured field; beyond it the response is a guess.
    misfit : float
        Largest relative departure of the measurements from the fit.
    """

    along_x: float
    along_y: float
    largest_tangent: float
    misfit: float

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
    """Fit the response to the total light of sources of equal intensity at one depth.

    Parameters
    ----------
    sources_um : sequence of (x, y, z)
        At least three, off axis in x and in y.
    light : sequence of float
        Total counts above dark for each.

    Raises
    ------
    CalibrationError
        When the places do not determine the fit or a source was not seen.
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

    Parameters
    ----------
    bench : Bench
        Open, its stage homed.
    half_field_um : (float, float)
        Half the field's height and width at ``z_um``.
    z_um : float
    exposure_ms : float
        One that does not saturate on the axis.
    folder : path, optional
        Where the run's folder is made; the bench's data folder by default.
    average : int
        Frames a place.
    listener : Listener, optional

    Raises
    ------
    PlanError
        When a place is out of reach; nothing moved.
    CalibrationError
        When the sensor's edge cuts the pattern at one of the places, or the run ended early.
    """
    half_y, half_x = half_field_um
    places = (
        (0.0, 0.0, z_um),
        (half_x, 0.0, z_um),
        (0.0, half_y, z_um),
        (-half_x, 0.0, z_um),
        (0.0, -half_y, z_um),
    )
    plan = Plan(
        label="field response",
        parts=(
            Part(label=DARK, light=(OFF,), exposures_ms=(exposure_ms,), repeats=average),
            Part(
                label=PSF,
                positions=SourcePoints(points_um=places),
                light=(SOURCE,),
                exposures_ms=(exposure_ms,),
                repeats=average,
                order=("position", "slm", "light", "exposure", "repeat"),
            ),
        ),
    )
    run = completed(acquire(bench, plan, folder, on_progress=None if listener is None else listener.frame))
    return fit_field_response(places, [_light(run, place) for place in places])


def _light(run: Run, place: tuple[float, float, float]) -> float:
    indices = [step.index for step in run.steps(PSF) if step.source_um == place]
    light = light_of(run, indices, dark_model(run))
    clipped = measure_psf(light[np.newaxis], z_um=place[2], noise=0.0).clipped
    if clipped > MAX_CLIPPED:
        raise CalibrationError(
            f"With the source at x = {place[0] / 1e3:g}, y = {place[1] / 1e3:g} mm the pattern reaches over "
            f"{clipped:.0%} of the sensor's edge, so its light cannot be measured: choose a smaller field."
        )
    return float(light.sum(dtype=np.float64))
