"""Measure point spread functions at many places: acquisition, analysis, retakes, and going on after a crash.

A sweep is a run like any other, with one file more in its folder: ``sweep.json`` says what the frames are
for. A run that was cut off is completed by ``resume`` and becomes a calibration by :func:`finish_sweep`, with
or without the bench.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.procedure import Listener, require_whereabouts
from calibration_routines.psf.analysis import (
    PlaneFrames,
    SweepAnalysis,
    analyse_sweep,
    binned,
    dark_model,
    drift_of,
    full_scale,
    light_of,
    optical_binning,
)
from calibration_routines.psf.mount_fit import MountFit
from calibration_routines.psf.psf_quality import PsfQuality, place_of
from calibration_routines.psf.sampling import Position
from calibration_routines.psf.stage_fit import Drift, StageFit
from calibration_routines.psf.structure import Structure
from calibration_routines.psf.sweep_options import AskedSweep, PointSweep
from calibration_routines.psf.sweep_plan import (
    PSF,
    REFERENCE,
    SWEEP,
    SweepExposures,
    SweepRecord,
    check_image_settings,
    check_sweep,
    expose_sweep,
    plan_lines,
    retake_plan,
    size_findings,
    source_width_px,
    sweep_plan,
)
from calibration_routines.psf.sweep_watch import SweepWatch, TakeAgain, retake_dimming
from calibration_routines.purpose import CalibrationError, completed
from calibration_routines.scatter import STEADY, Scatter
from instrument.bench.bench import Bench
from instrument.bench.photograph import Snapshot
from instrument.files.atomic import write_text
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError
from instrument.files.reading import parse_json, read_bytes
from instrument.files.record import plain, value_of
from instrument.plan import Step
from instrument.runs.acquire import acquire
from instrument.runs.results import RETAKES_FILE
from instrument.runs.run import Run
from instrument.runs.run_control import EndedEarlyError, RunControl
from instrument.runs.runner import Runner
from recon.base.arguments import require_argument
from recon.errors import InputError
from recon.types import Calibration

_INTERRUPTIONS = (KeyboardInterrupt, SystemExit, EndedEarlyError)


@dataclass(frozen=True, slots=True)
class SweepCalibration:
    """A finished sweep."""

    calibration: Calibration
    path: Path
    """The calibration's folder, inside the first run's folder."""
    quality: tuple[PsfQuality, ...]
    """One a PSF."""
    runs: tuple[Run, ...]
    """The sweep, and one more for each round of retakes."""
    exposures: SweepExposures
    stages: tuple[StageFit, ...] = ()
    """For each depth with several points: measured shifts against the stage's."""
    drift: Drift | None = None
    """The source at the reference point; None for a sweep too short to have one."""
    scatter: Scatter = STEADY
    """Of the frames that were averaged, all points together."""
    bench_findings: tuple[str, ...] = ()
    """What is wrong with light, place and dark frames, whatever the point."""
    late_hot: int = 0
    """Pixels that turned hot during the sweep; they were replaced like the others."""
    source_width_px: float = 0.0
    """Of the source's image from the nearest depth; 0 where its size is not known."""
    mount: MountFit | None = None
    """Where the source stands by light, place and growth, with d and pitch; None where too little tells."""
    structure: Structure | None = None
    """Of the central PSFs; None where too little tells."""
    source_size_um: float | None = None
    """As configured."""

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong with which PSF, stage or source, in words; empty when the sweep is good."""
        psfs = tuple(f"{place_of(q)}: {finding}" for q in self.quality for finding in q.findings)
        stages = tuple(finding for stage in self.stages for finding in stage.findings)
        drift = self.drift.findings if self.drift is not None else ()
        return self.bench_findings + psfs + stages + drift


def calibrate_sweep(
    bench: Bench,
    sweep: AskedSweep,
    folder: Path | str | None = None,
    *,
    exposures: SweepExposures | None = None,
    control: RunControl | None = None,
    listener: Listener | None = None,
) -> SweepCalibration:
    """Take a sweep and save its calibration inside the run's folder.

    Parameters
    ----------
    bench : Bench
        Open, its stage homed.
    sweep : AxialSweep, LateralSweep, VolumeSweep or PointSweep
    folder : path, optional
        Where the run's folder is made; the bench's data folder by default.
    exposures : SweepExposures, optional
        From :func:`~calibration_routines.expose_sweep`, which is called when None.
    control : RunControl, optional
        Pauses, aborts or stops it from another thread, in the sweep's run and in each round of retakes.
    listener : Listener, optional
        Its ``event`` is called with a :class:`~calibration_routines.PointTaken` as soon as a PSF has been
        taken and judged, and with a :class:`~calibration_routines.SourceVisit` after each visit to the
        reference point, in the thread that sweeps.

    Returns
    -------
    SweepCalibration
        The calibration, its folder (``path``), and how good each PSF is.

    Raises PlanError, SettingsError when the sweep leaves the limits of the bench or the disk (nothing moved);
    CalibrationError when no exposure is usable, or the run was ended before its last frame.
    """
    require_argument("bench", bench, Bench, "'with db.bench() as bench:' opens one.")
    if not hasattr(sweep, "planned"):
        raise InputError(
            "sweep must be an AxialSweep, LateralSweep, VolumeSweep or PointSweep, "
            f"as db.AxialSweep(z_min_um=..., z_max_um=...), not {type(sweep).__name__}."
        )
    require_whereabouts(folder, control, listener)
    control, listener = control or RunControl(), listener or Listener()
    where = Path(folder) if folder is not None else None
    points = sweep.planned(bench).sweep
    check_sweep(bench, points, where)
    if exposures is None:
        listener.step("finding exposures")
        try:
            exposures = expose_sweep(bench, points, control=control)
        except _INTERRUPTIONS as interruption:
            interruption.add_note("The sweep had not begun: no frame was kept, start it again.")
            raise
    plan = sweep_plan(points, exposures.exposures_ms)
    listener.exposures(exposures)
    listener.planned(plan_lines(bench, points, plan, where))
    listener.step("sweeping")
    record = SweepRecord(
        points,
        exposures,
        bench.geometry,
        bench.label,
        bool(bench.simulated_kinds),
        bench.config.source.size_um,
    )
    runner = SWEEP.prepare(bench, plan, where, record, control, listener)
    watch_sweep(bench, runner, listener)
    return _finished(runner.execute(), record, bench, control, listener)


def watch_sweep(bench: Bench, runner: Runner, listener: Listener) -> None:
    """Let a sweep's run, not yet begun, be watched; what one that goes on has already is looked at first.

    The listener's ``event`` is not called for that. Raises CalibrationError when the run is no sweep.
    """
    record = SWEEP.read(runner.path)
    watch = SweepWatch(record.sweep, record.geometry)
    run = Run.open(runner.path)
    for step in run.plan.whole_steps(run.start) if run.plan is not None else ():
        if step.index in run.records and run.verify(step.index) is None:
            watch.see(step, _stored(run, step.index))
    watch.on_event, watch.take_again = listener.event, _retaker(bench, record, runner.path)
    runner.on_frame = watch.see


def finish_sweep(
    run: Path | str,
    bench: Bench | None = None,
    *,
    control: RunControl | None = None,
    listener: Listener | None = None,
) -> SweepCalibration:
    """Make the calibration of a sweep's complete run, e.g. of one that was resumed.

    Without a ``bench``, for retakes, PSFs that need them are only flagged.

    Raises CalibrationError when the run is no sweep or is not complete; CalibrationFileError when it has its
    calibration already.
    """
    record = SWEEP.read(Path(run))
    return _finished(Run.open(Path(run)), record, bench, control or RunControl(), listener or Listener())


def _finished(
    run: Run, record: SweepRecord, bench: Bench | None, control: RunControl, listener: Listener
) -> SweepCalibration:
    """Analyse, take again what needs it, save; an interruption says that all frames are kept."""
    try:
        taken = _TakenSweep(_complete(run), record, control, listener)
        analysis = taken.analysed()
        while bench is not None and (again := taken.to_take_again(analysis)):
            taken.take_again(bench, again)
            analysis = taken.analysed()
        return taken.saved(analysis)
    except _INTERRUPTIONS as interruption:
        interruption.add_note(
            f"All frames of the sweep are kept. For its calibration: diffuserbench resume {run.path}"
        )
        raise


class _TakenSweep:
    """The complete run of a sweep and its retakes: which of them has which point's frames."""

    def __init__(self, run: Run, record: SweepRecord, control: RunControl, listener: Listener) -> None:
        self.run, self.record = run, record
        self.control, self.listener = control, listener
        self.dark = dark_model(run)
        self.runs = [run]
        self.takes = dict.fromkeys(record.sweep.points_um, run)
        self.rounds = Counter[Position]()
        self.sweep = record.sweep
        if self.sweep.binning == 0:
            self.sweep = replace(self.sweep, binning=self._optical_binning())
        try:
            check_image_settings(self.sweep, self.dark.hot.shape)
        except BenchError as error:
            raise BenchError(
                f"{run.path / SWEEP.file}: {error} All frames are kept: change binning or dct_order there, "
                f"then: diffuserbench resume {run.path}"
            ) from None
        for retake in read_retakes(run.path):
            known = next((one for one in self.runs if one.path.name == retake.run), None)
            self._took(retake.point_um, known or Run.open(run.path.parent / retake.run))
        self.drift = drift_of(run, self.sweep, self.dark)

    def _took(self, point: Position, run: Run) -> None:
        self.runs += [] if run in self.runs else [run]
        self.takes[point] = run
        self.rounds[point] += 1

    def to_take_again(self, analysis: SweepAnalysis) -> list[tuple[Position, float]]:
        """Return the points that it may help, each with its exposure."""
        return [
            (q.source_um, self._exposure_ms(q.source_um) * retake_dimming(q))
            for q in analysis.quality
            if q.retake and self.rounds[q.source_um] < self.sweep.retakes
        ]

    def take_again(self, bench: Bench, points: list[tuple[Position, float]]) -> None:
        """Take points again in a run beside the sweep's."""
        retake = _taken_again(
            bench, self.sweep, self.run.path, points, on_progress=self.listener.frame, control=self.control
        )
        for point, _ in points:
            self._took(point, retake)

    def analysed(self) -> SweepAnalysis:
        """Turn the frames into PSFs and judge them."""
        sweep, record = self.sweep, self.record
        found = analyse_sweep(
            self._planes(), self.dark, record.geometry, dct_order=sweep.dct_order, binning=sweep.binning
        )
        geometry = binned(record.geometry, sweep.binning)
        large = size_findings(record.source_size_um, geometry, sweep.depths_um[0])
        return replace(found, findings=(*large, *found.findings))

    def _planes(self) -> Iterator[PlaneFrames]:
        visits = self.run.steps(REFERENCE)
        began = self.run.metadata(visits[0]).utc if visits else None
        central = self.sweep.central
        self.listener.step("analysing")
        for done, point in enumerate(self.sweep.points_um):
            self.control.check()
            self.listener.share(done, len(self.sweep.points_um))
            run, steps = self.takes[point], self._steps(point)
            first = run.metadata(steps[0])
            seconds = 0.0 if began is None else (first.utc - began).total_seconds()
            yield PlaneFrames(
                source_um=point,
                exposure_ms=first.exposure_ms,
                frames=np.stack([run.frame(step) for step in steps]),
                full_scale=full_scale(run),
                off_axis=point not in central,
                brightness=1.0 if self.drift is None else self.drift.brightness_at(seconds),
            )

    def _steps(self, point: Position) -> list[Step]:
        return [step for step in self.takes[point].steps(PSF) if step.source_um in (None, point)]

    def _exposure_ms(self, point: Position) -> float:
        return self.takes[point].metadata(self._steps(point)[0]).exposure_ms

    def _optical_binning(self) -> int:
        """Return the binning by the finest structure, which is that of the farthest central PSF."""
        steps = self._steps(self.sweep.axis_point(self.sweep.depths_um[-1]))[:2]
        frames = [light_of(self.run, [step.index], self.dark).mean for step in steps]
        return optical_binning(frames[0], frames[-1])

    def saved(self, analysis: SweepAnalysis) -> SweepCalibration:
        """Save the calibration."""
        sweep, drift, record = self.sweep, self.drift, self.record
        exposures_ms = tuple(self._exposure_ms(point) for point in sweep.points_um)
        exposures = replace(record.exposures, exposures_ms=exposures_ms)
        findings = [q.findings for q in analysis.quality] + [stage.findings for stage in analysis.stages]
        findings.append(analysis.findings)
        doubted = any(findings) or bool(drift and drift.findings)
        calibration = Calibration(
            psfs=analysis.psfs,
            source_positions_um=np.array(sweep.points_um),
            background=analysis.background,
            geometry=binned(record.geometry, sweep.binning),
            quality={
                "psfs": [plain(q) for q in analysis.quality],
                "stages": [plain(stage) for stage in analysis.stages],
                "drift": None if drift is None else plain(drift) | {"corrected": drift.is_correctable},
                "scatter": plain(analysis.scatter) | {"findings": list(analysis.findings)},
                "late_hot_pixels": self.dark.late_hot,
                "mount": None if analysis.mount is None else plain(analysis.mount),
                "structure": None if analysis.structure is None else plain(analysis.structure),
                "noise": None if analysis.noise is None else plain(analysis.noise),
                "good": not doubted,
            },
            provenance=self._provenance(exposures, analysis.reference_exposure_ms),
        )
        path = save_calibration(calibration, SWEEP.place(self.run.path, doubted=doubted))
        return SweepCalibration(
            calibration,
            path,
            analysis.quality,
            tuple(self.runs),
            exposures,
            analysis.stages,
            drift,
            analysis.scatter,
            analysis.findings,
            self.dark.late_hot,
            source_width_px(record.source_size_um, calibration.geometry, sweep.depths_um[0]),
            analysis.mount,
            analysis.structure,
            record.source_size_um,
        )

    def _provenance(self, exposures: SweepExposures, reference_ms: float) -> dict[str, Any]:
        return {
            "made_by": f"diffuserbench {version('diffuserbench')}",
            "utc": datetime.now(UTC).isoformat(timespec="seconds"),
            "bench": self.record.bench,
            "simulated": self.record.simulated,
            "runs": [run.path.name for run in self.runs],
            "sweep": plain(self.sweep),
            "reference_exposure_ms": reference_ms,
            "exposures_ms": list(exposures.exposures_ms),
            "auto_exposure": [
                {"z_um": z_um, "outcome": found.outcome.value, "trace": [asdict(t) for t in found.trace]}
                for z_um, found in exposures.found
            ],
        }


