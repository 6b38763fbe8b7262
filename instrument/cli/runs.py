"""Runs: carried out and gone on with (``run``, ``resume``), and what there is on disk (``list``)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from instrument.bench.config_file import load_config
from instrument.cli.app import App, BenchOption, RunFolder, examples, open_and_say
from instrument.files.errors import FileError
from instrument.plan.model import load_plan
from instrument.runs.inspection import run_paths, summary
from instrument.runs.run import Run
from instrument.runs.run_files import BENCH_TOML
from instrument.runs.writer import RunWriter

run_app, resume_app, list_app = App(), App(), App()


@list_app.command(name="list", epilog=examples("diffuserbench list", "diffuserbench list /data/monday"))
def list_runs(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="FOLDER", help="Default: data_folder of bench.toml.", show_default=False),
    ] = None,
    bench: BenchOption = None,
) -> None:
    """List the runs in a folder, the newest last: what became of each, its frames, its label.

    Images are looked at by their sizes, and read where an earlier reading found damage; verify reads all.
    """
    if folder is not None and not folder.is_dir():
        raise FileError(folder, "is no folder.", "Name the folder that holds the runs.")
    folder = folder or load_config(bench).data_folder
    if not folder.is_dir():
        typer.echo(f"{folder}: no such folder, so no runs yet.")
        return
    paths = run_paths(folder)
    if not paths:
        typer.echo(f"{folder}: no runs.")
        return
    table = Table(title=str(folder), title_justify="left", box=None)
    for heading in ("run", "became", "frames", "kind", "bench"):
        table.add_column(heading, overflow="fold", justify="right" if heading == "frames" else "left")
    for path in paths:
        found = summary(path)
        if found.condition is None:
            table.add_row(path.name, found.became, "", "", found.problem)
            continue
        kind = "recording" if found.is_recording else "plan"
        mark = "SIMULATED" if found.is_simulated else ""
        table.add_row(path.name, found.became, f"{found.stored} of {found.frames}", kind, mark)
    Console(width=None if Console().is_terminal else 160).print(table, markup=False)
    typer.echo("Images are known by their sizes and what was found before; verify reads them.", err=True)


@run_app.command(
    name="run",
    epilog=examples("diffuserbench run plan.toml", "diffuserbench run plan.toml --out /data/monday"),
)
def run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The plan, .toml or .json.")],
    files: RunFolder,
    bench: BenchOption = None,
) -> None:
    """Carry out a plan: one run folder, every frame with its metadata.

    Keys while it runs: p pauses (light off) and goes on, q ends it before the next step, s stops at once.
    The bench is checked first; a stage that is not homed is homed. Whatever happens, the light ends off and
    nothing moves; diffuserbench resume goes on with a run that did not end.
    """
    from calibration_routines.plan_procedures import PlanProcedure
    from instrument.cli.calibrate import carry_out_run

    plan = load_plan(file)
    files.check()
    with open_and_say(bench) as opened:
        done = carry_out_run(PlanProcedure(plan), opened, files.out or opened.config.data_folder)
    if isinstance(done.result, Run):
        files.draw(done.result)


@resume_app.command(
    name="resume", epilog=examples("diffuserbench resume runs/2026-11-21_14-03-22_axial-sweep")
)
def resume(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The run's folder.")],
    bench: BenchOption = None,
) -> None:
    """Go on with the first step whose data are not safely stored; repeat none that are. Mend what is damaged.

    Every frame that the run has is read first and held against its checksum; what was found is said. Missing
    and damaged frames are taken again, in completed runs too; those of a recording are marked as lost. Files
    that are damaged are made again from their copies; what is replaced goes into the run's folder "kept".
    The bench is the run's own bench.toml unless --bench names another; it is opened only where frames are to
    be taken. A sweep of calibrate becomes its calibration when its last frame is there, a run of calibrate
    angular or dpc its response or surface.
    """
    from calibration_routines.plan_procedures import ResumeProcedure, goes_on_with_frames, settled
    from instrument.cli.calibrate import TerminalListener, carry_out_run, print_outcome
    from instrument.runs.acquire import look
    from instrument.runs.run_control import RunControl

    with TerminalListener() as listener:
        listener.step("verifying the frames")
        found = look(run, listener.share)
        takes_frames = bool(found.todo) or goes_on_with_frames(run)
        if not takes_frames:
            outcome = settled(run, found, None, RunControl(), listener)
    if takes_frames:
        if bench is None and any(problem.name == BENCH_TOML for problem in found.files):
            with RunWriter.reopen(run, log_bytes=found.log_bytes) as writer:
                for words in writer.mended:
                    typer.echo(words)
            found = look(run)
        with open_and_say(bench or run / BENCH_TOML) as opened:
            carry_out_run(ResumeProcedure(run, found), opened, run)
    elif isinstance(outcome.result, Run):
        for words in outcome.verdict:
            typer.echo(f"{run}: {words}")
        if not outcome.good:
            raise typer.Exit(1)
    else:
        print_outcome(Console(), outcome)
