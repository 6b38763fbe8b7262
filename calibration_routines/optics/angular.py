"""Angular response of the sensor, measured by moving the point source (Kuo 2020, Figs. 3.5 and 4.3b).

The source is carried sideways at one distance; its pattern moves over the sensor and is cut by its edge. For
each place the light received is compared with that of the source on the axis, moved to the same place on the
sensor: pixel by pixel only what both show is summed. Two known factors are taken out, the aperture's smaller
solid angle seen from the side and the source's own directivity. What remains is the pixels' response.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from calibration_routines.errors import CalibrationError, RunEndedError
from calibration_routines.optics.angular_response import AngularResponse, Curve, save_response
from calibration_routines.psf.analysis import DarkModel, replace_hot
from calibration_routines.psf.exposure import SweepExposures, expose_sweep
from calibration_routines.psf.stage_fit import Drift, judge_drift
from calibration_routines.psf.sweep_plan import (
    DARK,
    PSF,
    REFERENCE,
    PointSweep,
    Position,
    check_sweep,
    sweep_plan,
)
from instrument.bench.bench import Bench
from instrument.files.atomic import write_text
from instrument.files.errors import BenchError, SettingsError
from instrument.plan import Plan
from instrument.runs.acquire import prepare
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import RunControl
from instrument.runs.runner import RunProgress
from recon.camera.registration import Registration, aligned, expected_shift, register

Emission = Literal["pinhole", "bead"]
_POWER: dict[Emission, float] = {"pinhole": 4.0, "bead": 3.0}
"""Cosines in the light through the aperture: three of its solid angle, one of a flat source that faces it."""
LEAST_SEEN = 0.08
"""Part of the pattern's light that must still fall onto the sensor for an angle to be measured."""
MOST_STEPS = 300
"""More angles to one side of an axis are a mistake."""
RESPONSE_FILE = "angular_response.json"
ANGULAR_FILE = "angular.json"
"""In the run's folder: what its frames are for."""
_REACH_MARGIN = 0.98  # of the stage's travel
_SMOOTH_PX, _SUPPORT = 6.0, 0.05  # the pattern is where its smoothed light is above this part of its maximum
_NEAR_PX = 40.0  # about where the stage says, the pattern is looked for

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AngularSweep:
    """What is measured.

    Attributes
    ----------
    z_um : float
        Distance of the source's plane from the diffuser.
    largest_deg, step_deg : float
        Angles measured to both sides along x and y.
    emission : {"pinhole", "bead"}
        A flat source that faces the sensor, or one that glows alike in all directions.
    average, dark_frames : int
    """

    z_um: float
    largest_deg: float = 45.0
    step_deg: float = 3.0
    emission: Emission = "pinhole"
    average: int = 4
    dark_frames: int = 4

    def __post_init__(self) -> None:
        problems = []
        if not 0 < self.z_um < np.inf:
            words = (
                f"the source stands in front of the diffuser, at a finite z > 0, not {self.z_um / 1e3:g} mm"
            )
            problems.append(("z_um", words))
        if not 0 < self.step_deg <= self.largest_deg < 80:
            problems.append(
                (
                    "step_deg" if 0 < self.largest_deg < 80 else "largest_deg",
                    f"0 < step <= largest angle < 80 degrees, not {self.step_deg:g} and {self.largest_deg:g}",
                )
            )
        elif self.largest_deg / self.step_deg > MOST_STEPS:
            problems.append(
                (
                    "step_deg",
                    f"steps of {self.step_deg:g} degrees up to {self.largest_deg:g} are more than "
                    f"{MOST_STEPS}: choose larger steps",
                )
            )
        if self.emission not in _POWER:
            problems.append(("emission", f"emission is pinhole or bead, not {self.emission!r}"))
        problems += [
            (name, f"{name} must be at least 1, not {getattr(self, name)}")
            for name in ("average", "dark_frames")
            if getattr(self, name) < 1
        ]
        if problems:
            raise SettingsError(problems)

    @property
    def angles_deg(self) -> tuple[float, ...]:
        """Angles above zero."""
        number = int(np.floor(self.largest_deg / self.step_deg + 1e-9))
        return tuple(self.step_deg * (k + 1) for k in range(number))

    def points(self) -> PointSweep:
        """Return the places of the source: the axis, then outwards along x and along y."""
        axis: Position = (0.0, 0.0, self.z_um)
        points = [axis]
        for along in (0, 1):
            for sign in (1.0, -1.0):
                for angle in self.angles_deg:
                    away = round(float(sign * self.z_um * np.tan(np.deg2rad(angle))), 3)
                    points.append((away, 0.0, self.z_um) if along == 0 else (0.0, away, self.z_um))
        return PointSweep(tuple(points), kind="angular", average=self.average, dark_frames=self.dark_frames)


