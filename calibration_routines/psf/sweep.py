"""Measure point spread functions at many places: acquisition, analysis, retakes, and going on after a crash.

A sweep is a run like any other, with one file more in its folder: ``sweep.json`` says what the frames are
for. A run that was cut off is completed by ``resume`` and becomes a calibration by :func:`finish_sweep`, with
or without the bench.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.errors import completed
from calibration_routines.psf.analysis import (
    DarkModel,
    PlaneFrames,
    SweepAnalysis,
    analyse_sweep,
    binned,
    dark_model,
    drift_of,
    full_scale,
    optical_binning,
    replace_hot,
)
from calibration_routines.psf.exposure import SweepExposures, expose_sweep
from calibration_routines.psf.psf_quality import PsfQuality, place_of
from calibration_routines.psf.sampling import Position
from calibration_routines.psf.stage_fit import Drift, StageFit
from calibration_routines.psf.sweep_options import Sweep
from calibration_routines.psf.sweep_plan import (
    PSF,
    REFERENCE,
    axis_point,
    check_image_settings,
    check_sweep,
    depths_um,
    retake_plan,
    sweep_plan,
)
from calibration_routines.psf.sweep_record import (
    SWEEP_FILE,
    SweepRecord,
    add_retakes,
    read_record,
    read_retakes,
    rebinned,
    sweep_json,
    to_json,
)
from calibration_routines.psf.sweep_watch import OnEvent, SweepWatch, TakeAgain, retake_dimming
from instrument.bench.bench import Bench
from instrument.bench.photograph import Snapshot
from instrument.files.atomic import write_text
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError
from instrument.plan import Step
from instrument.runs.acquire import acquire, prepare
from instrument.runs.run import Run
from instrument.runs.run_control import EndedEarlyError
from instrument.runs.runner import Runner, RunProgress
from recon.types import Calibration, Geometry

OnRunner = Callable[[Runner], None]
"""Takes each runner of a sweep before it begins: who wants to pause, abort or stop it keeps it."""
Analysed = Callable[[int, int], None]
"""Takes how many PSFs have been analysed, and how many there are."""
FOLDER = "calibration"
"""Name of the calibration's folder inside the run's folder."""


@dataclass(frozen=True, slots=True)
class SweepCalibration:
    """A finished sweep.

    Attributes
    ----------
    calibration : Calibration
    path : Path
        The calibration's folder, inside the first run's folder.
    quality : tuple of PsfQuality
        One a PSF.
    runs : tuple of Run
        The sweep, and one more for each round of retakes.
    exposures : SweepExposures
    stages : tuple of StageFit
        For each depth with several points: measured shifts against the stage's.
    drift : Drift or None
        The source at the reference point; None for a sweep too short to have one.
    """

    calibration: Calibration
    path: Path
    quality: tuple[PsfQuality, ...]
    runs: tuple[Run, ...]
    exposures: SweepExposures
    stages: tuple[StageFit, ...] = ()
    drift: Drift | None = None

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong with which PSF, stage or source, in words; empty when the sweep is good."""
        psfs = tuple(f"{place_of(q)}: {finding}" for q in self.quality for finding in q.findings)
        stages = tuple(finding for stage in self.stages for finding in stage.findings)
        return psfs + stages + (self.drift.findings if self.drift is not None else ())


def calibrate_sweep(
    bench: Bench,
    sweep: Sweep,
    folder: Path | str | None = None,
    *,
    exposures: SweepExposures | None = None,
    on_progress: RunProgress | None = None,
    on_analysis: Analysed | None = None,
    on_event: OnEvent | None = None,
    on_runner: OnRunner | None = None,
) -> SweepCalibration:
    """Take a sweep and save its calibration inside the run's folder.

    Parameters
    ----------
    bench : Bench
        Open, its stage homed.
    sweep : AxialSweep or PointSweep
    folder : path, optional
        Where the run's folder is made; the bench's data folder by default.
    exposures : SweepExposures, optional
        From :func:`~calibration_routines.expose_sweep`, which is called when None.
    on_progress : callable, optional
        Called with a :class:`~instrument.runs.runner.RunStatus` after every frame.
    on_analysis : callable, optional
        Called with how many PSFs have been analysed, and how many there are.
    on_event : callable, optional
        Called with a :class:`~calibration_routines.PointTaken` as soon as a PSF has been taken and judged,
        and with a :class:`~calibration_routines.SourceVisit` after each visit to the reference point. All
        callables are called in the thread that sweeps.
    on_runner : callable, optional
        Called with the sweep's :class:`~instrument.runs.runner.Runner` before it begins, and with that of
        each round of retakes after it.

    Returns
    -------
    SweepCalibration
        ``findings`` is empty when every PSF is good.

    Raises
    ------
    PlanError
        When the sweep leaves the limits of the bench or the disk; nothing moved.
    CalibrationError
        When no exposure is usable, or the run was ended before its last frame.
    """
    where = Path(folder) if folder is not None else None
    check_sweep(bench, sweep, where)
    exposures = exposures or expose_sweep(bench, sweep)
    runner = prepare(bench, sweep_plan(sweep, exposures.exposures_ms), where, on_progress=on_progress)
    record = SweepRecord(sweep, exposures, bench.geometry, bench.label, bool(bench.simulated_kinds))
    write_text(runner.path / SWEEP_FILE, to_json(record))
    runner.on_frame = _watch(bench, record, runner.path, on_event).see
    if on_runner is not None:
        on_runner(runner)
    return _finished(_complete(runner.execute()), record, bench, on_progress, on_analysis, on_runner)


