"""``diffuserbench calibrate`` and ``align``: a command for each registered routine, made of its options."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TaskID

from calibration_routines.optics.bead_photographs import BeadSlides, mean_images
from calibration_routines.optics.beads import (
    BeadCalibration,
    BeadFiles,
    calibrate_beads,
    psf_lines,
    save_beads,
)
from calibration_routines.plan_procedures import run_outcome
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.sweep_plan import SweepExposures
from calibration_routines.psf.sweep_procedure import event_lines, event_note, exposure_lines
from calibration_routines.psf.sweep_watch import SweepEvent
from calibration_routines.purpose import RunEndedError
from calibration_routines.rehearsal import rehearse_whole
from calibration_routines.routine import Routine, routines
from calibration_routines.times import IN_ALL
from instrument.bench.bench import Bench
from instrument.bench.config import BenchConfig
from instrument.bench.config_file import other_bench_for
from instrument.bench.safety import StepsFailedError
from instrument.cli.app import App, BenchOption, examples, load_and_say, open_and_say
from instrument.cli.plan import rehearsal
from instrument.cli.progress import keys, one_task, progress_bar
from instrument.files import kept_times
from instrument.files.atomic import free_bytes
from instrument.files.errors import BenchError, duration, percent, size
from instrument.files.images import read_image
from instrument.runs.acquire import abilities_of
from instrument.runs.rehearsal import rehearsed
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import RunControl
from instrument.runs.run_files import refuse_within
from instrument.runs.runner import RunState, RunStatus
from instrument.tasks.task import Given
from recon.arrays import Float32Array
from recon.base.declare import options_of
from recon.types import Geometry

RunFolder = Annotated[
    Path | None,
    typer.Option(
        "--out", metavar="FOLDER", help="Where the run's folder goes; left out: the bench's data folder."
    ),
]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Only say what would be done, and why; nothing moves.")
]
_HELP = {
    "calibrate": "Measure PSFs, the sensor's angular response, the diffuser, or how an SLM answers.",
    "align": "Align the holographic display.",
}
BEADS = "beads"
_TIME = ": about "  # what an outlook says of the time goes by earlier runs
_SHORT = 8
"""Plans of no more than so many times the frames of their rehearsal begin without one."""
_LABELS = {".png": "Picture", ".tif": "Photograph"}


def __getattr__(name: str) -> App:
    """Give ``app`` and ``align_app`` with what is registered when they are asked for."""
    if name in ("app", "align_app"):
        return app_of("align" if name == "align_app" else "calibrate")
    raise AttributeError(name)


def app_of(command: str) -> App:
    """Return the application of a command with a subcommand for each of its routines."""
    app = App(_HELP[command])

    @app.callback()
    def begin() -> None:
        pass

    begin.__doc__ = _HELP[command]
    for routine in routines.values():
        if routine.command == command:
            made = _beads if routine.name == BEADS else _function(routine)
            app.command(routine.name, epilog=examples(*routine.examples), help=_help(routine))(made)
    return app


def _help(routine: Routine) -> str:
    return f"{routine.help}\n\n{routine.details}".rstrip()


def _function(routine: Routine) -> Callable[..., None]:
    """Return the function of a command: the routine's options, and where it takes place."""

    def with_file(options: Any, dry_run: DryRun = False, bench: BenchOption = None) -> None:
        if options.out is None:
            options = replace(options, out=Path(routine.file))
        carry_out(routine, options, bench, dry_run=dry_run)

    def with_run(
        options: Any, dry_run: DryRun = False, out: RunFolder = None, bench: BenchOption = None
    ) -> None:
        carry_out(routine, options, bench, out, dry_run=dry_run)

    def with_files(
        options: Any,
        files: Any,
        given: Given,
        dry_run: DryRun = False,
        out: RunFolder = None,
        bench: BenchOption = None,
    ) -> None:
        _of_files_or_bench(routine, options, files, given, dry_run, out, bench)

    def needs_another_bench(given: Mapping[str, Any]) -> None:
        _config_for(routine, given["bench"])

    function: Callable[..., Any] = with_file if routine.file else with_run
    if routine.files is not None:
        function = with_files
        function.__annotations__["files"] = routine.files.options
    else:
        function.before_mistakes = needs_another_bench  # type: ignore[attr-defined]
    function.__annotations__["options"] = routine.options
    return function


