"""A procedure from an open bench to its saved result, as command line, window and scripts call it alike.

A procedure is frozen data: what a person asked for. ``outlook`` says what it will do and cost, nothing moves;
``carry_out`` does all of it (homing, exposures, frames, analysis, files) and ends with the light off. What
routines share is here too: errors, declared options, the record of what a run's frames are for, the registry.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from calibration_routines.times import first_guess, took, took_before
from instrument.bench.bench import Bench
from instrument.files.atomic import DOUBTFUL, named_by_worth, write_text
from instrument.files.errors import BenchError, FileError, SettingsError
from instrument.files.record import RecordFormat, plain
from instrument.plan import Plan, PlanEstimate, Step, estimate
from instrument.runs.acquire import abilities_of, prepare
from instrument.runs.pace import keep_pace, pace_of
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_control import EndedEarlyError, RunControl
from instrument.runs.runner import Runner, RunStatus, discarded
from instrument.runs.timed import TimedSteps
from instrument.runs.writer import dated_name, free_name
from recon.base.declare import options_of
from recon.base.option_text import size
from recon.base.registry import Registry
from recon.errors import InputError

if TYPE_CHECKING:
    from calibration_routines.display.spot_camera import SpotLook
    from calibration_routines.psf.sweep_plan import SweepExposures
    from calibration_routines.psf.sweep_watch import SweepEvent

T = TypeVar("T")
REFUSED = "no_result.txt"
"""In a run's folder: why its frames, all of them, give no result."""


# Errors ------------------------------------------------------------------------------------------------
class CalibrationError(BenchError):
    """A calibration that cannot be taken, or was ended before its last frame."""

    exit_code = 1


class RunEndedError(CalibrationError):
    """The run behind a calibration was ended before its last frame; its frames are kept.

    ``what`` begins the sentence ("The sweep"), ``remedy`` says what to do about it.
    """

    def __init__(self, what: str, run: Run, remedy: str = "") -> None:
        self.run = run
        self.words = f"{what} ended early ({run.condition}); what was taken is in {run.path}."
        """Without the remedy, which is not the same on the command line and in a window."""
        super().__init__(self.words + (f" {remedy}" if remedy else ""))


def completed(run: Run, what: str = "The run", remedy: str = "") -> Run:
    """Return a run that has all its frames; RunEndedError when it was ended before its last one."""
    if run.condition is not RunCondition.COMPLETED:
        raise RunEndedError(what, run, remedy)
    return run


# Options -----------------------------------------------------------------------------------------------
MM: dict[str, Any] = {"unit": "um", "shown_unit": "mm", "shown_factor": 1e3}
"""For ``option``: lengths in micrometres, which people think of in millimetres."""


@dataclass(frozen=True, slots=True)
class Size:
    """Rows and columns, written as ``5x5``."""

    rows: int
    columns: int

    @classmethod
    def of(cls, text: str) -> Size:
        """Read ``ROWSxCOLUMNS``; ValueError when the text is none."""
        return cls(*size(text))

    @property
    def shape(self) -> tuple[int, int]:
        """``(rows, columns)``."""
        return self.rows, self.columns

    def __str__(self) -> str:
        return f"{self.rows}x{self.columns}"


class Checked:
    """Base of a routine's options: all that is wrong with them is one SettingsError when they are made."""

    def __post_init__(self) -> None:
        found = ((o.name, o.mistake(getattr(self, o.name))) for o in options_of(self))
        problems = [(name, words.rstrip(".")) for name, words in found if words is not None]
        problems += self.disagreements({name for name, _ in problems})
        if problems:
            raise SettingsError(problems)

    def disagreements(self, wrong: Collection[str]) -> list[tuple[str, str]]:
        """Return what does not fit together: a setting's name, and words; ``wrong`` are named already."""
        return []