def watch_resumed(bench: Bench, runner: Runner, on_event: OnEvent | None = None) -> None:
    """Let a sweep's run that goes on be watched as from its beginning: what it has is looked at first.

    Parameters
    ----------
    bench : Bench
        Open.
    runner : Runner
        From :func:`~instrument.runs.acquire.prepare_resume`, not yet begun.
    on_event : callable, optional
        As :func:`calibrate_sweep`; not called for what was taken before.

    Raises
    ------
    CalibrationError
        When the run is no sweep.
    """
    record = read_record(runner.path)
    watch = SweepWatch(record.sweep, record.geometry)
    run = Run.open(runner.path)
    for step in run.plan.whole_steps(run.start) if run.plan is not None else ():
        if step.index in run.records and run.verify(step.index) is None:
            watch.see(step, _stored(run, step.index))
    watch.on_event, watch.take_again = on_event, _retaker(bench, record.sweep, runner.path)
    runner.on_frame = watch.see


def finish_sweep(
    run: Path | str,
    bench: Bench | None = None,
    *,
    on_progress: RunProgress | None = None,
    on_analysis: Analysed | None = None,
    on_runner: OnRunner | None = None,
) -> SweepCalibration:
    """Make the calibration of a sweep's complete run, e.g. of one that was resumed.

    Parameters
    ----------
    run : path
        The run's folder.
    bench : Bench, optional
        For retakes; without one, PSFs that need them are only flagged.
    on_progress, on_analysis, on_runner : callable, optional
        As :func:`calibrate_sweep`.

    Raises
    ------
    CalibrationError
        When the run is no sweep or is not complete.
    CalibrationFileError
        When it has its calibration already.
    """
    path = Path(run)
    record = read_record(path)
    return _finished(_complete(Run.open(path)), record, bench, on_progress, on_analysis, on_runner)


def _finished(
    run: Run,
    record: SweepRecord,
    bench: Bench | None,
    on_progress: RunProgress | None,
    on_analysis: Analysed | None,
    on_runner: OnRunner | None,
) -> SweepCalibration:
    """Make the calibration of a complete run; an interruption says that all frames of it are kept."""
    try:
        return _judged(run, record, bench, on_progress, on_analysis, on_runner)
    except (KeyboardInterrupt, SystemExit, EndedEarlyError) as interruption:
        interruption.add_note(
            f"All frames of the sweep are kept. For its calibration: diffuserbench resume {run.path}"
        )
        raise


def _judged(
    run: Run,
    record: SweepRecord,
    bench: Bench | None,
    on_progress: RunProgress | None,
    on_analysis: Analysed | None,
    on_runner: OnRunner | None,
) -> SweepCalibration:
    """Analyse, take again what needs it, judge the source, save."""
    sweep, exposures = record.sweep, record.exposures
    where = run.path.parent
    dark = dark_model(run)
    if sweep.binning == 0:
        sweep = _binned_to_resolution(run, sweep, dark)
    try:
        check_image_settings(sweep, dark.hot.shape)
    except BenchError as error:
        raise BenchError(
            f"{run.path / SWEEP_FILE}: {error} All frames are kept: change binning or dct_order there, then: "
            f"diffuserbench resume {run.path}"
        ) from None
    runs, takes, rounds = [run], dict.fromkeys(sweep.points_um, run), Counter[Position]()
    for point, name in read_retakes(run.path):
        retake = next((known for known in runs if known.path.name == name), None) or Run.open(where / name)
        runs += [] if retake in runs else [retake]
        takes[point] = retake
        rounds[point] += 1
    drift = drift_of(run, sweep, dark)
    analysis = _analysed(takes, run, sweep, dark, record.geometry, drift, on_analysis)
    while bench is not None:
        again = [q for q in analysis.quality if q.retake and rounds[q.source_um] < sweep.retakes]
        if not again:
            break
        points = [
            (q.source_um, _exposure_ms(takes[q.source_um], q.source_um) * retake_dimming(q)) for q in again
        ]
        runner = prepare(bench, retake_plan(sweep, points), where, on_progress=on_progress)
        if on_runner is not None:
            on_runner(runner)
        retake = _complete(runner.execute())
        add_retakes(run.path, [point for point, _ in points], retake.path.name)
        runs.append(retake)
        for point, _ in points:
            takes[point] = retake
            rounds[point] += 1
        analysis = _analysed(takes, run, sweep, dark, record.geometry, drift, on_analysis)
    exposures = replace(
        exposures, exposures_ms=tuple(_exposure_ms(takes[point], point) for point in sweep.points_um)
    )
    good = not any(q.findings for q in analysis.quality) and not any(s.findings for s in analysis.stages)
    calibration = Calibration(
        psfs=analysis.psfs,
        source_positions_um=np.array(sweep.points_um),
        background=analysis.background,
        geometry=binned(record.geometry, sweep.binning),
        quality={
            "psfs": [q.as_json() for q in analysis.quality],
            "stages": [stage.as_json() for stage in analysis.stages],
            "drift": None if drift is None else drift.as_json(),
            "good": good and (drift is None or not drift.findings),
        },
        provenance=_provenance(record, sweep, exposures, runs, analysis.reference_exposure_ms),
    )
    path = save_calibration(calibration, run.path / FOLDER)
    return SweepCalibration(
        calibration, path, analysis.quality, tuple(runs), exposures, analysis.stages, drift
    )