def _of_files_or_bench(
    routine: Routine,
    options: Any,
    files: Any,
    given: Given,
    dry_run: bool,
    out: Path | None,
    bench: Path | None,
) -> None:
    """Carry a routine out on files where they are named, else on the bench; refuse options of the other."""
    instead = routine.files
    assert instead is not None
    named = next(o for o in options_of(instead.options) if o.name == instead.named).flag
    if getattr(files, instead.named) is None:
        if useless := given.flags(*routine.useless(with_files=False)):
            raise BenchError(
                f"Only with {named}: {', '.join(useless)}. On the bench pictures are taken: leave out what "
                f"is only for files, or give {named}."
            )
        carry_out(routine, options, bench, out, dry_run=dry_run)
        return
    others = given.flags(*routine.useless(with_files=True))
    if useless := [*others, *(["--bench"] if bench is not None else [])]:
        raise BenchError(f"With {named} nothing is photographed: leave out {' and '.join(useless)}.")
    console = Console()
    print_lines(console, instead.look(options, files))
    if dry_run:
        console.print("Dry run: nothing was solved.")
        return
    with TerminalListener(console) as listener:
        done = instead.make(options, files, out or Path(instead.folder), RunControl(), listener)
    print_outcome(console, done)


def carry_out(
    routine: Routine, options: Any, bench: Path | None, folder: Path | None = None, *, dry_run: bool = False
) -> None:
    """Say what a routine will do and why, then do it and say how good it is; a dry run ends before that."""
    if folder is not None:
        refuse_within(folder)
    console = Console()
    procedure = routine.procedure(options)
    with open_and_say(_config_for(routine, bench)) as opened:
        outlook = procedure.foretold(opened, folder)
        print_lines(console, outlook.reasons)
        if dry_run:
            print_lines(console, outlook.plan_lines or _plan_lines(outlook))
            print_lines(console, _rehearsed(routine, options, outlook, opened))
            console.print("Dry run: nothing moved, no frame was taken.")
            return
        print_lines(console, _first_time(outlook, opened))
        if not outlook.plan_lines:  # else said when the exposures are known
            print_lines(console, _plan_lines(outlook))
        with TerminalListener(console) as listener:
            done = procedure.carry_out(opened, folder, listener=listener)
        print_outcome(console, done)


def _config_for(routine: Routine, bench: Path | None) -> BenchConfig:
    """Read the bench; BenchError where the routine cannot be tried on it, with the command that gives one."""
    config = load_and_say(bench)
    if wrong := other_bench_for(config, ("camera", *routine.needs), routine.tried_on):
        raise BenchError(wrong)
    return config


def _rehearsed(routine: Routine, options: Any, outlook: Outlook, bench: Bench) -> Sequence[str]:
    """Return how long all of a routine takes on a simulated bench that it was not carried out on before."""
    if any(IN_ALL in words for words in outlook.reasons) or not bench.simulated_kinds:
        return []
    with one_task("Rehearsing all of it on a simulated bench of its own") as advance:
        return rehearse_whole(routine, options, bench, advance, outlook.work)


def _first_time(outlook: Outlook, bench: Bench) -> list[str]:
    """Return how long the frames of a first plan take on a simulated bench; short ones are not rehearsed."""
    if outlook.plan is None or not bench.simulated_kinds or any(_TIME in words for words in outlook.reasons):
        return []
    frames = 0 if outlook.cost is None else outlook.cost.frames
    long = rehearsed(outlook.plan) * _SHORT <= frames
    pace = rehearsal(outlook.plan, bench) if long else None
    if pace is None:
        return [
            "Computing the simulated light comes on top of exposure and motion; --dry-run tells all of it."
        ]
    words = pace.words(outlook.plan, abilities_of(bench))
    return [f"{words} Homing, looking for exposures and analysis come on top; --dry-run tells all of it."]


