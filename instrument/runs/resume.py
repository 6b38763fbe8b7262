"""Continue a run that was aborted, stopped, failed, or whose program was killed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from instrument.bench.bench import Bench
from instrument.bench.camera_settings import restore_camera
from instrument.bench.photograph import Progress
from instrument.plan import check
from instrument.runs.acquire import abilities_of
from instrument.runs.run import DamagedFrame, Run, RunCondition, RunError
from instrument.runs.runner import Runner, RunProgress
from instrument.runs.writer import RunWriter


@dataclass(frozen=True, slots=True)
class RunFindings:
    """What was found in a run's folder before it is continued.

    Attributes
    ----------
    condition : RunCondition
        How the run was left.
    stored : int
        Frames that are on the disk as they were written; none of them is taken again.
    todo : tuple of int
        Steps whose data are not safely stored, in order.
    damaged : tuple of DamagedFrame
        Frames among them that the log calls written, but that are not as they were.
    torn_bytes : int
        Length of the half line that a crash left at the end of the log.
    unlogged : int
        Frames among them whose image had reached the disk, but not their line in the log.
    """

    condition: RunCondition
    stored: int
    todo: tuple[int, ...]
    damaged: tuple[DamagedFrame, ...] = ()
    torn_bytes: int = 0
    unlogged: int = 0

    def __str__(self) -> str:
        lines = [f"{self.condition}: {self.stored} frames safely stored, {len(self.todo)} to do"]
        if self.todo:
            lines[0] += f", first step {self.todo[0]}"
        if self.torn_bytes:
            lines.append(f"the log ended in a half line of {self.torn_bytes} bytes (dropped)")
        if self.unlogged:
            lines.append(f"{self.unlogged} images without their line in the log (taken again)")
        lines += [f"frame {frame.index}: {frame.problem} (taken again)" for frame in self.damaged]
        return "\n  ".join(lines)


def inspect(run: Run, on_progress: Progress | None = None) -> RunFindings:
    """Read every frame that a run's log calls written, and say what is left to do.

    Parameters
    ----------
    run : Run
        Of a plan.
    on_progress : callable, optional
        Called with frames read and frames to read.

    Raises
    ------
    RunError
        When the run is a recording.
    """
    if run.plan is None:
        raise RunError(run.path, "is a recording; only runs of a plan can be continued.")
    damaged: dict[int, DamagedFrame] = {}
    for count, index in enumerate(sorted(run.records), start=1):
        if (problem := run.verify(index)) is not None:
            damaged[index] = problem
        if on_progress is not None:
            on_progress(count, len(run.records))
    todo = tuple(i for i in range(len(run.plan)) if i not in run.records or i in damaged)
    unlogged = 0
    if run.has_frames:
        unlogged = sum(i not in run.records and run.array.chunk_path(i).exists() for i in todo)
    return RunFindings(
        condition=run.condition,
        stored=len(run.plan) - len(todo),
        todo=todo,
        damaged=tuple(damaged.values()),
        torn_bytes=run.torn_bytes,
        unlogged=unlogged,
    )


def prepare_resume(
    bench: Bench,
    path: Path | str,
    *,
    on_verify: Callable[[int, int], None] | None = None,
    on_progress: RunProgress | None = None,
) -> tuple[Runner, RunFindings]:
    """Verify a run and return the runner of the steps that are left, with what was found.

    The camera gets the settings that it had when the run began. Settings that the plan left as they were
    are brought back as the steps before had them.

    Parameters
    ----------
    bench : Bench
        Open; as a rule from the run's own ``bench.toml``.
    path : path
        The run's folder.
    on_verify : callable, optional
        Called with frames verified and frames to verify.
    on_progress : callable, optional
        As in :func:`instrument.runs.acquire.acquire`.

    Raises
    ------
    RunError
        When the folder is no run of a plan, or some program writes to it.
    PlanError
        When the bench cannot do what is left.
    DeviceError, BenchError
        When the camera does not take the settings of the run.
    """
    before = Run.open(path)
    condition = before.condition  # asked before this program's own lock answers "running"
    writer = RunWriter.reopen(before.path)
    try:
        run = Run.open(path)
        findings = replace(inspect(run, on_verify), condition=condition, torn_bytes=before.torn_bytes)
        plan = run.plan
        assert plan is not None  # inspect has refused recordings
        restore_camera(bench.camera, run.provenance["camera"])
        check(plan, abilities_of(bench, run.path), todo=findings.todo, start=run.start)
        writer.note("found", text=str(findings))
    except BaseException:
        writer.close()
        raise
    runner = Runner(bench, plan, writer, start=run.start, todo=findings.todo, on_progress=on_progress)
    return runner, findings
