"""Angular response of the sensor, measured by moving the point source (Kuo 2020, Figs. 3.5 and 4.3b).

The source is carried sideways at one distance; its pattern moves over the sensor and is cut by its edge. For
each place the light received is compared with that of the source on the axis, moved to the same place on the
sensor: pixel by pixel only what both show is summed. Two known factors are taken out, the aperture's smaller
solid angle seen from the side and the source's own directivity. What remains is the pixels' response.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration_routines.optics.angular_response import (
    EMISSIONS,
    Emission,
    analyse_angular,
    response_figure,
    response_lines,
    save_response,
)
from calibration_routines.options import MM, Checked
from calibration_routines.planned import home_if_needed, outlook_of
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.analysis import ambient_findings, dark_model, drift_of, images_of
from calibration_routines.psf.sampling import Position, known, source_limits
from calibration_routines.psf.sweep_options import PointSweep
from calibration_routines.psf.sweep_plan import PSF, check_sweep, expose_sweep, sweep_plan
from calibration_routines.purpose import Purpose, completed
from calibration_routines.routine import Routine
from instrument.bench.bench import Bench
from instrument.files.errors import BenchError, SettingsError
from instrument.files.figures import save_figure
from instrument.files.record import RecordFormat
from instrument.plan import Plan
from instrument.runs.results import ANGULAR_FILE
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.base.declare import RARE, option
from recon.types import Geometry

LEAST_STEPS = 2
"""To one side of an axis: of fewer angles no curve is made."""
MOST_STEPS = 300
"""More angles to one side of an axis are a mistake."""
_REACH_MARGIN = 0.98  # of the stage's travel
_WIDE = 0.25  # of a step: a source that smooths the response


@dataclass(frozen=True)
class AngularSweep(Checked):
    """What is measured."""

    z_um: float | None = option(
        None,
        **MM,
        flags=("--z",),
        above=0,
        label="Distance",
        help="Distance of the source's plane from the diffuser.",
        default_words="the farthest that spans the angles",
    )
    largest_deg: float = option(
        45.0,
        unit="deg",
        above=0,
        below=80,
        flags=("--largest",),
        label="Largest angle",
        help="Largest angle, to both sides along x and y.",
    )
    step_deg: float = option(3.0, unit="deg", above=0, flags=("--step",), help="Between angles.")
    emission: Emission = option(
        "pinhole",
        choices=EMISSIONS,
        label="Source",
        help="A flat pinhole that faces the sensor, or a fluorescent bead that glows alike everywhere.",
    )
    average: int = option(4, least=1, label="Frames a place", help="Frames a place, averaged.")
    dark_frames: int = option(4, least=1, help="Dark frames, at two exposures each.", group=RARE)

    ends_deg: tuple[float, float] | None = None
    """Along x and y: the pattern leaves the sensor beyond; None where that is not known."""

    def disagreements(self, wrong: Collection[str]) -> list[tuple[str, str]]:
        """As :meth:`Checked.disagreements`."""
        if wrong or self.step_deg <= self.largest_deg <= MOST_STEPS * self.step_deg:
            return []
        words = f"0 < step <= largest angle, not {self.step_deg:g} and {self.largest_deg:g}"
        if self.step_deg <= self.largest_deg:
            words = (
                f"steps of {self.step_deg:g} degrees up to {self.largest_deg:g} are more than {MOST_STEPS}: "
                "choose larger steps"
            )
        return [("step_deg", words)]

    def planned(self, bench: Bench) -> AngularSweep:
        """Return the sweep with its distance filled in, and where the pattern leaves the sensor."""
        seen = replace(self, ends_deg=pattern_ends_deg(bench))
        if self.z_um is not None:
            return seen
        return replace(seen, z_um=farthest_um(bench, max(max(seen.angles_deg(along)) for along in (0, 1))))

    def angles_deg(self, along: int) -> tuple[float, ...]:
        """Angles above zero along x (0) or y (1), one at least."""
        end = self.largest_deg if self.ends_deg is None else min(self.ends_deg[along], self.largest_deg)
        number = max(1, int(np.floor(end / self.step_deg + 1e-9)))
        return tuple(self.step_deg * (k + 1) for k in range(number))

    @property
    def distance_um(self) -> float:
        """The distance, which must have been given or filled in."""
        if self.z_um is None:
            raise SettingsError(
                [("z_um", "the distance was left to the bench: take what planned(bench) returns")]
            )
        return self.z_um

    def points(self) -> PointSweep:
        """Return the places of the source: the axis, then outwards along x and along y."""
        z_um = self.distance_um
        axis: Position = (0.0, 0.0, z_um)
        points = [axis]
        for along in (0, 1):
            for sign in (1.0, -1.0):
                for angle in self.angles_deg(along):
                    away = round(float(sign * z_um * np.tan(np.deg2rad(angle))), 3)
                    points.append((away, 0.0, z_um) if along == 0 else (0.0, away, z_um))
        return PointSweep(
            points_um=tuple(points), kind="angular", average=self.average, dark_frames=self.dark_frames
        )


_SEEN = 0.05  # part of the pattern's side that is still on the sensor at the last place


def pattern_ends_deg(bench: Bench) -> tuple[float, float] | None:
    """Return the angles along x and y at which the pattern of a far source leaves the sensor.

    None where pitch, d or aperture is not known.
    """
    geometry, shape = bench.geometry, bench.camera.frame_shape
    pitch_um, d_mm, aperture_mm = geometry.pixel_pitch_um, geometry.diffuser_distance_mm, geometry.aperture_mm
    if pitch_um is None or d_mm is None or aperture_mm is None:
        return None
    y, x = (
        float(np.rad2deg(np.arctan((0.5 * pixels * pitch_um * 1e-3 + (0.5 - _SEEN) * side_mm) / d_mm)))
        for pixels, side_mm in zip(shape[:2], aperture_mm, strict=True)
    )
    return x, y


def farthest_um(bench: Bench, largest_deg: float) -> float:
    """Return the largest distance from which the stage's travel spans ``+-largest_deg`` along x and y.

    The farther the source, the narrower the range of angles within the aperture.

    Raises BenchError when there is no stage, or even its nearest distance is too far for the angle.
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

    Raises BenchError when the stage does not reach so far (which angle it reaches is said); PlanError when
    something else of the plan cannot be done; SettingsError for too few angles to tell a response from.
    """
    reach, (low, high) = _reach(bench)
    z_um = sweep.distance_um
    if not low <= z_um <= high:
        raise BenchError(
            f"The source at z = {z_um / 1e3:.4g} mm is outside the stage's limits {low / 1e3:.4g} to "
            f"{high / 1e3:.4g} mm. Choose a distance between them, or leave --z out."
        )
    for along, name in enumerate("xy"):
        if len(sweep.angles_deg(along)) < LEAST_STEPS:
            end_deg = min(sweep.largest_deg, np.inf if sweep.ends_deg is None else sweep.ends_deg[along])
            seen = "" if end_deg == sweep.largest_deg else ", beyond which the pattern leaves the sensor,"
            words = f"steps of {sweep.step_deg:g} degrees up to {end_deg:.3g} along {name}{seen} are fewer"
            most_deg = np.floor(100 * end_deg / LEAST_STEPS) / 100  # rounded up it would be refused again
            words += f" than {LEAST_STEPS}: choose steps of {most_deg:g} degrees at most"
            raise SettingsError([("step_deg", words)])
    largest_deg = max(*sweep.angles_deg(0), *sweep.angles_deg(1))
    needed = z_um * float(np.tan(np.deg2rad(largest_deg)))
    if needed > reach:
        reached = np.floor(np.rad2deg(np.arctan(reach / z_um)))
        raise BenchError(
            f"+-{largest_deg:g} degrees from z = {z_um / 1e3:.4g} mm are +-{needed / 1e3:.4g} mm, "
            f"outside the stage's limits of +-{reach / 1e3:.4g} mm: choose --largest {reached:g} at most, a "
            "nearer --z, or leave --z out for the farthest that spans the angles."
        )
    return check_sweep(bench, sweep.points(), folder)


def _reach(bench: Bench) -> tuple[float, tuple[float, float]]:
    """Return how far the source goes to both sides along x and y, and its nearest and farthest z."""
    if bench.stage is None:
        raise BenchError(f"{bench.config.label} has no [stage]: the angular response needs one.")
    limits = source_limits(bench)
    reach = [min(high, -low) for low, high in (limits.get(axis, (0.0, 0.0)) for axis in ("x_um", "y_um"))]
    low, high = limits.get("z_um", (0.0, 0.0))
    return min(reach), (low, high)


@dataclass(frozen=True, slots=True)
class AngularRecord:
    """What the response is computed with besides the frames."""

    sweep: AngularSweep
    geometry: Geometry
    bench: str
    simulated: bool
    source_size_um: float | None = None


ANGULAR = Purpose(
    AngularRecord,
    "angular.json",
    ANGULAR_FILE,
    RecordFormat(
        "diffuserbench angular sweep",
        "run of calibrate angular",
        restore="The frames beside it are not touched.",
        unnamed_before=True,
    ),
)


def _finish(run: Run, _bench: Bench | None, _control: RunControl, listener: Listener) -> Outcome:
    """Compute the response from a complete run, and save it with its picture in its folder.

    Raises CalibrationError when too little can be seen.
    """
    listener.step("analysing")
    record = ANGULAR.read(run.path)
    points, dark = record.sweep.points(), dark_model(run)
    pitch_um, distance_mm = _optics(record.geometry)
    drift = drift_of(run, points, dark)
    images, scatter = images_of(run, points, dark, drift)
    ambient = dark.brightening_per_ms * run.metadata(run.steps(PSF)[0]).exposure_ms / float(images[0].mean())
    findings = (*scatter.findings("picture"), *ambient_findings(ambient))
    with ANGULAR.analysed(run.path):
        response = analyse_angular(
            images,
            points.points_um,
            pitch_um=pitch_um,
            distance_um=1e3 * distance_mm,
            emission=record.sweep.emission,
            findings=findings if drift is None else (*findings, *drift.findings),
            bench=record.bench,
            simulated=record.simulated,
        )
    response = replace(response, scatter=scatter)
    file = save_response(response, ANGULAR.place(run.path, doubted=bool(response.findings)))
    picture = file.with_suffix(".png")
    save_figure(response_figure(response), picture)
    return Outcome(
        verdict=(*response_lines(response), *_width_words(record)),
        good=not response.findings,
        runs=(run.path,),
        files=(file, picture),
        result=response,
    )


def _width_words(record: AngularRecord) -> tuple[str, ...]:
    """Return what is to be said of a source that is wide in angle; nothing of another, or an unknown one."""
    sweep = record.sweep
    width_deg = float(np.rad2deg(np.arctan((record.source_size_um or 0.0) / sweep.distance_um)))
    if width_deg <= _WIDE * sweep.step_deg:
        return ()
    return (
        f"Source: the pinhole is {width_deg:.2g} degrees wide from z = {sweep.distance_um / 1e3:.4g} mm "
        f"([source] size_um), steps are {sweep.step_deg:g}: the response is a mean over that width. Take a "
        "smaller one, or go farther away.",
    )


def _optics(geometry: Geometry) -> list[float]:
    """Return pixel pitch and the diffuser's distance; BenchError where they are not known."""
    return known(geometry, "pixel_pitch_um", "diffuser_distance_mm", what="The angles on the sensor follow")