def farthest_um(bench: Bench, largest_deg: float) -> float:
    """Return the largest distance from which the stage's travel spans ``+-largest_deg`` along x and y.

    The farther the source, the narrower the range of angles within the aperture.

    Raises
    ------
    BenchError
        When there is no stage, or even its nearest distance is too far for the angle.
    """
    reach, (low, high) = _reach(bench)
    z_um = min(_REACH_MARGIN * reach / float(np.tan(np.deg2rad(largest_deg))), high)
    if not z_um > max(low, 0.0):
        raise BenchError(
            f"The stage reaches +-{reach / 1e3:.4g} mm and no nearer than {low / 1e3:.4g} mm: "
            f"+-{largest_deg:g} degrees are out of its reach. Choose a smaller angle."
        )
    return float(z_um)


def check_angular(bench: Bench, sweep: AngularSweep, folder: Path | None = None) -> Plan:
    """Refuse what is out of the stage's reach or does not fit the disk, before anything moves; the plan.

    Raises
    ------
    BenchError
        When the stage does not reach so far; says which angle it reaches from there.
    PlanError
        When something else of the plan cannot be done.
    """
    reach, (low, high) = _reach(bench)
    z_um = sweep.z_um
    if not low <= z_um <= high:
        raise BenchError(
            f"The source at z = {z_um / 1e3:.4g} mm is outside the stage's limits {low / 1e3:.4g} to "
            f"{high / 1e3:.4g} mm. Choose a distance between them, or leave --z out."
        )
    needed = z_um * float(np.tan(np.deg2rad(sweep.angles_deg[-1])))
    if needed > reach:
        reached = np.floor(np.rad2deg(np.arctan(reach / z_um)))
        raise BenchError(
            f"+-{sweep.angles_deg[-1]:g} degrees from z = {z_um / 1e3:.4g} mm are +-{needed / 1e3:.4g} mm, "
            f"outside the stage's limits of +-{reach / 1e3:.4g} mm: choose --largest {reached:g} at most, a "
            "nearer --z, or leave --z out for the farthest that spans the angles."
        )
    return check_sweep(bench, sweep.points(), folder)


def _reach(bench: Bench) -> tuple[float, tuple[float, float]]:
    """Return how far the source goes to both sides along x and y, and its nearest and farthest z."""
    if bench.stage is None:
        raise BenchError(f"{bench.config.label} has no [stage]: the angular response needs one.")
    limits, offset = bench.stage.limits, bench.config.source.offset_um
    reach = []
    for k, axis in enumerate(("x_um", "y_um")):
        low, high = limits.get(axis, (0.0, 0.0))
        reach.append(min(high + offset[k], -(low + offset[k])))
    low, high = (end + offset[2] for end in limits.get("z_um", (-offset[2], -offset[2])))
    return min(reach), (low, high)


def measure_angular_response(
    bench: Bench,
    sweep: AngularSweep,
    folder: Path | str | None = None,
    *,
    on_progress: RunProgress | None = None,
    on_exposures: Callable[[SweepExposures], None] | None = None,
    control: RunControl | None = None,
) -> tuple[AngularResponse, Path]:
    """Move the source, measure the response, save it in the run's folder as ``angular_response.json``.

    Parameters
    ----------
    bench : Bench
        Open, its stage homed.
    sweep : AngularSweep
    folder : path, optional
        Where the run's folder is made; the bench's data folder by default.
    on_progress, on_exposures : callable, optional
    control : RunControl, optional
        To pause, abort or stop the run from another thread.

    Returns
    -------
    response : AngularResponse
    file : Path

    Raises
    ------
    PlanError
        When a place is out of reach; nothing moved.
    CalibrationError
        When no exposure is usable, the run ended early, or too little can be seen.
    """
    where = Path(folder) if folder is not None else None
    points = sweep.points()
    geometry = bench.geometry
    if geometry.diffuser_distance_mm is None or geometry.pixel_pitch_um is None:
        raise BenchError(
            "The angles on the sensor follow from diffuser_distance_mm and pixel_pitch_um: give them in "
            "[geometry] of bench.toml."
        )
    check_angular(bench, sweep, where)
    exposures = expose_sweep(bench, points, control=control)
    if on_exposures is not None:
        on_exposures(exposures)
    plan = sweep_plan(points, exposures.exposures_ms)
    runner = prepare(bench, plan, where, on_progress=on_progress, control=control)
    record = {
        "sweep": asdict(sweep),
        "geometry": asdict(geometry),
        "bench": bench.label,
        "simulated": bool(bench.simulated_kinds),
    }
    write_text(runner.path / ANGULAR_FILE, json.dumps(record, indent=1) + "\n")
    return finish_angular(runner.execute())


