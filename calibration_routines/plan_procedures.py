"""Plans, and runs that go on, as procedures: what ``run`` and ``resume`` do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from calibration_routines.errors import completed
from calibration_routines.procedure import (
    Listener,
    Outcome,
    Outlook,
    Routine,
    home_if_needed,
    outlook_of,
    routines,
    under_control,
)
from calibration_routines.psf.sweep import FOLDER, finish_sweep, watch_resumed
from calibration_routines.psf.sweep_procedure import analysing, sweep_outcome
from calibration_routines.psf.sweep_record import is_sweep
from instrument.bench.bench import Bench
from instrument.plan import Plan, check, estimate
from instrument.runs.acquire import abilities_of, prepare, prepare_resume
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import RunControl


@dataclass(frozen=True, slots=True)
class PlanProcedure:
    """Carry out a plan."""

    plan: Plan

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold the plan against the bench's limits and the disk."""
        folder = folder or bench.config.data_folder
        check(self.plan, replace(abilities_of(bench, folder), stage_homed=True))
        return outlook_of(bench, self.plan, folder)

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Home where the plan moves, and take the frames."""
        heard = listener or Listener()
        self.outlook(bench, folder)
        with under_control(bench, control) as control:
            home_if_needed(bench, heard, self.plan)
            heard.step(self.plan.label)
            run = prepare(bench, self.plan, folder, on_progress=heard.frame, control=control).execute()
        return run_outcome(run)


@dataclass(frozen=True, slots=True)
class ResumeProcedure:
    """Go on with a run that did not end, and make what a calibration's run was taken for."""

    run: Path

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Say what is left to do, by the run's log; its frames are read when it goes on."""
        found = Run.open(self.run)
        abilities = replace(abilities_of(bench, self.run), stage_homed=True)
        if found.plan is None:
            return Outlook(("A recording cannot go on.",))
        todo = found.missing()
        words = f"{found.condition}: {len(found.records)} of {found.n_frames} frames are stored"
        if not todo:
            return Outlook((words,))
        check(found.plan, abilities, todo=todo, start=found.start)
        cost = estimate(found.plan, abilities, todo=todo, start=found.start)
        return replace(outlook_of(bench, found.plan, self.run, [words]), cost=cost)

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Verify what is stored, take the rest, and make the calibration, response or surface."""
        heard = listener or Listener()
        with under_control(bench, control) as control:
            found = Run.open(self.run)
            whole = found.condition is RunCondition.COMPLETED and not found.missing()
            if found.plan is not None and not whole:
                home_if_needed(bench, heard, found.plan)
                heard.step("verifying the frames")
                runner, findings = prepare_resume(
                    bench, self.run, on_verify=heard.share, on_progress=heard.frame
                )
                heard.said(f"Found {findings}")
                if is_sweep(self.run):
                    watch_resumed(bench, runner, heard.event)
                heard.step(found.label)
                control.follow(runner)
                found = runner.execute()
            lacks = lacks_result(self.run)
            if lacks:
                completed(found, remedy="It can be resumed.")
                heard.step("analysing")
            if (outcome := finish_simple(found)) is not None:
                return outcome
            if lacks:
                done = finish_sweep(
                    self.run,
                    bench,
                    on_progress=heard.frame,
                    on_analysis=analysing(heard, control),
                    on_runner=control.follow,
                )
                return sweep_outcome(done)
        return run_outcome(found)


def lacks_result(run: Path) -> bool:
    """Whether a run's frames are those of a calibration, and its result is not there yet."""
    return (is_sweep(run) and not (run / FOLDER).exists()) or _unfinished(run) is not None


def finish_simple(run: Run) -> Outcome | None:
    """Make the result of a complete run of a routine other than a sweep that has none yet.

    Returns
    -------
    Outcome or None
        None for every other run.
    """
    routine = _unfinished(run.path)
    return None if routine is None or routine.finish is None else routine.finish(run)


def _unfinished(run: Path) -> Routine | None:
    return next((routine for routine in routines.values() if routine.lacks_result(run)), None)


def run_outcome(run: Run) -> Outcome:
    """Return what a run leaves, in words: frames, drops, saturation."""
    words = [f"{run.condition}: {len(run.records)} of {run.n_frames} frames"]
    dropped = sum(record.metadata.dropped_before for record in run.records.values())
    saturated = [i for i, record in run.records.items() if record.metadata.saturated_fraction > 0]
    if dropped:
        words.append(f"The camera dropped {dropped} frames between these.")
    if saturated:
        words.append(f"{len(saturated)} frames have saturated pixels, the first is frame {saturated[0]}.")
    complete = run.condition is RunCondition.COMPLETED
    return Outcome(
        verdict=tuple(words), good=complete and not dropped and not saturated, runs=(run.path,), result=run
    )
