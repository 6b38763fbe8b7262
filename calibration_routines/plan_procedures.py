"""Plans, and runs that go on, as procedures: what ``run`` and ``resume`` do."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

from calibration_routines.display.kept_frames import going_on, kept_by
from calibration_routines.planned import home_if_needed, outlook_of
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.exposure import expose_patterns
from calibration_routines.purpose import REFUSED, completed
from calibration_routines.routine import Routine, routines
from instrument.bench.bench import Bench
from instrument.bench.photograph import Snapshot
from instrument.files.errors import BenchError, count
from instrument.plan import Plan, Step, check, estimate
from instrument.plan.illumination import IlluminationOptions
from instrument.runs.acquire import abilities_of, acquire, look, prepare_resume, settle
from instrument.runs.inspection import Verification, run_paths, verify
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import RunControl
from instrument.runs.run_files import PLAN, RunError, is_run, refuse_within
from instrument.runs.runner import Runner, discarded


@dataclass(frozen=True, slots=True)
class PlanProcedure(Procedure):
    """Carry out a plan."""

    plan: Plan

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold the plan against the bench's limits and the disk."""
        folder = folder or bench.config.data_folder
        check(self.plan, replace(abilities_of(bench, folder), stage_homed=True))
        return outlook_of(bench, self.plan, folder)

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Home where the plan moves, and take the frames."""
        home_if_needed(bench, listener, self.plan)
        listener.step(self.plan.label)
        return run_outcome(acquire(bench, self.plan, folder, on_progress=listener.frame, control=control))


@dataclass(frozen=True, slots=True)
class IlluminationProcedure(Procedure):
    """Photograph the scene in the light of one group of LEDs after the other, and in the dark."""

    asked: IlluminationOptions

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold its plan against the bench; an exposure that is to be found counts as the camera's present."""
        plan = self.asked.plan(bench.led_array, bench.camera.exposure_ms)
        found = PlanProcedure(plan).outlook(bench, folder)
        if self.asked.exposure_ms is not None:
            return found
        words = "The exposure is found first, by all LEDs and then each pattern: the brightest sets it."
        return replace(found, reasons=(*found.reasons, words))

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Find the exposure where none was asked for, and take the frames."""
        if self.asked.exposure_ms is None:
            listener.step("finding the exposure")
        plan = illumination_plan_for(bench, self.asked)
        listener.said(f"Exposure: {plan.parts[0].exposures_ms[0]:.4g} ms.")
        return PlanProcedure(plan).perform(bench, folder, control, listener)


def illumination_plan_for(bench: Bench, asked: IlluminationOptions) -> Plan:
    """Return the plan, its exposure found with what stands before the camera where none was asked for."""
    if asked.exposure_ms is not None:
        return asked.plan(bench.led_array)
    array = bench.led_array
    lights = asked.lights(array)
    patterns = [light.pattern() if array is None else light.on(array).pattern() for light in lights]
    return asked.plan(array, expose_patterns(bench, patterns))


@dataclass(frozen=True, slots=True)
class ResumeProcedure(Procedure):
    """Go on with a run that did not end, and make what a routine's run was taken for."""

    run: Path
    found: Verification | None = None
    """What looking at it found, by whoever looked before; None: it is looked when it goes on."""

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Say what is left to do, by the run's log and files; its frames are read when it goes on."""
        _refuse_nested(self.run)
        found = Run.open(self.run)
        abilities = replace(abilities_of(bench, self.run), stage_homed=True)
        looked = verify(found, read=False)
        words = str(looked).splitlines()
        if found.plan is None:
            return Outlook((*words, looked.remedy() or "A recording cannot go on."))
        todo = looked.todo
        if not todo:
            return Outlook(tuple(words))
        # What is left is held against the run's own camera settings once they are restored (prepare_resume).
        cost = estimate(found.plan, abilities, todo=todo, start=found.start)
        return replace(outlook_of(bench, found.plan, self.run, words), cost=cost)

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Verify what is stored, take the rest, and make the calibration, response or surface."""
        _refuse_nested(self.run)
        if self.found is None:
            listener.step("verifying the frames")
        looked = self.found or look(self.run, listener.share)
        if not looked.todo:
            return settled(self.run, looked, bench, control, listener)
        run, routine = Run.open(self.run), routine_of(self.run)
        if routine is not None and routine.purpose is not None:
            control.left = routine.purpose.left
        home_if_needed(bench, listener, run.plan)
        if routine is not None and routine.restore is not None:
            routine.restore(run, bench, looked.todo[0])
        runner = prepare_resume(bench, self.run, looked, on_progress=listener.frame)
        with discarded(runner):
            (self.run / REFUSED).unlink(missing_ok=True)  # of other frames than these will be
            listener.said(f"Found {looked}")
            for words in runner.mended:
                listener.said(words)
            if routine is not None and routine.watch is not None:
                routine.watch(bench, runner, listener)
            if routine is not None and routine.restore is not None:
                _restore_after_gaps(runner, partial(routine.restore, run, bench), looked.todo)
            listener.step(run.label)
            control.follow(runner)
        run = runner.execute()
        frames = run_outcome(run)
        if run.condition is RunCondition.COMPLETED and lacks_result(self.run):
            for words in frames.verdict:
                listener.said(words)
        return finished(run, bench, control, listener) or _with_damage(frames, looked)


def _restore_after_gaps(runner: Runner, restore: Callable[[int], None], todo: Sequence[int]) -> None:
    """Have what no plan tells brought back also where steps that are there lie between two that are not."""
    following, seen = dict(pairwise(todo)), runner.on_frame

    def watch(step: Step, snapshot: Snapshot) -> bool:
        anew = seen is not None and seen(step, snapshot)
        if (after := following.get(step.index, 0)) <= step.index + 1:
            return anew
        restore(after)
        return True

    runner.on_frame = watch


def settled(
    path: Path, found: Verification, bench: Bench | None, control: RunControl, listener: Listener
) -> Outcome:
    """Mend a run that needs no frames taken, and make the result that it lacks (``bench`` if it is open)."""
    done = settle(path, found)
    run = Run.open(path)
    if run.plan is None:
        words = f"a recording, {found.condition}; there is nothing to go on with."
        if command := kept_by(run):
            frames = f"{len(run.records)} frames of {command}"
            words = f"{frames}. To have them seen again, and what they lack taken: {going_on(run)}"
        elif done:
            there, bare = len(run.records) + len(run.unlisted), len(run.unlisted)
            words = f"a recording, {run.condition}, with {there} of {run.n_frames} frames"
            words += f", {bare} of them without metadata." if bare else "."
    else:
        words = f"complete already, {run.n_frames} frames read back, all as they were written."
        if result := result_of(path):
            words += f" To have them analysed again, move {result} away first."
    if lacks_result(path):
        for line in (*done, words):
            listener.said(line)
    return finished(run, bench, control, listener) or _with_damage(
        Outcome(verdict=(*done, words), good=True, runs=(path,), result=run), found
    )


def _with_damage(outcome: Outcome, found: Verification) -> Outcome:
    """Say with what became of a run's frames which results, made of them before, are damaged."""
    if not found.results:
        return outcome
    words = "What was made of the frames is damaged: " + " ".join(map(str, found.results))
    return replace(outcome, verdict=(*outcome.verdict, words), good=False)