def finish_angular(run: Run) -> tuple[AngularResponse, Path]:
    """Compute the response from a complete run, e.g. one that was resumed, and save it in its folder.

    Raises
    ------
    CalibrationError
        When the run is none of the angular response's, is not complete, or too little can be seen.
    """
    sweep, geometry, bench, simulated = _read_record(run.path)
    if run.condition is not RunCondition.COMPLETED:
        raise RunEndedError("The run", run)
    points = sweep.points()
    drift = _drift(run, points)
    images = _images(run, points, drift)
    response = analyse_angular(
        images,
        points.points_um,
        pitch_um=geometry["pixel_pitch_um"],
        distance_um=1e3 * geometry["diffuser_distance_mm"],
        emission=sweep.emission,
        findings=() if drift is None else drift.findings,
        bench=bench,
        simulated=simulated,
    )
    return response, save_response(response, run.path / RESPONSE_FILE)


def is_angular(run: Path) -> bool:
    """Whether a run's frames are those of an angular response."""
    return (run / ANGULAR_FILE).is_file()


def _read_record(run: Path) -> tuple[AngularSweep, dict[str, float], str, bool]:
    path = run / ANGULAR_FILE
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        names = ("pixel_pitch_um", "diffuser_distance_mm")
        geometry = {name: float(data["geometry"][name]) for name in names}
        return AngularSweep(**data["sweep"]), geometry, str(data["bench"]), bool(data["simulated"])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path} cannot be read ({error}): the run is none of calibrate angular, or the file was "
            "changed. The frames beside it are not touched."
        ) from error


def analyse_angular(
    images: Sequence[npt.NDArray[np.float32]],
    points_um: Sequence[Position],
    *,
    pitch_um: float,
    distance_um: float,
    emission: Emission = "pinhole",
    findings: Sequence[str] = (),
    bench: str = "",
    simulated: bool = False,
) -> AngularResponse:
    """Compute the response from images of the source at places along x and y.

    Parameters
    ----------
    images : sequence of ndarray, float32, (height, width)
        Light at one common exposure, dark frame subtracted; the first with the source on the axis.
    points_um : sequence of (x, y, z)
    pitch_um, distance_um : float
        Of the pixels; from diffuser to sensor.
    emission : {"pinhole", "bead"}
    findings, bench, simulated
        Kept with the result.

    Raises
    ------
    CalibrationError
        When fewer than three angles along x or y could be measured.
    """
    axis_image = np.asarray(images[0], np.float64)
    axis_bare = axis_image / _geometric(points_um[0], axis_image.shape, pitch_um, distance_um, emission)
    measured: dict[str, list[tuple[float, float, float]]] = {"x": [], "y": []}
    for image, point in zip(images[1:], points_um[1:], strict=True):
        found = _compare(image, images[0], axis_bare, point, points_um[0], pitch_um, distance_um, emission)
        if found is not None:
            measured["x" if point[0] != points_um[0][0] else "y"].append(found)
    curves = {}
    for along, rows in measured.items():
        if len(rows) < 3:
            raise CalibrationError(
                f"Only {len(rows)} angles along {along} could be measured: the pattern leaves the sensor. "
                "Use smaller steps."
            )
        rows = sorted([*rows, (0.0, 1.0, 1.0)])
        angles, values, seen = (tuple(column) for column in zip(*rows, strict=True))
        curves[along] = Curve(angles, values, seen)
    return AngularResponse(curves["x"], curves["y"], tuple(findings), bench, simulated)


def _compare(
    image: npt.NDArray[np.float32],
    axis_image: npt.NDArray[np.float32],
    axis_bare: Floats,
    point: Position,
    origin: Position,
    pitch_um: float,
    distance_um: float,
    emission: Emission,
) -> tuple[float, float, float] | None:
    """Return ``(angle, response, seen)`` of one place, or None when too little of its pattern is seen."""
    here, there = (expected_shift(p, distance_um, pitch_um) for p in (point, origin))
    near = here[0] - there[0], here[1] - there[1]
    if _part_seen(axis_bare, near) < LEAST_SEEN:
        return None  # nothing but noise may be left, in which a pattern would be found by chance
    found = register(image, axis_image, near=near, within_px=_NEAR_PX)
    if not found.reliable:  # too little is seen to tell; the stage knows well enough for a sum over pixels
        found = _by_stage(found, near)
    expected = _displaced(axis_bare, (found.rows, found.columns))
    seen = float(expected.sum(dtype=np.float64) / axis_bare.sum())
    if seen < LEAST_SEEN:
        return None
    weight = expected * _geometric(point, image.shape, pitch_um, distance_um, emission)
    smooth = ndimage.gaussian_filter(expected, _SMOOTH_PX)
    support = smooth > _SUPPORT * float(ndimage.gaussian_filter(axis_bare, _SMOOTH_PX).max())
    angle = _tangent(point, image.shape, pitch_um, distance_um)
    mean = float((weight[support] * angle[support]).sum() / weight[support].sum())
    ratio = float(image[support].sum(dtype=np.float64) / weight[support].sum(dtype=np.float64))
    return float(np.rad2deg(np.arctan(mean))), ratio, seen


