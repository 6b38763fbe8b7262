"""Sweeps from the request to the calibration: check, home, find exposures, take, judge, save."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calibration_routines.procedure import Listener, Outcome, Outlook, outlook_of, under_control
from calibration_routines.psf.axial_exposure import expose_sweep
from calibration_routines.psf.sweep import SweepCalibration, calibrate_sweep
from calibration_routines.psf.sweep_plan import Sweep, check_sweep
from calibration_routines.psf.sweep_request import SweepRequest
from calibration_routines.psf.sweep_words import quality_lines
from instrument.bench.bench import Bench
from instrument.runs.run_control import EndedEarlyError, RunControl


@dataclass(frozen=True, slots=True)
class SweepProcedure:
    """Carries out what was asked of a sweep; the :class:`~calibration_routines.procedure.Procedure` of it."""

    request: SweepRequest

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Plan the sweep and hold it against the bench's limits and the disk."""
        planned = self.request.plan(bench)
        plan = check_sweep(bench, planned.sweep, folder or bench.config.data_folder)
        return outlook_of(bench, plan, folder, planned.reasons, homes=not planned.sweep.by_hand)

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Take the sweep and save its calibration; everything is as in :func:`take_sweep`."""
        sweep = self.request.plan(bench).sweep
        return sweep_outcome(take_sweep(bench, sweep, folder, control=control, listener=listener))


def take_sweep(
    bench: Bench,
    sweep: Sweep,
    folder: Path | None = None,
    *,
    control: RunControl | None = None,
    listener: Listener | None = None,
) -> SweepCalibration:
    """Check a sweep, home the stage, find exposures, take it and save its calibration.

    Errors as :func:`~calibration_routines.calibrate_sweep`.
    """
    heard = listener or Listener()
    check_sweep(bench, sweep, folder)
    with under_control(bench, control) as control:
        if bench.stage is not None and not sweep.by_hand:
            heard.step("homing the stage")
            bench.stage.home()
        heard.step("finding exposures")
        try:
            exposures = expose_sweep(bench, sweep, control=control)
        except (KeyboardInterrupt, SystemExit, EndedEarlyError) as interruption:
            interruption.add_note("The sweep had not begun: no frame was kept, start it again.")
            raise
        heard.exposures(exposures)
        heard.step("sweeping")
        return calibrate_sweep(
            bench,
            sweep,
            folder,
            exposures=exposures,
            on_progress=heard.frame,
            on_analysis=analysing(heard, control),
            on_event=heard.event,
            on_runner=control.follow,
        )


def analysing(heard: Listener, control: RunControl) -> Callable[[int, int], None]:
    """Return what hears how many PSFs have been analysed, and ends the analysis when it is asked to."""

    def on_analysis(done: int, total: int) -> None:
        control.check()
        if done == 0:
            heard.step("analysing")
        heard.share(done, total)

    return on_analysis


def sweep_outcome(done: SweepCalibration) -> Outcome:
    """Return what a sweep leaves, with its verdict in words."""
    return Outcome(
        verdict=tuple(quality_lines(done)),
        good=not done.findings,
        runs=tuple(run.path for run in done.runs),
        calibration=done.path,
        result=done,
    )