def _plan_lines(outlook: Outlook) -> list[str]:
    if outlook.cost is None:
        return []
    return [f"Plan: {outlook.cost.frames} frames, {outlook.cost.time_of_motion}."]


def print_outcome(console: Console, done: Outcome) -> None:
    """Print what was measured, how good it is, and where everything lies."""
    print_lines(console, done.verdict)
    written = [("Run", run) for run in done.runs[:1]]
    written += [("Calibration", done.calibration)] if done.calibration is not None else []
    written += [(_LABELS.get(file.suffix, "Result"), file) for file in done.files]
    for label, path in written:
        console.print(f"{label:<13}{escape(str(path))}", soft_wrap=True)


class TerminalListener(Listener):
    """Shows a bar for each step of a procedure, and prints what is found before frames are taken.

    A context, which takes away the last bar.
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console()
        self._open, self._timed, self._began_s = ExitStack(), ExitStack(), 0.0
        self._bar: tuple[Progress, TaskID] | None = None
        self._words = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._open.__exit__(*error)
        self._timed.__exit__(*error)
        self._bar = None

    def step(self, words: str) -> None:
        """Begin a bar of its own, which goes by what the step took last time until it tells its share."""
        self.pause()
        self._timed.close()
        if words.startswith("homing"):
            typer.echo("Homing the stage.", err=True)
        self._timed.enter_context(kept_times.kept(words))
        self._began_s = time.monotonic()
        self._begin(words)

    def _begin(self, words: str) -> None:
        self._words = words
        bar = self._open.enter_context(progress_bar())
        said, expected = words[:1].upper() + words[1:], kept_times.expected(words)
        self._bar = bar, bar.add_task(said, total=None, note="", expected=expected)
        bar.tasks[0].start_time = self._began_s

    def pause(self) -> None:
        """Take the bar away, for lines to be printed."""
        self._open.close()
        self._bar = None

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        """Advance the bar."""
        if self._bar is not None:
            bar, task = self._bar
            scale = 100 if total == 1 else 1  # a fraction is shown in parts of a hundred
            bar.update(task, completed=round(scale * done), total=scale * total)
            if at_most:
                self.note("at most")

    def exposures(self, found: SweepExposures) -> None:
        """Print them."""
        self.print(exposure_lines(found))

    def planned(self, lines: Sequence[str]) -> None:
        """Print what will be taken."""
        self.print(lines)

    def print(self, lines: Sequence[str]) -> None:
        """Print lines between two bars."""
        words, self._words = self._words, ""
        self.pause()
        print_lines(self._console, lines)
        if words:
            self._begin(words)

    def frame(self, status: RunStatus) -> None:
        """Advance the bar."""
        self.share(status.done, status.total)

    def event(self, event: SweepEvent) -> None:
        """Show the newest PSF's figures beside the bar, and print what is wrong above it."""
        self.note(event_note(event))
        print_lines(self._console if self._bar is None else self._bar[0].console, event_lines(event))

    def note(self, words: str) -> None:
        """Show words beside the bar."""
        if self._bar is not None:
            bar, task = self._bar
            bar.update(task, note=words)


class _RunListener(TerminalListener):
    """Shows how the frames of a plan go on: their rate, the free disk, what is wrong; says what is found."""

    def __init__(self, folder: Path) -> None:
        super().__init__(Console(stderr=True))
        self._folder, self._free, self._free_at_s = folder, 0, 0.0
        self.seconds = 0.0
        """Since the run was started or resumed."""

    def said(self, words: str) -> None:
        """Print it."""
        self.print(words.splitlines())

    def frame(self, status: RunStatus) -> None:
        """Advance the bar, with a note beside it."""
        super().frame(status)
        self.seconds = status.seconds
        if time.monotonic() - self._free_at_s > 1:
            self._free_at_s, self._free = time.monotonic(), free_bytes(self._folder)
        rate = status.done_here / status.seconds if status.seconds else 0.0
        words = [f"{rate:.1f}/s", f"{size(self._free)} free"]
        words += [f"DROPPED {status.dropped}"] if status.dropped else []
        words += [f"SATURATED {percent(status.saturated_fraction)}"] if status.saturated_fraction else []
        if status.state is RunState.PAUSED:
            words = ["PAUSED, light off: p goes on, q ends"]
        self.note("  ".join(words))