def _geometric(
    point: Position, shape: tuple[int, ...], pitch_um: float, distance_um: float, emission: Emission
) -> Floats:
    """Light from the source on each pixel without any response: a power of the ray's cosine."""
    tangents = _tangents(point, shape, pitch_um, distance_um)
    return np.asarray((1 + tangents[0] ** 2 + tangents[1] ** 2) ** (-0.5 * _POWER[emission]))


def _tangent(point: Position, shape: tuple[int, ...], pitch_um: float, distance_um: float) -> Floats:
    """Signed tangent of the incidence along the axis on which the source was moved, (height, width)."""
    y, x = _tangents(point, shape, pitch_um, distance_um)
    return -np.broadcast_to(x if abs(point[0]) >= abs(point[1]) else y, shape)


def _tangents(
    point: Position, shape: tuple[int, ...], pitch_um: float, distance_um: float
) -> tuple[Floats, Floats]:
    """Tangents of the straight ray from the source to each pixel, along y (h, 1) and x (1, w)."""
    x, y, z = point
    rows, columns = (np.asarray((np.arange(n) - (n - 1) / 2) * pitch_um, np.float64) for n in shape)
    tan_y, tan_x = (rows[:, None] - y) / (z + distance_um), (columns[None, :] - x) / (z + distance_um)
    return np.asarray(tan_y, np.float64), np.asarray(tan_x, np.float64)


def _by_stage(found: Registration, shift: tuple[float, float]) -> Registration:
    return replace(found, rows=shift[0], columns=shift[1])


def _displaced(image: Floats, shift: tuple[float, float]) -> npt.NDArray[np.float32]:
    """Move an image by ``(rows, columns)``; aligned() takes a displacement back, so it gets the opposite."""
    return aligned(image.astype(np.float32), Registration(-shift[0], -shift[1], 1.0, 1.0, 1.0))


def _part_seen(image: Floats, shift: tuple[float, float]) -> float:
    """Return the part of an image's light that is left when it is displaced."""
    return float(_displaced(image, shift).sum(dtype=np.float64) / image.sum())


# Frames to light ---------------------------------------------------------------------------------------
def _images(run: Run, points: PointSweep, drift: Drift | None) -> list[npt.NDArray[np.float32]]:
    """Return the light of every point at the first point's exposure, the source's drift taken out."""
    dark = _dark(run)
    taken: dict[Position, list[int]] = {}
    for step in run.steps(PSF):
        if step.source_um is not None:
            taken.setdefault(step.source_um, []).append(step.index)
    reference_ms = run.metadata(taken[points.points_um[0]][0]).exposure_ms
    images = []
    for point in points.points_um:
        exposure_ms = run.metadata(taken[point][0]).exposure_ms
        brightness = 1.0
        if drift is not None:
            brightness = drift.brightness_at(
                (run.metadata(taken[point][0]).utc - _began(run)).total_seconds()
            )
        images.append(_light(run, taken[point], dark) * np.float32(reference_ms / exposure_ms / brightness))
    return images


def _light(run: Run, indices: Sequence[int], dark: DarkModel) -> npt.NDArray[np.float32]:
    mean = np.mean([run.frame(index) for index in indices], axis=0, dtype=np.float32)
    light = replace_hot(mean - dark.at(run.metadata(indices[0]).exposure_ms), dark.hot)
    return np.asarray(light.mean(axis=-1) if light.ndim == 3 else light, np.float32)


def _dark(run: Run) -> DarkModel:
    steps: dict[float, list[int]] = {}
    for step in run.steps(DARK):
        steps.setdefault(run.metadata(step).exposure_ms, []).append(step.index)
    full_scale = (1 << run.metadata(0).significant_bits) - 1
    stacks = [np.stack([run.frame(index) for index in indices]) for indices in steps.values()]
    return DarkModel(list(steps), stacks, full_scale)


def _began(run: Run) -> datetime:
    """Return when the reference was visited first."""
    return run.metadata(run.steps(REFERENCE)[0]).utc


def _drift(run: Run, points: PointSweep) -> Drift | None:
    dark = _dark(run)
    visits: dict[int, list[int]] = {}
    for step in run.steps(REFERENCE):
        visits.setdefault(step.part, []).append(step.index)
    images = [_light(run, indices, dark) for indices in visits.values()]
    if len(images) < 2:
        return None
    total = len(points.points_um)
    before = [min(k * points.reference_every, total) for k in range(len(images))]
    times = [run.metadata(indices[0]).utc for indices in visits.values()]
    seconds = [(time - _began(run)).total_seconds() for time in times]
    return judge_drift(images, before, total, seconds)
