"""A panel that fills in a form, checks it as it is typed, and carries the procedure out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from PySide6.QtCore import Qt, QTimer
from PySide6.QtWidgets import (
    QComboBox,
    QLabel,
    QPlainTextEdit,
    QPushButton,
    QSplitter,
    QStackedWidget,
    QVBoxLayout,
    QWidget,
)

from calibration_routines.procedure import Outcome, Outlook, Procedure
from gui.forms.options_form import OptionsForm, scrolled
from gui.forms.routines import Form
from gui.jobs import BusyError, Job, JobContext
from gui.panel import Panel
from gui.procedure_run import Ended, ProcedureRun, Situation, script
from gui.session import BenchSession
from gui.widgets.run_bar import RunBar
from instrument.bench.bench import Bench
from instrument.files.errors import BenchError, SettingsError, count, duration, size

_CHECK_MS = 250
"""Rest after a key before what was typed is checked."""
_SLOW_MS = 700
"""A check that takes longer than this is shown to go on: what was said of other values must not stay."""
_FORM_WIDTH_PX = 400


class ProcedurePanel(Panel):
    """Forms on the left, each checked against the bench as it is typed; subclasses fill the right side.

    Parameters
    ----------
    session : BenchSession
    forms : sequence of Form
    words : str
        On the start button.
    parent : QWidget, optional
    """

    handed_to: ClassVar[str] = "reconstructions"
    """The panel that works with what was calibrated."""
    use_words: ClassVar[str] = "Reconstruct with it…"

    def __init__(
        self, session: BenchSession, forms: Sequence[Form], words: str, parent: QWidget | None = None
    ) -> None:
        super().__init__(session, parent)
        self.forms = tuple(forms)
        self.run = ProcedureRun(session, self)
        self.outlook: Outlook | None = None
        """Of the form as it stands, once it was checked."""
        self.views = {form.name: OptionsForm(form.fields) for form in self.forms}
        self.choice = QComboBox()
        self.choice.setToolTip("What to do")
        self.choice.setAccessibleName("Routine")
        self.stack = QStackedWidget()
        for form in self.forms:
            self.choice.addItem(form.title)
            self.choice.setItemData(self.choice.count() - 1, form.tip, Qt.ItemDataRole.ToolTipRole)
            self.stack.addWidget(scrolled(self.views[form.name]))
            self.views[form.name].changed.connect(self._typed)
        self.about = QLabel()
        self.about.setObjectName("dim")
        self.about.setWordWrap(True)
        self.verdict = QPlainTextEdit()
        self.verdict.setReadOnly(True)
        self.verdict.setToolTip("What will be done and why, or what stands against it; can be copied")
        self.verdict.setMaximumHeight(150)
        self.run_bar = RunBar(words)
        self.use_button = QPushButton(self.use_words)
        self.use_button.setToolTip("Take what was measured to where it is used")
        self.use_button.hide()
        self.use_button.clicked.connect(self._use)
        self._result: Path | None = None
        self.go_on_button = QPushButton("Go on with it…")
        self.go_on_button.setToolTip("Open the run that ended early among the runs, where it is resumed")
        self.go_on_button.hide()
        self.go_on_button.clicked.connect(self._go_on)
        self._unfinished: Path | None = None
        left = QWidget()
        column = QVBoxLayout(left)
        column.setContentsMargins(0, 0, 6, 0)
        if len(self.forms) > 1:
            column.addWidget(self.choice)
        column.addWidget(self.about)
        column.addWidget(self.stack, 1)
        column.addWidget(self.verdict)
        column.addWidget(self.run_bar)
        column.addWidget(self.use_button)
        column.addWidget(self.go_on_button)
        self.right = QWidget()
        """For the subclass."""
        split = QSplitter()
        split.addWidget(left)
        split.addWidget(self.right)
        split.setSizes([_FORM_WIDTH_PX, 3 * _FORM_WIDTH_PX])
        split.setStretchFactor(1, 1)
        split.setChildrenCollapsible(False)
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(split)

        self._started: set[str] = set()
        self._check_job: Job | None = None
        self._again = False
        self._unchecked = False
        """Whether the bench was busy when the form was to be checked."""
        self._rest = QTimer(self)
        self._rest.setSingleShot(True)
        self._rest.setInterval(_CHECK_MS)
        self._rest.timeout.connect(self.check)
        self._slow = QTimer(self)
        self._slow.setSingleShot(True)
        self._slow.setInterval(_SLOW_MS)
        self._slow.timeout.connect(lambda: self._say("This is being checked …", wrong=False))
        self.choice.currentIndexChanged.connect(self._chosen)
        self.run_bar.start.connect(self.start)
        self.run_bar.pause.connect(self.run.pause)
        self.run_bar.resume.connect(self.run.resume)
        self.run_bar.abort.connect(self.run.abort)
        self.run.looked.connect(self._looked)
        self.run.said.connect(lambda line: self.session.log("info", line))
        self.run.succeeded.connect(self._succeeded)
        self.run.ended_early.connect(self._ended_early)
        self.run.failed.connect(self._failed)
        self.run.over.connect(self._over)
        session.device_changed.connect(lambda _: self._rest.start())
        session.jobs.job_ended.connect(self._job_ended)
        self._chosen()

    # The form ------------------------------------------------------------------------------------
    @property
    def form(self) -> Form:
        """The form that is shown."""
        return self.forms[self.choice.currentIndex()]

    @property
    def view(self) -> OptionsForm:
        """The form that is shown, as a widget."""
        return self.views[self.form.name]

    def choose(self, name: str) -> None:
        """Show another form."""
        self.choice.setCurrentIndex([form.name for form in self.forms].index(name))

    def procedure(self) -> Procedure | None:
        """Return what the form asks for; None, and fields marked, where it makes no sense."""
        values = self.view.values()
        if values is None:
            return None
        try:
            return self.form.make(values)
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
        if self.run.is_running:
            return
        if self._check_job is not None:
            self._again = True
            return
        self.outlook, self._unchecked = None, False
        missing = [kind for kind in ("camera", *self.form.needs) if not self.session.is_open(kind)]
        if missing:
            names = " and ".join(kind.replace("_", " ") for kind in missing)
            self._say(f"The bench has no {names} that is open.", wrong=True)
            self.run_bar.set_startable("Not all devices are open.")
            return
        bench, form = self.session.bench, self.form
        first = form.start if form.name not in self._started else None
        procedure = self.procedure() if first is None else None
        if procedure is None and first is None:
            self.run_bar.set_startable("The form has mistakes.")
            return
        self.run_bar.set_startable("It is being checked.")

        def work(_: JobContext) -> _Checked:
            return _check(form.name, bench, procedure, first)

        try:
            self._check_job = self.session.device_job(f"Checking: {form.title}", work, {"stage"}, quiet=True)
        except BusyError as error:
            self.run_bar.set_startable(str(error))
            self._unchecked = True
            return
        self._slow.start()
        self._check_job.succeeded.connect(self._checked)
        self._check_job.failed.connect(self._check_failed)
        self._check_job.ended.connect(self._check_ended)

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
                f"{count(cost.frames, 'frame')}, {size(cost.total_bytes)}{free}, {duration(cost.seconds)} of "
                f"exposure and motion, {count(cost.moves, 'move')}",
            )
        self._say("\n".join(lines), wrong=False)

    # Carrying out --------------------------------------------------------------------------------
    def start(self) -> None:
        """Carry out what the form asks for."""
        procedure = self.procedure()
        if procedure is None or self.run.is_running:
            return
        self.carry_out(self.form.title, procedure)

    def carry_out(self, title: str, procedure: Procedure) -> None:
        """Carry out a procedure."""
        try:
            self.run.start(title, procedure)
        except BusyError as error:
            self.refused(None, str(error))
            return
        self.accepted()
        self.use_button.hide()
        self.go_on_button.hide()
        self._say(f"{title} goes on.", wrong=False)
        self.run_bar.set_running(True)
        self.stack.setEnabled(False)
        self.choice.setEnabled(False)
        self.began()

    def began(self) -> None:
        """Clear what the last procedure left on the right; for subclasses."""

    def looked(self, now: Situation) -> None:
        """Show the situation on the right; for subclasses."""

    def finished(self, outcome: Outcome) -> None:
        """Show a result on the right; for subclasses."""

    def shutdown(self) -> None:
        """End the timers."""
        self._rest.stop()
        self._slow.stop()
        self.run.shutdown()

    # Inside --------------------------------------------------------------------------------------
    def _chosen(self) -> None:
        self.stack.setCurrentIndex(self.choice.currentIndex())
        self.about.setText(f"{self.form.tip.removesuffix('.')}.")
        self._typed()

    def _typed(self) -> None:
        self.run_bar.set_startable("It is being checked.")
        self._rest.start()

    def _checked(self, found: _Checked) -> None:
        if found.start is not None:
            self._started.add(found.form)
            self.views[found.form].begin_with(found.start)
            self._again = True
            return
        if found.form != self.form.name:  # another one was chosen meanwhile, and waits for its check
            return
        if found.error is not None:
            self.show_problem(found.error)
            self.run_bar.set_startable("It cannot be done; see below the form.")
        else:
            assert found.outlook is not None
            self.outlook = found.outlook
            self.show_outlook(found.outlook)
            self.run_bar.set_startable()

    def _check_failed(self, why: str) -> None:
        self._say(why, wrong=True)
        self.run_bar.set_startable("It cannot be checked; see below the form.")

    def _check_ended(self) -> None:
        self._check_job = None
        self._slow.stop()
        if self._again:
            self._again = False
            self.check()

    def _job_ended(self, job: Job) -> None:
        if self._unchecked and job.lanes:
            self._rest.start()

    def _looked(self, now: Situation) -> None:
        self.run_bar.show_situation(now)
        self.looked(now)

    def _use(self) -> None:
        self.session.handed_on.emit(self.handed_to, self._result)

    def _go_on(self) -> None:
        self.session.handed_on.emit("runs", self._unfinished)

    def _succeeded(self, outcome: Outcome) -> None:
        where = [str(path) for path in (*outcome.runs, outcome.calibration, *outcome.files) if path]
        self._say("\n".join((*outcome.verdict, *where)), wrong=not outcome.good)
        for line in outcome.verdict:
            self.session.log("info" if outcome.good else "warning", line)
        pictures = [file for file in outcome.files if file.suffix == ".tif"]
        self._result = outcome.calibration or next(iter(pictures), None)
        self.use_button.setVisible(self._result is not None)
        self.run_bar.show_end("Done" if outcome.good else "Done, with findings", complete=True)
        self.finished(outcome)

    def _ended_early(self, ended: Ended) -> None:
        self._say(ended.words, wrong=True)
        self._unfinished = ended.run
        self.go_on_button.setVisible(ended.run is not None)
        self.session.log("warning", ended.words)
        self.run_bar.show_end("Ended early; nothing moves, light off", complete=False)

    def _failed(self, why: str) -> None:
        self._say(why, wrong=True)
        self.run_bar.show_end("Failed", complete=False)

    def _over(self) -> None:
        words = self.run_bar.words.text()
        self.run_bar.set_running(False)
        self.run_bar.words.setText(words)
        self.stack.setEnabled(True)
        self.choice.setEnabled(True)
        self.run_bar.set_startable()

    def _say(self, text: str, *, wrong: bool) -> None:
        self.verdict.setPlainText(text)
        self.verdict.setProperty("refused", wrong)
        self.verdict.style().unpolish(self.verdict)
        self.verdict.style().polish(self.verdict)


@dataclass(slots=True)
class _Checked:
    """What the check of a form found: values to begin with, an outlook, or what stands against it."""

    form: str
    start: dict[str, Any] | None = None
    outlook: Outlook | None = None
    error: BenchError | None = None


def _check(
    form: str, bench: Bench, procedure: Procedure | None, start: Callable[[Bench], Any] | None
) -> _Checked:
    found = _Checked(form)
    try:
        if start is not None:
            found.start = dict(start(bench))
        elif procedure is not None:
            found.outlook = procedure.outlook(bench)
    except BenchError as error:
        found.error = error
    return found