def carry_out_run(procedure: Procedure, bench: Bench, folder: Path) -> Outcome:
    """Carry out a plan, or a run that goes on, with keys; say how it ended and what to do next."""
    control = RunControl()

    def toggle() -> None:
        control.resume() if control.is_pausing else control.pause()

    def stop() -> None:
        try:
            control.stop()
        except StepsFailedError as failure:
            typer.echo(str(failure), err=True)

    with (
        _RunListener(folder) as listener,
        keys({"p": toggle, "q": control.abort, "s": stop}),
    ):
        try:
            done = procedure.carry_out(bench, folder, control=control, listener=listener)
        except RunEndedError as ended:
            done = run_outcome(ended.run)
    print_outcome(Console(), done)
    if isinstance(done.result, Run) and done.result.condition is not RunCondition.COMPLETED:
        typer.echo(f"Go on with: diffuserbench resume {done.result.path}")
    typer.echo(f"{duration(listener.seconds)}. Light off, nothing moving: {bench.label}", err=True)
    return done


def print_lines(console: Console, lines: Sequence[str]) -> None:
    """Print sentences, one a line, as they are."""
    for line in lines:
        console.print(escape(line), soft_wrap=True)


# Bead slides from files --------------------------------------------------------------------------------
def _beads(
    options: BeadSlides,
    photographed: BeadFiles,
    given: Given,
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[IMAGE]...", help="Photographs of beads; left out: taken on the bench."),
    ] = None,
    dry_run: DryRun = False,
    bench: BenchOption = None,
) -> None:
    routine = routines[BEADS]
    out = options.out or Path(routine.file)
    options = replace(options, out=out)
    useless = given.flags(*(field.name for field in fields(photographed)))
    if useless and not files:
        raise BenchError(
            f"{' and '.join(useless)} go with image files; on the bench dark frames are taken and the "
            "geometry is that of bench.toml. Leave them out, or name the files."
        )
    if not files:
        carry_out(routine, options, bench, dry_run=dry_run)
        return
    options.refuse_existing()
    if options.binning > 1:
        raise BenchError("--binning is for photographs taken on the bench: bin the files beforehand.")
    read = [read_image(path) for path in files]
    taken = mean_images([image.pixels for image in read]) - np.float32(photographed.dark)
    facts = {"files": [str(path) for path in files], "simulated": any(i.is_simulated for i in read)}
    geometry = Geometry(pixel_pitch_um=photographed.pixel_um, diffuser_distance_mm=photographed.distance_mm)
    slides = replace(options, images=max(len(files), 2))
    if dry_run:
        print_lines(
            Console(),
            [f"{len(files)} files, read and found alike", *psf_lines(slides, geometry, taken.shape[1:])],
        )
        typer.echo("Dry run: nothing was solved.")
        return
    done = _solved(taken, slides, geometry, facts)
    print_outcome(Console(), save_beads(done, slides, out))


def _solved(
    taken: Float32Array, slides: BeadSlides, geometry: Geometry, facts: dict[str, object]
) -> BeadCalibration:
    quiet = not sys.stderr.isatty()
    before = ""

    with progress_bar() as bar:
        task = bar.add_task("Blind deconvolution", total=100, note="")

        def progress(what: str, share: float) -> None:
            nonlocal before
            bar.update(task, completed=round(100 * share), note=what)
            if quiet and what != before:  # a log has no bar, but should show that something goes on
                typer.echo(f"{share:4.0%} {what}", err=True)
                before = what

        return calibrate_beads(taken, slides, geometry, provenance=facts, progress=progress)
