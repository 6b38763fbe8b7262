"""Measure point spread functions at many places: acquisition, analysis, retakes, and going on after a crash.

A sweep is a run like any other, with one file more in its folder: ``sweep.json`` says what the frames are
for. A run that was cut off is completed by ``resume`` and becomes a calibration by :func:`finish_sweep`, with
or without the bench.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.axial_analysis import (
    DarkModel,
    PlaneFrames,
    SweepAnalysis,
    analyse_sweep,
    binned,
    replace_hot,
)
from calibration_routines.axial_exposure import SweepExposures, expose_sweep
from calibration_routines.drift import Drift, judge_drift
from calibration_routines.errors import CalibrationError
from calibration_routines.feature_size import optical_binning
from calibration_routines.psf_quality import PsfQuality
from calibration_routines.stage_fit import StageFit
from calibration_routines.sweep_plan import (
    DARK,
    PSF,
    REFERENCE,
    Position,
    Sweep,
    axis_point,
    check_image_settings,
    check_sweep,
    depths_um,
    retake_plan,
    sweep_plan,
)
from calibration_routines.sweep_record import (
    SWEEP_FILE,
    SweepRecord,
    read_record,
    rebinned,
    sweep_json,
    to_json,
)
from instrument.acquire import acquire, prepare
from instrument.atomic import write_text
from instrument.bench import Bench
from instrument.calibration_file import save_calibration
from instrument.errors import BenchError
from instrument.runner import Progress
from instrument.store import Run, RunCondition
from recon.types import Calibration, Geometry

Analysed = Callable[[int, int], None]
"""Takes how many PSFs have been analysed, and how many there are."""
FOLDER = "calibration"
"""Name of the calibration's folder inside the run's folder."""
_RETAKE_DIMMING = 0.7  # a PSF that saturated is taken again with this part of its exposure


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
        psfs = tuple(f"{_place(q)}: {finding}" for q in self.quality for finding in q.findings)
        stages = tuple(finding for stage in self.stages for finding in stage.findings)
        return psfs + stages + (self.drift.findings if self.drift is not None else ())


def calibrate_sweep(
    bench: Bench,
    sweep: Sweep,
    folder: Path | str | None = None,
    *,
    exposures: SweepExposures | None = None,
    on_progress: Progress | None = None,
    on_analysis: Analysed | None = None,
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
        Called with a :class:`~instrument.runner.RunStatus` after every frame.
    on_analysis : callable, optional
        Called with how many PSFs have been analysed, and how many there are.

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
    return _finished(_complete(runner.execute()), record, bench, on_progress, on_analysis)


def finish_sweep(
    run: Path | str,
    bench: Bench | None = None,
    *,
    on_progress: Progress | None = None,
    on_analysis: Analysed | None = None,
) -> SweepCalibration:
    """Make the calibration of a sweep's complete run, e.g. of one that was resumed.

    Parameters
    ----------
    run : path
        The run's folder.
    bench : Bench, optional
        For retakes; without one, PSFs that need them are only flagged.
    on_progress, on_analysis : callable, optional
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
    return _finished(_complete(Run.open(path)), record, bench, on_progress, on_analysis)


def _finished(
    run: Run,
    record: SweepRecord,
    bench: Bench | None,
    on_progress: Progress | None,
    on_analysis: Analysed | None,
) -> SweepCalibration:
    """Make the calibration of a complete run; an interruption says that all frames of it are kept."""
    try:
        return _judged(run, record, bench, on_progress, on_analysis)
    except (KeyboardInterrupt, SystemExit) as interruption:
        interruption.add_note(
            f"All frames of the sweep are kept. For its calibration: diffuserbench resume {run.path}"
        )
        raise