def _watch(bench: Bench, record: SweepRecord, path: Path, on_event: OnEvent | None) -> SweepWatch:
    return SweepWatch(
        record.sweep,
        record.geometry,
        on_event=on_event,
        take_again=_retaker(bench, record.sweep, path),
    )


def _retaker(bench: Bench, sweep: Sweep, path: Path) -> TakeAgain:
    """Return what takes a point again between two points of the sweep in ``path``, as a run beside it."""

    def take_again(point: Position, exposure_ms: float) -> list[Snapshot]:
        retake = _complete(acquire(bench, retake_plan(sweep, [(point, exposure_ms)]), path.parent))
        add_retakes(path, [point], retake.path.name)
        return [_stored(retake, step.index) for step in retake.steps(PSF)]

    return take_again


def _stored(run: Run, index: int) -> Snapshot:
    return Snapshot(run.frame(index), run.metadata(index), run.records[index].average)


def _complete(run: Run) -> Run:
    return completed(run, "The sweep", f"Go on with: diffuserbench resume {run.path}")


# Frames to PSFs ----------------------------------------------------------------------------------------
def _analysed(
    takes: Mapping[Position, Run],
    first: Run,
    sweep: Sweep,
    dark: DarkModel,
    geometry: Geometry,
    drift: Drift | None,
    on_analysis: Analysed | None,
) -> SweepAnalysis:
    planes = _planes(takes, first, sweep, drift, on_analysis)
    return analyse_sweep(planes, dark, geometry, dct_order=sweep.dct_order, binning=sweep.binning)


def _planes(
    takes: Mapping[Position, Run],
    first: Run,
    sweep: Sweep,
    drift: Drift | None,
    on_analysis: Analysed | None,
) -> Iterator[PlaneFrames]:
    central = {axis_point(sweep, z_um) for z_um in depths_um(sweep)}
    visits = first.steps(REFERENCE)
    began = first.metadata(visits[0]).utc if visits else None
    for done, point in enumerate(sweep.points_um):
        if on_analysis is not None:
            on_analysis(done, len(sweep.points_um))
        run = takes[point]
        steps = _steps_of(run, point)
        seconds = 0.0 if began is None else (run.metadata(steps[0]).utc - began).total_seconds()
        yield PlaneFrames(
            source_um=point,
            exposure_ms=run.metadata(steps[0]).exposure_ms,
            frames=np.stack([run.frame(step) for step in steps]),
            full_scale=full_scale(run),
            off_axis=point not in central,
            brightness=1.0 if drift is None else drift.brightness_at(seconds),
        )


def _steps_of(run: Run, point: Position) -> list[Step]:
    return [step for step in run.steps(PSF) if step.source_um is None or step.source_um == point]


def _exposure_ms(run: Run, point: Position) -> float:
    return run.metadata(_steps_of(run, point)[0]).exposure_ms


def _binned_to_resolution(run: Run, sweep: Sweep, dark: DarkModel) -> Sweep:
    """Choose the binning by the finest structure, which is that of the farthest central PSF."""
    point = axis_point(sweep, depths_um(sweep)[-1])
    steps = _steps_of(run, point)
    exposure_ms = run.metadata(steps[0]).exposure_ms
    frames = [
        replace_hot(run.frame(step).astype(np.float32) - dark.at(exposure_ms), dark.hot) for step in steps[:2]
    ]
    grey = [frame.mean(axis=-1) if frame.ndim == 3 else frame for frame in frames]
    return rebinned(sweep, optical_binning(grey[0], grey[-1]))


def _provenance(
    record: SweepRecord,
    sweep: Sweep,
    exposures: SweepExposures,
    runs: Sequence[Run],
    reference_ms: float,
) -> dict[str, Any]:
    return {
        "made_by": f"diffuserbench {version('diffuserbench')}",
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "bench": record.bench,
        "simulated": record.simulated,
        "runs": [run.path.name for run in runs],
        "sweep": sweep_json(sweep),
        "reference_exposure_ms": reference_ms,
        "exposures_ms": list(exposures.exposures_ms),
        "auto_exposure": [
            {"z_um": z_um, "outcome": found.outcome.value, "trace": [asdict(trial) for trial in found.trace]}
            for z_um, found in exposures.found
        ],
    }