# Procedure ---------------------------------------------------------------------------------------------
_COMPUTES = {"moving the source": (4.4, 2.2), "analysing": (19.0, 1.7)}
"""Transforms for each megapixel of a frame, compared and all (docs/benchmarks/time-told.md)."""


@dataclass(frozen=True, slots=True)
class AngularProcedure(Procedure):
    """Measure the sensor's angular response."""

    sweep: AngularSweep

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold every place against the stage's limits."""
        sweep = self.sweep.planned(bench)
        points = sweep.points()
        _optics(bench.geometry)
        plan = check_angular(bench, sweep, folder or bench.config.data_folder)
        reason = (
            f"{len(points.points_um)} places at z = {sweep.distance_um / 1e3:.4g} mm, up to "
            f"+-{sweep.angles_deg(0)[-1]:g} degrees along x and +-{sweep.angles_deg(1)[-1]:g} along y"
        )
        if sweep.ends_deg is not None and min(sweep.ends_deg) < sweep.largest_deg:
            reason += " (beyond, the pattern leaves the sensor)"
        given = self.sweep.z_um is not None
        farthest = "" if given else ", the farthest from which the stage spans the angles"
        return outlook_of(bench, plan, folder, [reason + farthest], computes=_COMPUTES)

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Home, move the source, and save the response with its picture in the run's folder."""
        sweep = self.sweep.planned(bench)
        points = sweep.points()
        home_if_needed(bench, listener)
        listener.step("finding exposures")
        exposures = expose_sweep(bench, points, control=control)
        listener.exposures(exposures)
        listener.step("moving the source")
        record = AngularRecord(
            sweep, bench.geometry, bench.label, bool(bench.simulated_kinds), bench.config.source.size_um
        )
        plan = sweep_plan(points, exposures.exposures_ms)
        runner = ANGULAR.prepare(bench, plan, folder, record, control, listener)
        return _finish(completed(runner.execute()), bench, control, listener)


ROUTINES = (
    Routine(
        name="angular",
        title="Angular response",
        help="Move the point source sideways and measure the sensor's angular response and its 20 % cut-off "
        "angles.",
        details="Writes angular_response.json (for the spacing of calibrate lateral and volume) and a "
        "picture into the run's folder.",
        options=AngularSweep,
        procedure=AngularProcedure,
        needs=("stage",),
        purpose=ANGULAR,
        finish=_finish,
        examples=(
            "diffuserbench calibrate angular --dry-run",
            "diffuserbench calibrate angular",
            "diffuserbench calibrate angular --largest 20 --step 2 --emission bead",
            "diffuserbench calibrate lateral --z 300 --response runs/..._angular-sweep/angular_response.json",
        ),
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
