"""What ``run`` and ``resume`` share: homing, the progress bar, keys, the last words."""

from __future__ import annotations

import time

import typer

from instrument.bench.bench import Bench
from instrument.bench.safety import StepsFailedError
from instrument.cli.progress import keys, progress_bar
from instrument.files.formatting import duration, size
from instrument.plan import Plan
from instrument.runs.acquire import free_bytes
from instrument.runs.layout import RunCondition
from instrument.runs.run import Run
from instrument.runs.runner import Runner, RunState, RunStatus


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
