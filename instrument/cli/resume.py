"""``diffuserbench resume``: go on with a run that was aborted, stopped, failed or killed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from calibration_routines import finish_sweep, is_sweep, watch_resumed
from calibration_routines.plan_procedures import finish_simple
from calibration_routines.psf.sweep import FOLDER
from calibration_routines.psf.sweep_procedure import event_lines
from instrument.bench.bench import Bench
from instrument.cli.app import App, BenchOption, examples, open_and_say
from instrument.cli.progress import one_task, progress_bar
from instrument.cli.running import carry_out, home_if_needed
from instrument.cli.sweeping import describe_result, print_lines
from instrument.runs.layout import BENCH_TOML, FinishReason, RunCondition
from instrument.runs.resume import prepare_resume
from instrument.runs.run import Run
from instrument.runs.writer import RunWriter

app = App()


@app.command(name="resume", epilog=examples("diffuserbench resume runs/2026-11-21_14-03-22_axial-sweep"))
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
    found = Run.open(run)
    if found.plan is None:
        _close_recording(found)
        return
    if found.condition is RunCondition.COMPLETED and not found.missing():
        typer.echo(f"{run}: complete already, {found.n_frames} frames. diffuserbench verify reads them all.")
        if is_sweep(run) and not (run / FOLDER).exists():
            _finish(run, None)
        _finish_others(found)
        return
    with open_and_say(bench or run / BENCH_TOML) as opened:
        home_if_needed(opened, found.plan)
        with progress_bar() as bar:
            task = bar.add_task("Verifying", total=len(found.records), note="")
            runner, findings = prepare_resume(
                opened, run, on_verify=lambda done, _: bar.update(task, completed=done)
            )
        typer.echo(f"Found {findings}", err=True)
        if is_sweep(run):
            console = Console(stderr=True)
            watch_resumed(opened, runner, lambda event: print_lines(console, event_lines(event)))
        done = carry_out(opened, runner)
        if done.condition is RunCondition.COMPLETED:
            if is_sweep(run):
                _finish(run, opened)
            _finish_others(done)


def _finish(run: Path, bench: Bench | None) -> None:
    """Make a sweep's calibration of its complete run, with retakes where there is a bench."""
    with one_task("Analysing") as advance:
        done = finish_sweep(run, bench, on_analysis=advance)
    describe_result(Console(), done)


def _finish_others(run: Run) -> None:
    """Make the result of a complete run of calibrate angular or dpc that has none yet."""
    with one_task("Analysing"):
        outcome = finish_simple(run)
    if outcome is None:
        return
    print_lines(Console(), [*outcome.verdict, *(f"Wrote        {file}" for file in outcome.files)])


def _close_recording(run: Run) -> None:
    if run.condition is not RunCondition.CRASHED:
        typer.echo(f"{run.path}: a recording, {run.condition}; there is nothing to go on with.")
        return
    with RunWriter.reopen(run.path) as writer:
        closed = writer.finish(FinishReason.ABORTED, "its program ended without finishing it")
    typer.echo(f"{run.path}: the recording was cut off; closed with its {len(closed.records)} frames.")