# What a procedure says ---------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Outlook:
    """What a procedure will do, as far as that is known before it starts."""

    reasons: tuple[str, ...] = ()
    """What its numbers come from, in words."""
    plan: Plan | None = None
    """Of its frames, with the camera's present exposure; None where the next frame depends on the last
    one."""
    cost: PlanEstimate | None = None
    """Of the plan."""
    free_bytes: int | None = None
    """On the disk that the runs go to."""
    plan_lines: tuple[str, ...] = ()
    """The plan in words where more is to be said than frames and seconds; exposures are only found at the
    start (:meth:`Listener.planned`)."""
    beside_s: float = 0.0
    """What frames that are not kept take by the clock, of a search, where the cost has none of them."""
    work: tuple[tuple[str, float], ...] = ()
    """What steps compute, in their order: a step's name, and so many transforms of 1024 x 1024 there and
    back. All that follows the first of them is there, or nothing."""
    path: tuple[dict[str, float], ...] = ()
    """Where the source (``x_um``, ``y_um``, ``z_um``) or the stage goes, in the order of the visits."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a procedure leaves."""

    verdict: tuple[str, ...]
    """What was measured and how good it is, in sentences."""
    good: bool
    """Whether nothing was found wrong."""
    runs: tuple[Path, ...] = ()
    """Folders of its runs."""
    calibration: Path | None = None
    """What a reconstruction or a hologram is given."""
    files: tuple[Path, ...] = ()
    """What else was written: results, pictures."""
    result: object = None
    """What the routine returned: ``SweepCalibration``, ``AngularResponse``, ``DiffuserSurface``,
    ``BeadCalibration``, ``SlmCalibration``, ``AlignmentReport`` or ``Run``."""

    @property
    def whole(self) -> bool:
        """Whether it is not a run that was ended before its last frame."""
        return not isinstance(self.result, Run) or self.result.condition is RunCondition.COMPLETED

    def __post_init__(self) -> None:
        """Say of a result that is kept under a doubtful name that it is (:func:`named_by_worth`)."""
        kept = [path.name for path in (self.calibration, *self.files) if path is not None]
        if doubtful := [name for name in kept if name.startswith(DOUBTFUL)]:
            words = f"Not to be relied on, hence kept as {doubtful[0]}."
            object.__setattr__(self, "verdict", (*self.verdict, words))


class Listener:
    """Follows how a procedure goes on, in the thread that carries it out; override what is of interest."""

    def step(self, words: str) -> None:
        """Note that another step begins: ``"finding exposures"``."""

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        """Note how much of the step is done, where it does not take the frames of a plan.

        ``at_most``: the step ends when it has found what it looks for, usually long before ``total``.
        """

    def said(self, words: str) -> None:
        """Note what was found on the way, for a log."""

    def exposures(self, found: SweepExposures) -> None:
        """Note which exposures a sweep will have."""

    def planned(self, lines: Sequence[str]) -> None:
        """Note in words what will be taken, once the exposures are known."""

    def frame(self, status: RunStatus) -> None:
        """Note that a frame of a run is on the disk, or that the run's state changed."""

    def event(self, event: SweepEvent) -> None:
        """Note how good a PSF, or the source, is as soon as it is known."""

    def look(self, look: SpotLook) -> None:
        """Note what a picture of spots showed: a frame of a mask alignment."""


class Procedure(ABC):
    """What commands, windows and scripts carry out; a frozen dataclass of what was asked for."""

    @abstractmethod
    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Check everything that can be checked before something moves.

        Parameters
        ----------
        bench : Bench
            Open.
        folder : Path, optional
            Where runs go; the bench's data folder by default.

        Raises SettingsError, PlanError, BenchError when it cannot be done as asked.
        """

    def foretold(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Return the outlook with how long it takes in all, by what it took before or by its work."""
        outlook = self.outlook(bench, folder)
        told = took_before(self, bench, outlook) or first_guess(bench, outlook)
        return replace(outlook, reasons=(*outlook.reasons, *told))

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Check it, then do it; after an error in doing it the light is off and nothing moves.

        Raises EndedEarlyError, RunEndedError when it was aborted or stopped (what was taken is kept);
        BenchError, DeviceError when it cannot be done or a device fails.
        """
        outlook = self.outlook(bench, folder)
        control = control or RunControl()
        with control.procedure(bench):
            began_s = time.monotonic()
            try:
                outcome = self.perform(bench, folder, control, listener or Listener())
            except (KeyboardInterrupt, SystemExit, EndedEarlyError) as interruption:
                _note_kept(interruption, control.run)
                raise
            if control.ending is None and outcome.whole:
                took(self, bench, outlook, time.monotonic() - began_s)
                for run in outcome.runs[:1]:
                    keep_pace(run, partial(abilities_of, bench), bench.config.text)
            return outcome

    @abstractmethod
    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Do what was checked: ``control`` has the bench, and is asked between steps whether to go on."""


def _note_kept(interruption: BaseException, run: Path | None) -> None:
    """Say where the result of a run is, or how it is made of its frames, unless that is said already."""
    notes = getattr(interruption, "__notes__", ())
    if run is None or any("diffuserbench resume" in note for note in notes):
        return
    for purpose in (one.purpose for one in routines.values() if one.purpose is not None):
        if purpose.lacks_result(run):
            interruption.add_note(f"Its frames are kept. For its result: diffuserbench resume {run}")
            return
        if purpose.is_of(run):
            interruption.add_note(f"Its result is saved: {purpose.kept(run)}")
            return


