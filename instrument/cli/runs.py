"""Runs: carried out and gone on with (``run``, ``resume``); on disk (``list``, ``verify``, ``export``)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from instrument.bench.config_file import load_config
from instrument.cli.app import App, BenchOption, RunFolder, examples, open_and_say
from instrument.cli.options import Given
from instrument.cli.progress import one_task
from instrument.files.errors import BenchError, FileError
from instrument.files.volumes import is_zarr_name, uneven_steps
from instrument.plan.model import load_plan
from instrument.runs.export import export as export_run
from instrument.runs.inspection import run_paths, summary
from instrument.runs.inspection import verify as verify_run
from instrument.runs.run import Run
from instrument.runs.run_files import BENCH_TOML
from instrument.runs.writer import RunWriter
from recon.base.declare import option

run_app, resume_app, list_app, verify_app, export_app = App(), App(), App(), App(), App()


@list_app.command(name="list", epilog=examples("diffuserbench list", "diffuserbench list /data/monday"))
def list_runs(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="FOLDER", help="Default: data_folder of bench.toml.", show_default=False),
    ] = None,
    bench: BenchOption = None,
) -> None:
    """List the runs in a folder, the newest last: what became of each, its frames, its label."""
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


@verify_app.command(
    epilog=examples(
        "diffuserbench verify runs/2026-11-21_14-03-22_axial-sweep", "diffuserbench verify runs/*"
    )
)
def verify(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="The runs' folders.")],
) -> None:
    """Read every frame and its metadata and hold them against the log's checksums. Changes nothing.

    Exit status 1 when anything is not as it was written. A run that ended early is sound, only not complete.
    """
    sound = True
    for path in runs:
        run = Run.open(path)
        with one_task(path.name) as advance:
            found = verify_run(run, advance)
        for line in found.lines():
            typer.echo(f"{path}: {line}", err=True)
        if remedy := found.remedy():
            typer.echo(f"{path}: {remedy}", err=not found.is_sound)
        sound = sound and found.is_sound
        verdict = "sound" if found.is_sound else "DAMAGED"
        typer.echo(f"{path}: {verdict}, {run.condition}, {found.frames} of {run.n_frames} frames read back.")
    if not sound:
        raise typer.Exit(1)


def _slice(text: str) -> slice:
    if not re.fullmatch(r"-?\d+|-?\d*:-?\d*(:-?[1-9]\d*)?", text):
        raise ValueError("give A:B, e.g. 0:100, or one number.")
    numbers = [int(part) if part else None for part in text.split(":")]
    if len(numbers) == 1 and numbers[0] is not None:
        return slice(numbers[0], numbers[0] + 1)
    return slice(*numbers)


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Which frames of a run are written, how fast a film of them plays, and on which voxels a volume."""

    label: str | None = option(None, help="Only steps of this label.", applies=("run",))
    frames: slice | None = option(
        None,
        help="Only frames A to B - 1; A:B:C every C-th.",
        metavar="A:B",
        applies=("run",),
        parse=_slice,
    )
    frames_per_s: float | None = option(
        None,
        help="Frames a second of an MP4.",
        least=0.1,
        flags=("--fps",),
        applies=("run",),
    )
    metric: bool = option(
        False,
        help="On voxels of one size, upright: each plane of a reconstruction has a pitch of its own.",
        applies=("volume",),
    )
    voxel_um: float | None = option(
        None,
        help="Edge of the voxels, cubes, with --metric.",
        default_words="the middle plane's pixels and the step beside it",
        unit="um",
        above=0,
        applies=("volume",),
    )


@export_app.command(
    epilog=examples(
        "diffuserbench export RUN psfs.ome.tif --label psf",
        "diffuserbench export RUN video.mp4",
        "diffuserbench export RUN frames/ --frames 0:100",
        "diffuserbench export volume.tif volume.ome.zarr --metric",
    )
)
def export(
    run: Annotated[
        Path, typer.Argument(metavar="RUN|RESULT", help="The run's folder; or a reconstruction's file.")
    ],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="TARGET",
            help="File ending in .ome.tif, .tif, .h5, .npy or .mp4, or a folder for PNG files. "
            "A picture: .tif, .npy, .png; a volume: .tif, .npy, .ome.zarr.",
        ),
    ],
    options: ExportOptions,
    given: Given,
) -> None:
    """Write a run's stored frames, or a reconstruction, for other programs; what is there stays as it is.

    Frames that are not there (gaps of a recording, steps not done) are left out, and said.
    """
    if _is_result(run):
        _export_result(run, out, options, given)
        return
    given.refuse("a run", "run")
    found = Run.open(run)
    wanted = set(range(found.n_frames)[options.frames or slice(None)])
    if options.label is not None:
        wanted &= {step.index for step in found.steps(options.label)}
    indices = [index for index in sorted(found.records) if index in wanted]
    with one_task("Frames") as advance:
        export_run(found, out, indices, frames_per_s=options.frames_per_s, on_progress=advance)
    typer.echo(f"Wrote {len(indices)} frames: {out}")
    if absent := len(wanted) - len(indices):
        typer.echo(f"Warning: {absent} frames that are not in the run were left out.", err=True)


def _is_result(path: Path) -> bool:
    """Whether a path is a picture's or volume's: a file, or a Zarr folder, which no run is."""
    return path.is_file() or is_zarr_name(path)


def _export_result(path: Path, target: Path, options: ExportOptions, given: Given) -> None:
    from instrument.reconstruction.stored_result import export_result, open_result

    result = open_result(path)
    try:
        kind = "picture" if result.volume is None else "volume"
        given.refuse(f"a {kind}", kind)
        if options.voxel_um is not None and not options.metric:
            raise BenchError("--voxel-um is the size of --metric's voxels: give --metric too.")
        if options.metric:
            result = result.metric(options.voxel_um)
            typer.echo(f"{'Voxels':<12}{result.voxels_in_words()}")
        with one_task("Planes") as advance:
            export_result(result, target, advance=advance)
        steps = "" if result.planes_um is None else uneven_steps(result.planes_um[0])
    finally:
        result.close()
    typer.echo(f"Wrote {target}")
    if steps and target.suffix.lower() != ".npy":
        typer.echo(f"{'Planes':<12}{steps}")


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
    with open_and_say(bench) as opened:
        carry_out_run(PlanProcedure(plan), opened, files.out or opened.config.data_folder)


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
    from calibration_routines.plan_procedures import ResumeProcedure, settled
    from instrument.cli.calibrate import TerminalListener, carry_out_run, print_outcome
    from instrument.runs.acquire import look
    from instrument.runs.run_control import RunControl

    with TerminalListener() as listener:
        listener.step("verifying the frames")
        found = look(run, listener.share)
        if not found.todo:
            outcome = settled(run, found, None, RunControl(), listener)
    if found.todo:
        if bench is None and any(problem.name == BENCH_TOML for problem in found.files):
            with RunWriter.reopen(run, log_bytes=found.log_bytes) as writer:
                for words in writer.mended or ():
                    typer.echo(words)
            found = look(run)
        with open_and_say(bench or run / BENCH_TOML) as opened:
            carry_out_run(ResumeProcedure(run, found), opened, run)
    elif isinstance(outcome.result, Run):
        for words in outcome.verdict:
            typer.echo(f"{run}: {words}")
    else:
        print_outcome(Console(), outcome)