def _refuse_nested(run: Path) -> None:
    """Refuse to go on with a run within another (earlier versions made such) where frames may be taken again.

    They are kept in a run beside it, which would be refused when everything else is done.

    Raises RunError.
    """
    routine = routine_of(run)
    if routine is None or not (routine.finish_takes_frames or routine.watch) or not lacks_result(run):
        return
    try:
        refuse_within(run.parent)
    except RunError as error:
        where = [place.parent for place in run.resolve().parents if is_run(place)][-1]
        raise RunError(
            run,
            "lies within another run, where none is kept that takes frames again.",
            f"Move it to {where}.",
        ) from error


def routine_of(run: Path) -> Routine | None:
    """Return the routine whose results are made of such runs; None for every other run."""
    return next((one for one in routines.values() if one.purpose and one.purpose.is_of(run)), None)


def result_of(run: Path) -> Path | None:
    """Return where the result of a routine's run is; None where it has none, or goes on with other frames."""
    routine = routine_of(run)
    if routine is None or routine.purpose is None or routine.finish_takes_frames:
        return None
    result = routine.purpose.kept(run)
    return result if result.exists() else None


def lacks_result(run: Path) -> bool:
    """Whether a run's frames are those of a routine, and its result is not there yet."""
    routine = routine_of(run)
    return routine is not None and routine.purpose is not None and routine.purpose.lacks_result(run)