@dataclass(frozen=True, slots=True)
class Purpose(Generic[T]):
    """What a run's frames are for: a record in its folder, of which its result is made, later too."""

    kind: type[T]
    """Dataclass of the record."""
    file: str
    result: str
    """Names in the run's folder: of the record, and of the result once there is one."""
    format: RecordFormat

    def is_of(self, run: Path | str) -> bool:
        """Whether a run's frames are for this."""
        return (Path(run) / self.file).is_file()

    def place(self, run: Path, *, doubted: bool) -> Path:
        """Return where the result of a run goes (:func:`named_by_worth`)."""
        return named_by_worth(run / self.result, doubted=doubted)

    def kept(self, run: Path) -> Path:
        """Return where the result of a run is: under a doubtful name where that is what there is."""
        good, doubtful = (self.place(run, doubted=doubted) for doubted in (False, True))
        return doubtful if doubtful.exists() and not good.exists() else good

    def lacks_result(self, run: Path) -> bool:
        """Whether they are, and the result is not there yet."""
        return self.is_of(run) and not any(self.place(run, doubted=one).exists() for one in (False, True))

    @contextmanager
    def analysed(self, run: Path) -> Iterator[None]:
        """Keep with a complete run why its frames give no result, when their analysis in the block says so.

        The same frames would say it again, so that :func:`can_go_on` offers the run to nobody any more.
        """
        refused = run / REFUSED
        try:
            yield
        except (CalibrationError, InputError) as error:
            try:
                write_text(refused, f"{error}\n")
            except FileError as unwritten:  # why there is no result counts, not that it cannot be kept
                error.add_note(str(unwritten))
            raise
        refused.unlink(missing_ok=True)  # by a program before this one

    def read(self, run: Path) -> T:
        """Read the record of a run; CalibrationError when there is none, or it is damaged."""
        path = run / self.file
        if not self.is_of(run):
            raise CalibrationError(f"{run} is no {self.format.thing}: it has no {self.file}.")
        try:
            return self.format.value(self.kind, self.format.read(path), path)
        except (FileError, SettingsError) as error:
            raise CalibrationError(f"{path} cannot be read: {error}") from error

    def prepare(
        self,
        bench: Bench,
        plan: Plan,
        folder: Path | None,
        record: T,
        control: RunControl,
        listener: Listener,
    ) -> Runner:
        """Return the runner of a plan whose run has the record; errors as ``prepare``."""
        runner = prepare(bench, plan, folder, on_progress=listener.frame, control=control)
        with discarded(runner):
            runner.keep_text(self.file, self.format.text(plain(record)))
        return runner


@dataclass(frozen=True, slots=True, kw_only=True)
class FromFiles:
    """How a routine's result is made of files instead of on a bench."""

    options: type[Any]
    """Frozen dataclass with declared fields: the files, and what is not known of them."""
    named: str
    """Its field that names them; None there: the bench."""
    uses: tuple[str, ...]
    """The routine's options that matter with files, too."""
    look: Callable[[Any, Any], Sequence[str]]
    """Takes the routine's options and the files, says what would be done; raises what is wrong with them."""
    make: Callable[[Any, Any, Path, RunControl, Listener], Outcome]
    """Takes the same, where the result goes, who ends it and who follows."""
    folder: str
    """Where the result goes when nothing else is said."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Routine:
    """A row of the registry: what ``calibrate`` and the window offer, from its options to its result."""

    name: str
    """On the command line: ``diffuserbench calibrate NAME``."""
    title: str
    """In the window."""
    help: str
    """What it does, one sentence."""
    options: type[Any]
    """Frozen dataclass with declared fields (:mod:`recon.base.declare`); raises SettingsError for what makes
    no sense together."""
    procedure: Callable[[Any], Procedure]
    """Makes the procedure of such options: what plans (``outlook``) and runs (``carry_out``)."""
    details: str = ""
    """More about it, for the command's help."""
    needs: tuple[str, ...] = ()
    """Devices that it needs besides the camera."""
    tried_on: str = "default"
    """The simulated bench that it can be tried on, one of ``instrument.bench.config_file.TEMPLATES``."""
    examples: tuple[str, ...] = ()
    """Command lines."""
    start: Callable[[Bench], Mapping[str, Any]] | None = None
    """Gives values for a form to begin with, by name, that follow from the bench."""
    purpose: Purpose[Any] | None = None
    """Of runs that become results later, too."""
    finish: Callable[[Run, Bench | None, RunControl, Listener], Outcome] | None = None
    """Makes the result of such a complete run: takes it, the bench for retakes (or None), control and
    listener."""
    finish_takes_frames: bool = False
    """Whether that needs the bench, to take the frames of further runs."""
    restore: Callable[[Run, Bench, int], None] | None = None
    """Brings back what no plan tells, before such a run takes a step that it lacks and has not come to by the
    one before; takes that step's number, too."""
    watch: Callable[[Bench, Runner, Listener], None] | None = None
    """Makes the runner of such a run that goes on look at its frames as from its beginning."""
    files: FromFiles | None = None
    file: str = ""
    """Where the command line writes the result when nothing else is said, of options with an ``out``."""
    command: str = "calibrate"
    """The command that it is part of."""

    @property
    def declared(self) -> tuple[type[Any], ...]:
        """All classes of options: its own, and those of files."""
        return (self.options,) if self.files is None else (self.options, self.files.options)

    def useless(self, *, with_files: bool) -> set[str]:
        """Return the names of options that say nothing: with files the bench's, else those of files."""
        if self.files is None:
            return set()
        own, of_files = ({field.name for field in fields(options)} for options in self.declared)
        return own - set(self.files.uses) if with_files else of_files - {self.files.named}

    def asked(self, values: Mapping[str, Any]) -> Procedure:
        """Return the procedure that options by name, of all classes, ask for; errors as these classes."""
        own, *others = (
            kind(**{field.name: values[field.name] for field in fields(kind) if field.name in values})
            for kind in self.declared
        )
        if self.files is None or getattr(others[0], self.files.named) is None:
            return self.procedure(own)
        return OfFiles(self.name, own, others[0])