def _complete(run: Run) -> Run:
    return completed(run, "The sweep", f"Go on with: diffuserbench resume {run.path}")


def _stored(run: Run, index: int) -> Snapshot:
    return Snapshot(run.frame(index), run.metadata(index), run.records[index].average)


# Retakes -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Retake:
    """A point that was taken again, and the name of the run beside the sweep's that has it."""

    point_um: Position
    run: str


def add_retakes(run: Path, points_um: Iterable[Position], retake: str) -> None:
    """Keep that points of the sweep in folder ``run`` were taken again in the run named ``retake``."""
    entries = [*read_retakes(run), *(Retake(point, retake) for point in points_um)]
    write_text(run / RETAKES_FILE, json.dumps(plain(entries), indent=1) + "\n")


def read_retakes(run: Path) -> list[Retake]:
    """Return which points were taken again, in the order of time; CalibrationError from a damaged file."""
    path = run / RETAKES_FILE
    if not path.exists():
        return []
    try:
        return value_of(list[Retake], parse_json(read_bytes(path)))
    except (OSError, LookupError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path} cannot be read ({error}): it was changed or damaged. Without it the sweep's first takes "
            "count: remove the file, or restore it from a copy."
        ) from error


def _taken_again(
    bench: Bench, sweep: PointSweep, path: Path, points: list[tuple[Position, float]], **how: Any
) -> Run:
    """Take points of the sweep in ``path`` again, each with its exposure, in a run beside it."""
    retake = _complete(acquire(bench, retake_plan(sweep, points), path.parent, **how))
    add_retakes(path, [point for point, _ in points], retake.path.name)
    return retake


def _retaker(bench: Bench, record: SweepRecord, path: Path) -> TakeAgain:
    """Return what takes a point again between two points of the sweep in ``path``, as a run beside it."""

    def take_again(point: Position, exposure_ms: float) -> list[Snapshot]:
        retake = _taken_again(bench, record.sweep, path, [(point, exposure_ms)])
        return [_stored(retake, step.index) for step in retake.steps(PSF)]

    return take_again