def goes_on_with_frames(run: Path) -> bool:
    """Whether a run whose frames are there is finished by taking those of further runs."""
    routine = routine_of(run)
    return routine is not None and routine.finish_takes_frames and lacks_result(run)


def why_no_result(run: Path) -> str:
    """Return why the frames of a complete run give no result; empty where nobody found that they do not."""
    file = run / REFUSED
    try:
        return file.read_text("utf-8").strip() if file.is_file() else ""
    except (OSError, UnicodeDecodeError) as error:
        return f"{file} cannot be read: {error}"


def can_go_on(run: Run, looked: Verification) -> bool:
    """Whether resuming a run would do something: take frames, mend files, make its result."""
    left = bool(looked.remedy()) or run.condition is RunCondition.CRASHED
    whole = run.plan is None or run.condition is RunCondition.COMPLETED
    lacks = lacks_result(run.path) and not why_no_result(run.path)
    return (left or not whole or lacks) and run.condition is not RunCondition.RUNNING


def unfinished(path: Path | None) -> Path | None:
    """Return a run that can go on; None for every other, and for what cannot be read."""
    if path is None:
        return None
    try:
        run = Run.open(path)
        return path if can_go_on(run, verify(run, read=False)) else None
    except (BenchError, OSError):
        return None


def left_unfinished(folder: Path, names: Collection[str]) -> Path | None:
    """Return a folder's newest run of some routines (``"plan"``: of none) if it did not end, else None.

    Recordings are none of them: what they lack, another film takes.
    """
    for path in reversed(run_paths(folder)):
        routine = routine_of(path)
        of = routine.name if routine else "plan" if (path / PLAN).exists() else ""
        if of in names:
            return unfinished(path)
    return None


def finished(run: Run, bench: Bench | None, control: RunControl, listener: Listener) -> Outcome | None:
    """Make the result of a routine's run that lacks it; None for every other run.

    Raises RunEndedError when the run is not complete.
    """
    routine = routine_of(run.path)
    if routine is None or routine.finish is None or not lacks_result(run.path):
        return None
    completed(run, remedy="It can be resumed.")
    return routine.finish(run, bench, control, listener)


def run_outcome(run: Run) -> Outcome:
    """Return what a run leaves, in words: frames, drops, saturation."""
    mark = " SIMULATED" if run.is_simulated else ""
    words = [f"{run.condition}: {len(run.records)} of {run.n_frames} frames{mark}"]
    dropped = sum(record.metadata.dropped_before for record in run.records.values())
    saturated = [i for i, record in run.records.items() if record.metadata.saturated_fraction > 0]
    if dropped:
        words.append(f"The camera dropped {count(dropped, 'frame')} between these.")
    if len(saturated) == 1:
        words.append(f"Frame {saturated[0]} has saturated pixels.")
    elif saturated:
        words.append(f"{len(saturated)} frames have saturated pixels, the first is frame {saturated[0]}.")
    complete = run.condition is RunCondition.COMPLETED
    return Outcome(
        verdict=tuple(words), good=complete and not dropped and not saturated, runs=(run.path,), result=run
    )
