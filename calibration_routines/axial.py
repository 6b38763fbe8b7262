"""Measure point spread functions along the axis: exposure, acquisition, analysis, retakes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.axial_analysis import (
    AxialAnalysis,
    DarkModel,
    PlaneFrames,
    analyse_axial,
    binned,
)
from calibration_routines.axial_exposure import SweepExposures, expose_sweep
from calibration_routines.axial_plan import AxialSweep, axial_plan, check_sweep, plan_planes
from calibration_routines.errors import CalibrationError
from calibration_routines.psf_quality import PsfQuality
from instrument.acquire import acquire
from instrument.bench import Bench
from instrument.calibration_file import save_calibration
from instrument.plan import Plan
from instrument.runner import Progress
from instrument.store import Run, RunCondition
from recon.types import Calibration, Geometry

FOLDER = "calibration"
"""Name of the calibration's folder inside the run's folder."""
_RETAKE_DIMMING = 0.7  # a plane that saturated is taken again with this part of its exposure


@dataclass(frozen=True, slots=True)
class AxialCalibration:
    """A finished axial sweep."""

    calibration: Calibration
    path: Path
    """The calibration's folder, inside the first run's folder."""
    quality: tuple[PsfQuality, ...]
    runs: tuple[Run, ...]
    """The sweep, and one more for each round of retakes."""
    exposures: SweepExposures

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong with which plane, in words; empty when the sweep is good."""
        return tuple(f"z = {q.z_um / 1e3:.4g} mm: {finding}" for q in self.quality for finding in q.findings)


def calibrate_axial(
    bench: Bench,
    sweep: AxialSweep,
    folder: Path | str | None = None,
    *,
    exposures: SweepExposures | None = None,
    on_progress: Progress | None = None,
) -> AxialCalibration:
    """Take an axial sweep and save its calibration inside the run's folder.

    Parameters
    ----------
    bench : Bench
        Open, its stage homed.
    sweep : AxialSweep
    folder : path, optional
        Where the run's folder is made; the bench's data folder by default.
    exposures : SweepExposures, optional
        From :func:`expose_sweep`, which is called when None.
    on_progress : callable, optional
        Called with a :class:`~instrument.runner.RunStatus` after every frame.

    Returns
    -------
    AxialCalibration
        ``findings`` is empty when every plane is good.

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
    geometry = bench.geometry
    run = _acquired(bench, axial_plan(sweep, exposures.exposures_ms), where, on_progress)
    runs = [run]
    takes = dict.fromkeys(sweep.z_um, run)
    analysis = _analysed(runs[0], takes, sweep, geometry)
    for _ in range(sweep.retakes):
        again = [q for q in analysis.quality if q.retake]
        if not again:
            break
        present = dict(zip(sweep.z_um, exposures.exposures_ms, strict=True))
        planes = [(q.z_um, present[q.z_um] * (_RETAKE_DIMMING if q.saturated_pixels else 1.0)) for q in again]
        retake = _acquired(bench, plan_planes(sweep, planes, "axial sweep retake"), where, on_progress)
        runs.append(retake)
        takes.update({z_um: retake for z_um, _ in planes})
        exposures = replace(
            exposures, exposures_ms=tuple((present | dict(planes))[z_um] for z_um in sweep.z_um)
        )
        analysis = _analysed(runs[0], takes, sweep, geometry)
    calibration = Calibration(
        psfs=analysis.psfs,
        source_positions_um=np.array([(sweep.x_um, sweep.y_um, z_um) for z_um in sweep.z_um]),
        background=analysis.background,
        geometry=binned(geometry, sweep.binning),
        quality={
            "planes": [q.as_json() for q in analysis.quality],
            "good": not any(q.findings for q in analysis.quality),
        },
        provenance=_provenance(bench, sweep, exposures, runs, analysis.reference_exposure_ms),
    )
    path = save_calibration(calibration, run.path / FOLDER)
    return AxialCalibration(calibration, path, analysis.quality, tuple(runs), exposures)


def _acquired(bench: Bench, plan: Plan, folder: Path | None, on_progress: Progress | None) -> Run:
    run = acquire(bench, plan, folder, on_progress=on_progress)
    if run.condition is not RunCondition.COMPLETED:
        raise CalibrationError(f"The sweep ended early ({run.condition}); what was taken is in {run.path}.")
    return run


def _analysed(first: Run, takes: dict[float, Run], sweep: AxialSweep, geometry: Geometry) -> AxialAnalysis:
    dark_steps: dict[float, list[int]] = {}
    for step in first.steps("dark"):
        dark_steps.setdefault(first.metadata(step).exposure_ms, []).append(step.index)
    full_scale = (1 << first.metadata(0).significant_bits) - 1
    dark = DarkModel(
        list(dark_steps),
        [np.stack([first.frame(index) for index in indices]) for indices in dark_steps.values()],
        full_scale,
    )
    return analyse_axial(
        _planes(takes, sweep, full_scale), dark, geometry, dct_order=sweep.dct_order, binning=sweep.binning
    )


def _planes(takes: dict[float, Run], sweep: AxialSweep, full_scale: int) -> Iterator[PlaneFrames]:
    for z_um in sweep.z_um:
        run = takes[z_um]
        steps = [step for step in run.steps("psf") if step.source_um is None or step.source_um[2] == z_um]
        yield PlaneFrames(
            source_um=(sweep.x_um, sweep.y_um, z_um),
            exposure_ms=run.metadata(steps[0]).exposure_ms,
            frames=np.stack([run.frame(step) for step in steps]),
            full_scale=full_scale,
        )


def _provenance(
    bench: Bench, sweep: AxialSweep, exposures: SweepExposures, runs: Sequence[Run], reference_ms: float
) -> dict[str, Any]:
    return {
        "made_by": f"diffuserbench {version('diffuserbench')}",
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "bench": bench.label,
        "simulated": bool(bench.simulated_kinds),
        "runs": [run.path.name for run in runs],
        "sweep": asdict(sweep),
        "reference_exposure_ms": reference_ms,
        "exposures_ms": list(exposures.exposures_ms),
        "auto_exposure": [
            {"z_um": z_um, "outcome": found.outcome.value, "trace": [asdict(trial) for trial in found.trace]}
            for z_um, found in exposures.found
        ],
    }