@dataclass(frozen=True, slots=True)
class OfFiles(Procedure):
    """A routine's result made of files; the bench only says where results go."""

    routine: str
    asked: Any
    files: Any
    out: Path | None = None
    """Where the result goes; None: dated, beside the runs."""

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Look at the files; raises what is wrong with them."""
        return Outlook(tuple(self._how.look(self.asked, self.files)))

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Make the result."""
        beside = bench.config.data_folder if folder is None else folder
        out = self.out or free_name(beside, dated_name(f"{self.routine} calibration"))
        return self._how.make(self.asked, self.files, out, control, listener)

    @property
    def _how(self) -> FromFiles:
        how = routines[self.routine].files
        assert how is not None
        return how


_MODULES = (
    "psf.sweep_procedure",
    "optics.stage_play",
    "optics.photograph",
    "optics.angular",
    "optics.dpc",
    "optics.beads",
    "optics.screen_bench",
    "display.slm_calibration",
    "display.mask_alignment",
    "display.display_learning",
)
"""Each has its routines as ``ROUTINES``. They are imported when somebody asks what there is."""


def _own() -> Iterator[Routine]:
    for name in _MODULES:
        yield from import_module(f"calibration_routines.{name}").ROUTINES


routines: Registry[Routine] = Registry("routine", "diffuserbench.routines", _own)
"""All routines by name: the project's, those of installed packages, those that this program registered."""


def outlook_of(
    bench: Bench, plan: Plan, folder: Path | None, reasons: Sequence[str] = (), *, homes: bool = False
) -> Outlook:
    """Return the outlook of a plan that was checked.

    Where it moves a stage, the reasons say whether that is homed first: always (``homes``), or where it has
    no reference yet.
    """
    abilities = abilities_of(bench, folder or bench.config.data_folder)
    path = path_of(plan)
    words = list(reasons)
    if path and bench.stage is not None and (homes or not bench.stage.is_homed):
        words.append("The stage is homed first, every axis to its reference: its way must be free.")
    if bench.trigger_source is not None:
        words.append(TimedSteps(bench, plan).words())
    pace = pace_of(plan, abilities, folder or bench.config.data_folder, bench.config.text)
    if pace is not None:
        words.append(pace.words(plan, abilities))
    return Outlook(tuple(words), plan, estimate(plan, abilities), abilities.free_bytes, path=path)


def path_of(plan: Plan) -> tuple[dict[str, float], ...]:
    """Return the places that a plan visits, one after the other; empty where nothing moves."""
    places: list[dict[str, float]] = []
    for step in plan.steps():
        place = place_of(step)
        if place and (not places or places[-1] != place):
            places.append(place)
    return tuple(places)


def place_of(step: Step) -> dict[str, float]:
    """Return where a step puts the source (``x_um``, ``y_um``, ``z_um``) or the stage; empty: nowhere."""
    if step.source_um is not None:
        return dict(zip(("x_um", "y_um", "z_um"), step.source_um, strict=True))
    return dict(step.stage)


def home_if_needed(bench: Bench, listener: Listener, plan: Plan | None = None) -> None:
    """Home a stage that has no reference yet; for a plan that places nothing, not."""
    needed = plan is None or any(part.positions is not None for part in plan.parts)
    if needed and bench.stage is not None and not bench.stage.is_homed:
        listener.step("homing the stage")
        bench.stage.home()
