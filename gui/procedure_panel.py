"""What panels of procedures share: forms checked as they are typed, a run that is started, paused, ended."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QWidget

from calibration_routines.plan_procedures import ResumeProcedure, left_unfinished, routine_of
from calibration_routines.procedure import Outcome, Outlook, Procedure
from calibration_routines.routine import Routine
from gui.background import NewestOnly
from gui.forms.form_stack import FormStack
from gui.forms.options_form import OptionsForm
from gui.jobs import BusyError, Job, JobContext
from gui.making import REST_MS, take_slice
from gui.panel import Panel
from gui.panels.unserved import why_not
from gui.procedure_run import Ended, ProcedureRun, RunBar, Situation, script
from gui.session import BenchSession
from gui.session_news import name_of
from gui.way_on import WayOn
from gui.widgets.building import after_rest, button, choice, fill, label, mark, split, text_view
from gui.widgets.tab_order import hand_on, tab_in_order
from instrument.bench.config_file import TEMPLATES
from instrument.bench.safety import LIGHT_DOUBT, MOTION_DOUBT, UNSAFE
from instrument.files.errors import BenchError, SettingsError, count, size

_CHECK_MS = 250
"""Rest after a key before what was typed is checked."""
_SLOW_MS = 700
"""A check that takes longer than this is shown to go on: what was said of other values must not stay."""
_FORM_WIDTH_PX = 400
_MOST_RUNS = 3


class ProcedurePanel(Panel):
    """Forms on the left, each checked against the bench as it is typed; subclasses fill the right side.

    Parameters
    ----------
    session : BenchSession
    routines : sequence of Routine
        What can be carried out: each has a form of its options.
    words : str
        On the start button.
    """

    handed_to: ClassVar[str] = "reconstructions"
    """The panel that works with what was calibrated."""
    use_words: ClassVar[str] = "Reconstruct with it…"

    def __init__(
        self, session: BenchSession, routines: Sequence[Routine], words: str, parent: QWidget | None = None
    ) -> None:
        super().__init__(session, parent)
        self.routines = tuple(routines)
        self.run = ProcedureRun(session, self)
        self.outlook: Outlook | None = None
        """Of the form as it stands, once it was checked."""
        self._start_words = words

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        session = self.session
        self.choice = choice([routine.title for routine in self.routines], "What to do")
        self.choice.setAccessibleName("Routine")
        for number, routine in enumerate(self.routines):
            self.choice.setItemData(number, routine.help, Qt.ItemDataRole.ToolTipRole)
        declared = {routine.name: routine.declared for routine in self.routines}
        self.views = FormStack(
            lambda name: OptionsForm(declared[name], whole=False),
            lambda name: self.views[name].changed.connect(self._typed),
        )
        """Of the routines, by their names."""
        if len(self.routines) == 1:
            self.choice.hide()
        self.about = label(role="dim", wraps=True)
        tip = "What will be done and why, or what stands against it; can be copied"
        self.verdict = text_view(tip=tip)
        self.verdict.setMaximumHeight(320)
        self.run_bar = RunBar(self.run, self._start_words)
        tip = "Take what was measured to where it is used"
        self.use_button = button(self.use_words, tip, self._use)
        self.use_button.hide()
        tip = "A simulated bench that serves this routine, in the place of this one"
        self.other_button = button("Open another bench", tip, self._open_other)
        self.other_button.hide()
        self.way_on = WayOn(self.session, self)
        self.way_on.go_on.connect(self.resume)
        self._left = NewestOnly(self.jobs, "Looking for runs that did not end")
        self._offered: tuple[Path | None, str] = (None, "")
        """A run of an earlier day that did not end, and its routine's name."""
        self._way_on: tuple[str, object] | None = None
        yield
        left, self.right = QWidget(), QWidget()
        """For the subclass."""
        sizes = [_FORM_WIDTH_PX, 3 * _FORM_WIDTH_PX]
        fill(self.body, split(left, self.right, sizes=sizes, stretch=1, firm=True))
        yield
        fill(
            left,
            self.choice,
            self.about,
            (self.views, 3),
            (self.verdict, 2),
            self.run_bar,
            self.use_button,
            self.way_on,
            self.other_button,
            margins=(0, 0, 6, 0),
        )
        yield
        self.views.show_page(self.routine.name)
        yield from self.views.parts(self.routine.name)
        self._started: set[str] = set()
        self._said_at_end = ""
        """How the last procedure ended, as long as that is shown."""
        self._doubted: frozenset[str] = frozenset()
        """The devices that it left doubts about, until all were lost and are there again."""
        self._lost: set[str] = set()
        """Which of them were lost: one that answered with an error was not, and the doubt about it stays."""
        self._check_job: Job | None = None
        self._again = False
        self._unchecked = False
        """Whether the bench was busy when the form was to be checked."""
        self._making = after_rest(self, REST_MS, self._make_form)
        self._rest = after_rest(self, _CHECK_MS, self.check)
        self._slow = after_rest(self, _SLOW_MS, lambda: self._say("This is being checked …", wrong=False))
        self.choice.currentIndexChanged.connect(self._chosen)
        self.run_bar.start.connect(self.start)
        self.run.looked.connect(self.looked)
        self.run.succeeded.connect(self._succeeded)
        self.run.ended_early.connect(self._ended_early)
        self.run.failed.connect(self._failed)
        self.run.over.connect(self._over)
        session.device_changed.connect(lambda _: self._rest.start())
        session.device_changed.connect(self._reconnected)
        session.jobs.job_ended.connect(self._job_ended)
        self._chosen()
        self._look_for_unfinished()

    # The form ------------------------------------------------------------------------------------
    @property
    def routine(self) -> Routine:
        """The routine whose form is shown."""
        return self.routines[self.choice.currentIndex()]

    @property
    def options_form(self) -> OptionsForm:
        """The form whose fields messages are about."""
        return self.view

    def wholes(self) -> list[QWidget]:
        """Return the pages of the forms: after a day there are many."""
        return self.views.pages()

    @property
    def view(self) -> OptionsForm:
        """The form that is shown, as a widget."""
        return self.views[self.routine.name]

    def take(self, what: str) -> None:
        """Choose a routine, by its name."""
        self.choice.setCurrentIndex([routine.name for routine in self.routines].index(what))
        self.run_bar.start_button.setFocus()

    def procedure(self) -> Procedure | None:
        """Return what the form asks for; None, and fields marked, where it makes no sense."""
        values = self.view.values()
        if values is None:  # what was said of other values must not stay
            self._say("A field is refused. What will be done is told once it is mended.", wrong=True)
            return None
        try:
            return self.routine.asked(values)
        except BenchError as error:
            self.show_problem(error)
            return None

    def as_python(self) -> str:
        """Return lines that do what the form asks for."""
        procedure = self.procedure()
        if procedure is None:
            return f"# {self.title}: the form has mistakes.\n"
        return script(procedure, self.session.config.path)

    def check(self) -> None:
        """Check the form against the bench, in a job; the start button follows."""
        if self.run.is_running or not self.views.is_whole(self.routine.name):
            return  # what is being made is checked then
        if self._check_job is not None:
            self._again = True
            return
        self.outlook, self._unchecked = None, False
        needed = () if self._with_files else ("camera", *self.routine.needs)
        missing = [kind for kind in needed if not self.session.is_open(kind)]
        unserved = why_not(self.session, self.routine.title, needed, self.routine.tried_on)
        self.other_button.setVisible(bool(unserved))
        if unserved:
            self.other_button.setText(f"Open the simulated {TEMPLATES[self.routine.tried_on][0]}")
            self._say(unserved, wrong=True)
            self.run_bar.set_startable("It takes another bench.")
            return
        if missing:
            names = " and ".join(map(name_of, missing))
            self._say(f"The {names} of this bench must be open.", wrong=True)
            self.run_bar.set_startable("Not all devices are open.")
            return
        bench, routine = self.session.bench, self.routine
        first = routine.start if routine.name not in self._started else None
        procedure = self.procedure() if first is None else None
        if procedure is None and first is None:
            if self.view.is_untouched:
                self._ask_for_what_is_missing()
            else:
                self.run_bar.set_startable("The form has mistakes.")
            return
        self.run_bar.set_startable("It is being checked.")

        def work(_: JobContext) -> Mapping[str, Any] | Outlook | BenchError:
            try:
                if first is not None:
                    return first(bench)
                assert procedure is not None
                return procedure.foretold(bench)
            except BenchError as error:
                return error

        try:
            self._check_job = self.session.jobs.device(
                f"Checking: {routine.title}", work, {"stage"}, quiet=True
            )
        except BusyError as error:
            self.run_bar.set_startable(str(error))
            self._unchecked = True
            return
        self._slow.start()
        self._check_job.succeeded.connect(partial(self._checked, routine))
        self._check_job.failed.connect(self._check_failed)
        self._check_job.cancelled.connect(lambda _: self._check_stopped())
        self._check_job.ended.connect(self._check_ended)

    def _ask_for_what_is_missing(self) -> None:
        """Say of a form that nothing was typed into what it needs: no field is wrong yet."""
        reasons = filter(None, map(self.view.reason, self.view.fields))
        self._say("\n".join(reasons) or self.verdict.toPlainText(), wrong=False)
        self.view.clear_reasons()
        self.run_bar.set_startable("Something is to be given first; see below the form.")

    def show_problem(self, error: BenchError) -> None:
        """Show a mistake: at the fields that it names, and below the form."""
        if isinstance(error, SettingsError):
            refused = [name for name, why in error.problems if self.view.refuse(name, why)]
            if refused:
                self.view.show_field(refused[0])
        self._say(str(error), wrong=True)

    def show_outlook(self, outlook: Outlook) -> None:
        """Show what will be done; subclasses draw it."""
        lines = list(outlook.reasons)
        if outlook.cost is not None:
            cost = outlook.cost
            free = "" if outlook.free_bytes is None else f" of {size(outlook.free_bytes)} free"
            lines.insert(
                0,
                f"{count(cost.frames, 'frame')}, {size(cost.total_bytes)}{free}, "
                f"{cost.time_of_motion}, {count(cost.moves, 'move')}",
            )
        self._say("\n".join(lines), wrong=False)

    # Carrying out --------------------------------------------------------------------------------
    def start(self) -> None:
        """Carry out what the form asks for."""
        procedure = self.procedure()
        if procedure is None or self.run.is_running:
            return
        self.carry_out(self.routine.title, procedure)

    def carry_out(self, title: str, procedure: Procedure) -> None:
        """Carry out a procedure."""
        if self.begin(lambda: self.run.start(title, procedure)) is None:
            return
        self.accepted()
        self.use_button.hide()
        self.other_button.hide()
        self.run_bar.set_running(True)
        hand_on(self.run_bar.pause_button, (self.way_on.go_on_button,))
        self.way_on.offer(None)
        self._left.forget()
        self._said_at_end, self._doubted = "", frozenset()
        self._say(f"{title} has begun.", wrong=False)
        self.views.setEnabled(False)
        self.choice.setEnabled(False)
        self.began()

    def began(self) -> None:
        """Clear what the last procedure left on the right; for subclasses."""

    def looked(self, now: Situation) -> None:
        """Show the situation on the right; for subclasses."""

    def way_from(self, outcome: Outcome) -> tuple[str, object] | None:
        """Return which panel goes on from here, and with what; None: no way leads on."""
        pictures = [file for file in outcome.files if file.suffix == ".tif"]
        result = outcome.calibration or next(iter(pictures), None)
        return None if result is None else (self.handed_to, result)

    def finished(self, outcome: Outcome) -> None:
        """Show a result on the right; for subclasses."""

    # Inside --------------------------------------------------------------------------------------
    def _chosen(self) -> None:
        self.use_button.hide()  # what was made by another routine is in Runs
        self.run_bar.clear()
        self.views.show_page(self.routine.name)
        self.about.setText(f"{self.routine.help.removesuffix('.')}.")
        self.run_bar.set_startable("Its form is being made.")
        self._making.start()  # not at once: keys that go through the list pass over most of them

    def _make_form(self) -> None:
        """Make the form that is shown, a slice at a time, then have it checked."""
        try:
            take_slice(self.views.parts(self.routine.name))
            self._making.start()
        except StopIteration:
            tab_in_order(self.view, after=self.choice)
            self._typed()

    @property
    def is_settled(self) -> bool:
        """Whether the form that is shown is made, and checked as it stands."""
        return not (self._making.isActive() or self._rest.isActive()) and self._check_job is None

    @property
    def _with_files(self) -> bool:
        """Whether the form names files, so that nothing is taken on the bench."""
        files = self.routine.files
        try:
            return files is not None and self.view.value(files.named) is not None
        except BenchError:
            return False

    def _typed(self) -> None:
        self._said_at_end = ""
        if self.routine.files is not None:
            self.view.hide_fields(self.routine.useless(with_files=self._with_files))
        self.run_bar.set_startable("It is being checked.")
        self._rest.start()

    def _checked(self, routine: Routine, result: Mapping[str, Any] | Outlook | BenchError) -> None:
        """Take values to begin with, what will be done, or what stands against it."""
        if isinstance(result, Mapping):
            self._started.add(routine.name)
            self.views[routine.name].begin_with(result)
            self._again = True
        elif routine is not self.routine:  # another one was chosen meanwhile, and waits for its check
            return
        elif isinstance(result, BenchError):
            self.show_problem(result)
            self.run_bar.set_startable("It cannot be done; see below the form.")
        else:
            self.outlook = result
            self.show_outlook(result)
            self.run_bar.set_startable()

    def _check_failed(self, why: str) -> None:
        self._say(why, wrong=True)
        self.run_bar.set_startable("It cannot be checked; see below the form.")

    def _check_stopped(self) -> None:
        """Have what STOP broke off checked anew, once the bench is free."""
        self._again, self._unchecked = False, True
        self._say(
            "STOP ended the check of this form. It is checked again when the bench is safe.", wrong=False
        )

    def _check_ended(self) -> None:
        self._check_job = None
        self._slow.stop()
        if self._again:
            self._again = False
            self.check()

    def _job_ended(self, job: Job) -> None:
        if self._unchecked and job.lanes:
            self._rest.start()

    def _open_other(self) -> None:
        self.session.handed_on.emit("start", self.routine.tried_on)

    def _use(self) -> None:
        if self._way_on is not None:
            self.session.handed_on.emit(*self._way_on)

    def resume(self, run: Path) -> None:
        """Go on with a run that did not end, here."""
        if self.run.is_running:
            return
        if run == self._offered[0]:  # of an earlier day: its routine's form may not be in front
            self.take(self._offered[1])
        self.carry_out(f"Resuming {run.name}", ResumeProcedure(run))

    def _look_for_unfinished(self) -> None:
        """Offer the newest run of these routines where it did not end, of an earlier day as well."""
        folder, names = self.session.runs_folder, [routine.name for routine in self.routines]

        def read() -> tuple[Path, str] | None:
            if (run := left_unfinished(folder, names)) is None:
                return None
            routine = routine_of(run)
            return run, "plan" if routine is None else routine.name

        self._left.ask(read, self._offer_unfinished)

    def _offer_unfinished(self, found: tuple[Path, str] | None) -> None:
        if found is not None and not self.run.is_running:
            self._offered = found
            self.way_on.offer(found[0], f"Go on with {found[0].name}, which did not end")

    def _succeeded(self, outcome: Outcome) -> None:
        runs = [str(run) for run in outcome.runs]
        if len(runs) > _MOST_RUNS:  # one beside the other in Runs
            runs = [runs[0], f"and {count(len(runs) - 1, 'run')} after it"]
        where = [*runs, *(str(path) for path in (outcome.calibration, *outcome.files) if path)]
        self._end_with("\n".join((*outcome.verdict, *where)), wrong=not outcome.good)
        self._way_on = self.way_from(outcome)
        self.use_button.setVisible(self._way_on is not None)
        self.run_bar.show_end("Done" if outcome.good else "Done, with findings", complete=True)
        self.finished(outcome)

    def _ended_early(self, ended: Ended) -> None:
        self._end_with(ended.words, wrong=False)
        self.way_on.offer(ended.run)
        self.run_bar.show_end(f"Ended early; {_state(ended.words)}", complete=False)

    def _failed(self, ended: Ended) -> None:
        self._end_with(ended.words, wrong=True)
        self.way_on.offer(ended.run)
        self.run_bar.show_end(f"Failed; {_state(ended.words)}", complete=False)

    def _end_with(self, words: str, *, wrong: bool) -> None:
        """Say how it ended, until something else is asked for."""
        self._said_at_end = ""
        self._say(words, wrong=wrong)
        self._said_at_end = words
        devices = self.session.bench.devices.items() if _is_doubted(words) else ()
        self._doubted = frozenset(kind for kind, device in devices if device.name in words)
        self._lost = {kind for kind in self._doubted if self.session.state(kind).condition == "failed"}

    def _reconnected(self, kind: str) -> None:
        """Let go of a doubt about devices once all were lost and are there again; STOP settles it."""
        if kind not in self._doubted:
            return
        if self.session.state(kind).condition == "failed":
            self._lost.add(kind)
        elif self._lost == self._doubted and all(map(self.session.is_open, self._doubted)):
            self._doubted = frozenset()
            how, _, _ = self.run_bar.words.text().partition(";")
            self.run_bar.words.setText(f"{how}; connected again since. STOP makes sure that it is safe")
            self._said_at_end = ""  # the log keeps it
            self._say("", wrong=False)
            self.check()

    def _over(self) -> None:
        self.accepted()  # what ended it stands below the form
        words = self.run_bar.words.text()
        self.run_bar.set_running(False)
        self.run_bar.words.setText(words)
        self.views.setEnabled(True)
        self.choice.setEnabled(True)
        self.check()  # what was possible before may not be any more

    def _say(self, text: str, *, wrong: bool) -> None:
        if self._said_at_end:  # it stays while nothing else is asked for
            text = "\n".join([self._said_at_end, *([text] if wrong else [])])
            wrong = wrong or bool(self.verdict.property("refused"))
        self.verdict.setPlainText(self.in_its_words(text))
        mark(self.verdict, "refused", wrong)


def _is_doubted(words: str) -> bool:
    """Whether light may be on or something move after a procedure that ended so."""
    return any(doubt in words for doubt in (UNSAFE, LIGHT_DOUBT, MOTION_DOUBT))


def _state(words: str) -> str:
    """Return in which state a procedure that ended so left the bench."""
    return "the bench may not be safe, see above" if _is_doubted(words) else "light off, nothing moves"
