"""``diffuserbench run`` and ``diffuserbench resume``: carry out a plan, go on with one that did not end."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from instrument.bench.bench import Bench
from instrument.bench.safety import StepsFailedError
from instrument.cli.app import App, BenchOption, examples, open_and_say
from instrument.cli.progress import keys, progress_bar
from instrument.files.formatting import duration, size
from instrument.plan import Plan, check
from instrument.plan.file import load_plan
from instrument.runs.acquire import abilities_of, free_bytes, prepare
from instrument.runs.resume import prepare_resume
from instrument.runs.run import BENCH_TOML, FinishReason, Run, RunCondition
from instrument.runs.runner import Runner, RunState, RunStatus
from instrument.runs.writer import RunWriter

run_app, resume_app = App(), App()


@run_app.command(
    name="run",
    epilog=examples("diffuserbench run plan.toml", "diffuserbench run plan.toml --out /data/monday"),
)
def run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The plan, .toml or .json.")],
    bench: BenchOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FOLDER",
            help="Where the run's folder is made. Default: data_folder of bench.toml.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Carry out a plan: one run folder, every frame with its metadata.

    Keys while it runs: p pauses (light off) and goes on, q ends it before the next step, s stops at once.
    The bench is checked first; a stage that is not homed is homed. Whatever happens, the light ends off and
    nothing moves; diffuserbench resume goes on with a run that did not end.
    """
    plan = load_plan(file)
    with open_and_say(bench) as opened:
        folder = out or opened.config.data_folder
        check(plan, replace(abilities_of(opened, folder), stage_homed=True))
        home_if_needed(opened, plan)
        runner = prepare(opened, plan, folder)
        carry_out(opened, runner)


def home_if_needed(bench: Bench, plan: Plan) -> None:
    """Home the stage when the plan places anything and the stage has no reference yet."""
    moves = any(part.positions is not None for part in plan.parts)
    if moves and bench.stage is not None and not bench.stage.is_homed:
        typer.echo("Homing the stage.", err=True)
        bench.stage.home()


def carry_out(bench: Bench, runner: Runner) -> Run:
    """Execute a runner with a progress bar and keys, and say how it ended and what to do next."""
    free_at_s, free = 0.0, 0
    with progress_bar() as bar:
        task = bar.add_task("Frames", total=runner.status.total, note="")

        def report(status: RunStatus) -> None:
            nonlocal free_at_s, free
            if time.monotonic() - free_at_s > 1:
                free_at_s, free = time.monotonic(), free_bytes(runner.path)
            bar.update(task, completed=status.done, note=_note(status, free))

        runner.on_progress = report

        def toggle() -> None:
            runner.resume() if runner.is_pausing else runner.pause()

        def stop() -> None:
            try:
                runner.stop()
            except StepsFailedError as failure:
                typer.echo(str(failure), err=True)

        with keys({"p": toggle, "q": runner.abort, "s": stop}):
            run = runner.execute()
    _last_words(bench, run, runner.status)
    return run


def _note(status: RunStatus, free: int) -> str:
    if status.state is RunState.PAUSED:
        return "PAUSED, light off: p goes on, q ends"
    rate = status.done_here / status.seconds if status.seconds else 0.0
    words = [f"{rate:.1f}/s", f"{size(free)} free"]
    words += [f"DROPPED {status.dropped}"] if status.dropped else []
    words += [f"SATURATED {status.saturated_fraction:.2%}"] if status.saturated_fraction else []
    return "  ".join(words)


def _last_words(bench: Bench, run: Run, status: RunStatus) -> None:
    mark = " SIMULATED" if run.is_simulated else ""
    typer.echo(
        f"{run.condition}: {len(run.records)} of {run.n_frames} frames in {duration(status.seconds)}{mark}"
    )
    if status.dropped:
        typer.echo(f"Warning: the camera dropped {status.dropped} frames between these.", err=True)
    saturated = [i for i, record in run.records.items() if record.metadata.saturated_fraction > 0]
    if saturated:
        typer.echo(
            f"Warning: {len(saturated)} frames have saturated pixels, the first is frame {saturated[0]}.",
            err=True,
        )
    typer.echo(f"Run: {run.path}")
    if run.condition is not RunCondition.COMPLETED:
        typer.echo(f"Go on with: diffuserbench resume {run.path}")
    typer.echo(f"Light off, nothing moving: {bench.label}", err=True)


@resume_app.command(
    name="resume", epilog=examples("diffuserbench resume runs/2026-11-21_14-03-22_axial-sweep")
)
def resume(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The run's folder.")],
    bench: BenchOption = None,
) -> None:
    """Go on with the first step whose data are not safely stored; repeat none that are.

    Every frame that the run has is read first and held against its checksum; what was found is said. The
    bench is the run's own bench.toml unless --bench names another. A recording cannot go on; one that was
    cut off is closed, so that it reads as what it is. A sweep of calibrate becomes its calibration when its
    last frame is there, a run of calibrate angular or dpc its response or surface.
    """
    from calibration_routines.plan_procedures import routine_of
    from instrument.cli.calibrate import TerminalListener

    found = Run.open(run)
    if found.plan is None:
        _close_recording(found)
        return
    if found.condition is RunCondition.COMPLETED and not found.missing():
        typer.echo(f"{run}: complete already, {found.n_frames} frames. diffuserbench verify reads them all.")
        _finish(found, None)
        return
    with open_and_say(bench or run / BENCH_TOML) as opened:
        home_if_needed(opened, found.plan)
        with progress_bar() as bar:
            task = bar.add_task("Verifying", total=len(found.records), note="")
            runner, findings = prepare_resume(
                opened, run, on_verify=lambda done, _: bar.update(task, completed=done)
            )
        typer.echo(f"Found {findings}", err=True)
        routine = routine_of(run)
        if routine is not None and routine.watch is not None:
            routine.watch(opened, runner, TerminalListener(Console(stderr=True)))
        done = carry_out(opened, runner)
        if done.condition is RunCondition.COMPLETED:
            _finish(done, opened)


def _finish(run: Run, bench: Bench | None) -> None:
    """Make the result of a routine's complete run that has none yet, with retakes where there is a bench."""
    from calibration_routines.plan_procedures import finished
    from instrument.cli.calibrate import TerminalListener, print_outcome
    from instrument.runs.run_control import RunControl

    with TerminalListener() as listener:
        outcome = finished(run, bench, RunControl(), listener)
    if outcome is not None:
        print_outcome(Console(), outcome)


def _close_recording(run: Run) -> None:
    if run.condition is not RunCondition.CRASHED:
        typer.echo(f"{run.path}: a recording, {run.condition}; there is nothing to go on with.")
        return
    with RunWriter.reopen(run.path) as writer:
        closed = writer.finish(FinishReason.ABORTED, "its program ended without finishing it")
    typer.echo(f"{run.path}: the recording was cut off; closed with its {len(closed.records)} frames.")