def _judged(
    run: Run,
    record: SweepRecord,
    bench: Bench | None,
    on_progress: Progress | None,
    on_analysis: Analysed | None,
) -> SweepCalibration:
    """Analyse, take again what needs it, judge the source, save."""
    sweep, exposures = record.sweep, record.exposures
    where = run.path.parent
    dark = _dark_model(run)
    if sweep.binning == 0:
        sweep = _binned_to_resolution(run, sweep, dark)
    try:
        check_image_settings(sweep, dark.hot.shape)
    except BenchError as error:
        raise BenchError(
            f"{run.path / SWEEP_FILE}: {error} All frames are kept: change binning or dct_order there, then: "
            f"diffuserbench resume {run.path}"
        ) from None
    runs = [run]
    takes = dict.fromkeys(sweep.points_um, run)
    analysis = _analysed(takes, sweep, dark, record.geometry, on_analysis)
    for _ in range(sweep.retakes if bench is not None else 0):
        again = [q for q in analysis.quality if q.retake]
        if not again or bench is None:
            break
        present = dict(zip(sweep.points_um, exposures.exposures_ms, strict=True))
        points = [
            (q.source_um, present[q.source_um] * (_RETAKE_DIMMING if q.saturated_pixels else 1.0))
            for q in again
        ]
        retake = _complete(acquire(bench, retake_plan(sweep, points), where, on_progress=on_progress))
        runs.append(retake)
        takes.update({point: retake for point, _ in points})
        renewed = present | dict(points)
        exposures = replace(exposures, exposures_ms=tuple(renewed[point] for point in sweep.points_um))
        analysis = _analysed(takes, sweep, dark, record.geometry, on_analysis)
    drift = _drift(run, sweep, dark)
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


def _complete(run: Run) -> Run:
    if run.condition is not RunCondition.COMPLETED:
        raise CalibrationError(
            f"The sweep ended early ({run.condition}); what was taken is in {run.path}. "
            f"Go on with: diffuserbench resume {run.path}"
        )
    return run


# Frames to PSFs ----------------------------------------------------------------------------------------
def _dark_model(run: Run) -> DarkModel:
    steps: dict[float, list[int]] = {}
    for step in run.steps(DARK):
        steps.setdefault(run.metadata(step).exposure_ms, []).append(step.index)
    stacks = [np.stack([run.frame(index) for index in indices]) for indices in steps.values()]
    return DarkModel(list(steps), stacks, _full_scale(run))


def _full_scale(run: Run) -> int:
    return (1 << run.metadata(0).significant_bits) - 1


def _analysed(
    takes: Mapping[Position, Run],
    sweep: Sweep,
    dark: DarkModel,
    geometry: Geometry,
    on_analysis: Analysed | None,
) -> SweepAnalysis:
    return analyse_sweep(
        _planes(takes, sweep, on_analysis), dark, geometry, dct_order=sweep.dct_order, binning=sweep.binning
    )


def _planes(
    takes: Mapping[Position, Run], sweep: Sweep, on_analysis: Analysed | None
) -> Iterator[PlaneFrames]:
    central = {axis_point(sweep, z_um) for z_um in depths_um(sweep)}
    for done, point in enumerate(sweep.points_um):
        if on_analysis is not None:
            on_analysis(done, len(sweep.points_um))
        run = takes[point]
        steps = [step for step in run.steps(PSF) if step.source_um is None or step.source_um == point]
        yield PlaneFrames(
            source_um=point,
            exposure_ms=run.metadata(steps[0]).exposure_ms,
            frames=np.stack([run.frame(step) for step in steps]),
            full_scale=_full_scale(run),
            off_axis=point not in central,
        )


def _binned_to_resolution(run: Run, sweep: Sweep, dark: DarkModel) -> Sweep:
    """Choose the binning by the finest structure, which is that of the farthest central PSF."""
    point = axis_point(sweep, depths_um(sweep)[-1])
    steps = [step for step in run.steps(PSF) if step.source_um is None or step.source_um == point]
    exposure_ms = run.metadata(steps[0]).exposure_ms
    frames = [
        replace_hot(run.frame(step).astype(np.float32) - dark.at(exposure_ms), dark.hot) for step in steps[:2]
    ]
    grey = [frame.mean(axis=-1) if frame.ndim == 3 else frame for frame in frames]
    return rebinned(sweep, optical_binning(grey[0], grey[-1]))


def _drift(run: Run, sweep: Sweep, dark: DarkModel) -> Drift | None:
    visits: dict[int, list[int]] = {}
    for step in run.steps(REFERENCE):
        visits.setdefault(step.part, []).append(step.index)
    if not visits:
        return None
    images = []
    for indices in visits.values():
        mean = np.mean([run.frame(index) for index in indices], axis=0, dtype=np.float32)
        light = replace_hot(mean - dark.at(run.metadata(indices[0]).exposure_ms), dark.hot)
        images.append(light.mean(axis=-1) if light.ndim == 3 else light)
    every = sweep.reference_every
    before = [min(k * every, len(sweep.points_um)) for k in range(len(images))]
    return judge_drift(images, before, len(sweep.points_um))


def _place(q: PsfQuality) -> str:
    across = f"x = {q.x_um / 1e3:.4g}, y = {q.y_um / 1e3:.4g}, " if q.x_um or q.y_um else ""
    return f"{across}z = {q.z_um / 1e3:.4g} mm"


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
