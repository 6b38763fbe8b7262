"""What is done with files: every task that the terminal has, its form, its progress, its results."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QLineEdit, QWidget

from gui.background import NewestOnly
from gui.forms.fields import Behaviour
from gui.forms.form_stack import FormStack
from gui.forms.options_form import OptionsForm, SuggestedName
from gui.making import REST_MS, take_slice
from gui.panel import Panel
from gui.panels.found import FoundView
from gui.procedure_run import RunBar
from gui.session import BenchSession
from gui.session_news import OwnFiles
from gui.task_run import TaskRun, Told
from gui.widgets.building import (
    after_rest,
    choice,
    fill,
    label,
    split,
)
from gui.widgets.orientation import orientation_of
from gui.widgets.tab_order import tab_in_order
from gui.words import in_the_window, level_of, with_signs
from instrument.files.calibration_file import calibration_name, newest_calibration
from instrument.files.orientation import Kind
from instrument.tasks import CHARTS, TASKS, VIDEOS
from instrument.tasks.task import WRITTEN, Desk, Done, Task
from recon.base.as_python import Imports, expression
from recon.base.declare import Option

_FOLDERS = ("FOLDER", "RUN", "CALIBRATION", "OLD", "NEW", "VIDEO|RUN", "RUN|RESULT", "SHEET")
"""What an option is called that names a folder."""
_FILMS = ("run", "video")
"""Options that name what a calibration is needed for."""
_LEAST_FORM_PX = 300
_BESIDE_PX = 8
"""Of a field, on each side of its words."""
_CALIBRATION = "calibration"


class _Page(NamedTuple):
    """A task with its form."""

    task: Task
    form: OptionsForm
    names: SuggestedName | None


class TasksPanel(Panel):
    """One task at a time: chosen, filled in, carried out, its results beside the form."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.run = TaskRun(session.jobs, self)
        self._tasks: dict[str, Task] = {}
        """Those that are loaded."""
        self._pages: dict[str, _Page] = {}
        """Those whose forms are whole."""
        self._loader = NewestOnly(session.jobs, "Preparing a form", lambda why: self.refused(None, why))
        self._newest = NewestOnly(session.jobs, "Looking for the newest calibration")
        self._given: dict[str, Path] = {}
        self._lent_px = 0
        """Width that the form has lent to a table, until it is taken back or the border is moved."""

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        session = self.session
        self.choice = choice((), "What to do")
        self.choice.setAccessibleName("Task")
        for name, entry in TASKS.items():
            self.choice.addItem(f"{entry.title}", name)
            tip = f"{entry.help}\ndiffuserbench {name}"
            self.choice.setItemData(self.choice.count() - 1, tip, Qt.ItemDataRole.ToolTipRole)
        self.about = label(role="dim", wraps=True)
        self.stack = FormStack(lambda name: _form_of(self._tasks[name]), self._made)
        self._making = after_rest(self, REST_MS, self._make_form)
        tip = "Wait where it next tells how far it is; press again to go on"
        end = "End as soon as possible; what can be kept is kept"
        self.run_bar = RunBar(self.run, "Start", tips=(tip, end))
        left = fill(QWidget(), self.choice, self.about, (self.stack, 1), self.run_bar, margins=(0, 0, 6, 0))
        yield
        seen = partial(orientation_of, session, "results")
        self.found = FoundView(session.jobs, seen)
        self.found.lacks.connect(self._lend)
        self.found.opened.connect(self._open_result)
        self.found.used.connect(self._use)
        yield
        self._across = split(left, self.found, sizes=[430, 800], stretch=1, firm=True)
        self._across.splitterMoved.connect(lambda _x, _i: setattr(self, "_lent_px", 0))
        fill(self.body, self._across)
        self.choice.currentIndexChanged.connect(self._chosen)
        self.run_bar.start.connect(self.start)
        self.run.told.connect(self._told)
        self.run.succeeded.connect(self._succeeded)
        self.run.ended_early.connect(self._ended)
        self.run.failed.connect(self._failed)
        self.run.over.connect(self._over)
        self._running = self.name
        """The task that goes on, or went on last."""
        self._refused = False
        """Whether it failed, and says why."""
        self._out: Path | None = None
        """Its result."""
        self._calibrations: Sequence[Path] = ()
        """Which of the files that it wrote are calibrations."""
        self._chosen()

    def wholes(self) -> list[QWidget]:
        """Return the pages of the forms: after a day there are many."""
        return self.stack.pages()

    # The form ------------------------------------------------------------------------------------
    @property
    def name(self) -> str:
        """The task that is chosen."""
        return str(self.choice.currentData())

    @property
    def options_form(self) -> OptionsForm | None:
        """The form whose fields messages are about."""
        return self._pages[self.name].form if self.name in self._pages else None

    def choose(self, name: str, **values: Any) -> None:
        """Choose a task and fill in some of its options, as soon as its form is there.

        While one goes on no other is chosen, and the last line says so.
        """
        if self.run.is_running:
            self.refused(None, f"{TASKS[self._running].title} goes on: wait for its end, or end it.")
            return
        self._given = values
        self.choice.setCurrentIndex(self.choice.findData(name))
        self._chosen()

    def take(self, what: Any) -> None:
        """Show a task, with what another panel hands on filled in: the task's name, and options by name."""
        name, values = what
        self.choose(name, **values)

    def _chosen(self) -> None:
        name, entry = self.name, TASKS[self.name]
        self.about.setText(with_signs(f"{entry.help[:1].upper()}{entry.help[1:]}."))
        if name in self._pages:
            self._show_form(name)
            return
        self.run_bar.set_startable("Its form is being prepared.")
        self._loader.ask(entry.load, lambda task: self._loaded(name, task), name)

    def _loaded(self, name: str, task: Task) -> None:
        self._tasks[name] = task
        if name == self.name:
            self.stack.show_page(name)
            self._making.start()

    def _make_form(self) -> None:
        """Make the form that is shown, a slice at a time."""
        name = self.name
        if name not in self._tasks:
            return  # another one was chosen meanwhile, and is being loaded
        try:
            take_slice(self.stack.parts(name))
            self._making.start()
        except StopIteration:
            tab_in_order(self.stack.page(name), after=self.choice)
            self._show_form(name)

    def _show_form(self, name: str) -> None:
        self.stack.show_page(name)
        page = self._pages[name]
        if self._given:
            page.form.set_values(self._given)
            self._given = {}
        if not self.run.is_running:
            if name != self._running:  # what another task found is not this one's
                self._clear()
                self._running = name
            self.run_bar.clear()
            self.run_bar.set_startable()
        self._look_for_calibration(name)  # what it says of that stays

    def _made(self, name: str) -> None:
        """Fill in what a form begins with, once it is whole."""
        task, form = self._tasks[name], self.stack[name]
        if task.subject:
            form.show_for(task.subject)
        form.refused.connect(self.refused)
        form.settled.connect(partial(self._settled, name))
        form.set_values({"bench": self.session.config.path})
        names, place = None, _place_of(task)
        out = next((o for o in _options_of(task) if o.name == "out"), None)
        if place is None and out is not None and out.is_required and out.declaration.metavar == "FOLDER":
            place = Path(name)  # a folder of its own: nothing hangs on what it is called
        if place is not None:
            suffix = "".join(place.suffixes).replace(".pdf", ".png")  # what can be shown beside the form
            names = SuggestedName(self.jobs, form, self.session.runs_folder / "results", suffix)
            form.set_values({"out": None})
            names.suggest(place.name.partition(".")[0])
        self._pages[name] = _Page(task, form, names)

    def _settled(self, name: str, field: str) -> None:
        if name == self._running and self._refused and not self.run.is_running:
            self._clear()  # what stood against it may be mended
            self.run_bar.clear()
        if field in _FILMS and name in self._pages:
            self._look_for_calibration(name)

    def _look_for_calibration(self, name: str) -> None:
        """Begin with the newest calibration where one is needed: to see a recording's scene, too."""
        page, folder = self._pages[name], self.session.runs_folder
        fields = page.form.fields
        if (field := fields.get(_CALIBRATION)) is None:
            return
        film = fields.get("run") or fields.get("video")
        recording = "" if film is None else str(film.raw()).rstrip("/\\")
        takes_one = "run" in fields or (bool(recording) and not recording.endswith(".zarr"))
        other = "psf" in fields and str(fields["psf"].raw()).strip()
        if field.option.is_required or _CALIBRATION in page.task.needed or (takes_one and not other):
            self._newest.ask(
                lambda: newest_calibration(folder), lambda newest: self._offer_calibration(name, newest), name
            )

    def _offer_calibration(self, name: str, newest: Path | None) -> None:
        """Begin with the newest calibration where none was named."""
        form = self._pages[name].form
        if newest is None or str(form.fields[_CALIBRATION].raw()).strip():
            return
        form.set_values({_CALIBRATION: newest})
        if name == self.name and not self.run.is_running:
            called = calibration_name(newest)
            self.run_bar.words.setText(
                f"Calibration: {called}, the newest of this bench, for none was chosen."
            )

    def objects(self) -> dict[str, object] | None:
        """Return the options objects that the form asks for; None, and fields marked, where it cannot be."""
        page = self._pages.get(self.name)
        if page is None or not page.form.check():
            return None

        fields = page.form.fields  # without what Python alone can ask for

        def made() -> dict[str, object]:
            return {
                parameter: cls(**{o.name: page.form.value(o.name) for o in offered if o.name in fields})
                for parameter, (cls, offered) in page.task.parts.items()
            }

        return self.asked(made)

    def as_python(self) -> str:
        """Return lines that carry out the task as the form stands."""
        objects = self.objects()
        if objects is None:
            return f"# {self.title}: the form has mistakes.\n"
        module, _, function = TASKS[self.name].place.partition(":")
        imports = Imports({(f"instrument.tasks.{module}", function), ("instrument.tasks.task", "Printed")})
        given = "".join(f", {name}={expression(value, imports)}" for name, value in objects.items())
        return "\n".join([*imports.lines(), "", f"print({function}.carry_out(Printed(){given}))", ""])

    # Carrying out --------------------------------------------------------------------------------
    def start(self) -> None:
        """Carry out what the form asks for, as soon as the result has a name that no file has."""
        names = self._pages[self.name].names if self.name in self._pages else None
        if self.run.is_running or (
            names is not None and names.once_known(partial(self._start_of, self.name))
        ):
            return
        objects = self.objects()
        if objects is None:
            return
        self._running = self.name
        page = self._pages[self.name]
        self._out = out = page.form.value("out") if page.names is not None else None
        self._calibrations = ()

        def do(desk: Desk) -> Done:
            if page.names is not None and out is not None:
                page.names.make_room(out)
            done = page.task.carry_out(desk, **objects)
            self._calibrations = [path for path in done.files if (path / "calibration.json").is_file()]
            return done

        self._clear()
        self.run_bar.set_running(True)
        self.stack.setEnabled(False)
        self.choice.setEnabled(False)
        seen = {kind: orientation_of(self.session, kind) for kind in get_args(Kind)}
        self.run.start(TASKS[self.name].title, do, seen)

    def _start_of(self, name: str) -> None:
        if name == self.name:  # no other was chosen meanwhile
            self.start()

    def _clear(self) -> None:
        self._refused = False
        self.found.clear()
        self._take_back()

    def _told(self, told: Told) -> None:
        text = self._pages[self._running].form.in_its_words(in_the_window(told.text))
        if told.kind == "table":
            self.found.add_table(told.headings, told.rows, text)
            return
        if told.kind == "warn":
            level, said = level_of(text)
            self.session.log(level, said)
            text = f"⚠ {said}" if level == "warning" else text
        self.found.say(text)

    def _lend(self, lacking: int) -> None:
        """Give tables and pictures what they lack of the form's width, until something else is shown."""
        form, results = self._across.sizes()
        if (more := min(lacking, form - _LEAST_FORM_PX, self._spare_px())) > 0:
            self._lent_px += more
            self._across.setSizes([form - more, results + more])

    def _spare_px(self) -> int:
        """Return how much narrower the form may be before the words in its empty fields are cut off."""
        lines = self._pages[self._running].form.findChildren(QLineEdit)
        said = ((line, line.placeholderText()) for line in lines if line.isVisible() and not line.text())
        spare = (
            line.width() - line.fontMetrics().horizontalAdvance(words) - 2 * _BESIDE_PX
            for line, words in said
            if words
        )
        return min(spare, default=self.width())

    def _take_back(self) -> None:
        lent, self._lent_px = self._lent_px, 0
        if lent:
            form, results = self._across.sizes()
            self._across.setSizes([form + lent, results - lent])

    def _succeeded(self, done: Done) -> None:
        for path in done.files:
            self.session.log("info", f"Wrote {path}")
        if done.kept:
            self._told(Told("warn", done.kept))
        elif not done.good:
            self.found.mark_wrong(True)
        page = self._pages[self._running]
        if (
            page.names is not None
            and self._out is not None
            and not done.kept
            and TASKS[self._running].group != CHARTS
        ):
            # What was interrupted, and a chart that has more to do, is gone on with under the same name.
            page.names.suggest(re.sub(r"-\d+$", "", self._out.name.partition(".")[0]))
        self.found.show_files(done.files, usable=any(map(self._panel_for, done.files)))
        self.run_bar.show_end("Ended early" if done.kept else "Done", complete=not done.kept)

    def _failed(self, why: str) -> None:
        self._refused = True
        self._ended(self._pages[self._running].form.in_its_words(in_the_window(why)), wrong=True)

    def _ended(self, words: str, *, wrong: bool = False) -> None:
        self.found.say(words)
        self.found.mark_wrong(wrong)  # a deliberate end is no error
        first, _, more = words.splitlines()[0].partition(". ")
        self.run_bar.show_end(f"{first}." if more else first, complete=False)

    def _over(self) -> None:
        words = self.run_bar.words.text()
        self.run_bar.set_running(False)
        self.run_bar.words.setText(words)
        self.stack.setEnabled(True)
        self.choice.setEnabled(True)

    # Results -------------------------------------------------------------------------------------
    def _panel_for(self, path: Path) -> str:
        """Return the name of the panel that works with a result; empty where there is none."""
        if path.name in ("chart.json", "stability.json"):
            return "charts"
        if path.name.endswith(".ome.zarr") and TASKS[self._running].group == VIDEOS:
            return "films"
        if self._running == "import":
            return "films"
        if self._running == "spots" and path.suffix == ".png" and "slm" in self.session.kinds:
            return "slm"
        return "reconstructions" if path in self._calibrations or self._is_picture(path) else ""

    def _is_picture(self, path: Path) -> bool:
        """Whether a file is a reconstruction with its record."""
        return self._running == "patterned" and path == self._out

    def _hand_on(self, path: Path) -> bool:
        """Take a result to the panel that works with it, if there is one."""
        if panel := self._panel_for(path):
            what = OwnFiles(result=path) if self._is_picture(path) else path
            self.session.handed_on.emit(panel, what)
        return bool(panel)

    def _open_result(self, path: Path) -> None:
        """Open a file in the panel that works with it, else as the desktop does."""
        if not self._hand_on(path):
            self.found.open_as_desktop(path)

    def _use(self) -> None:
        any(map(self._hand_on, self.found.files))  # the first that a panel works with

    def shutdown(self) -> None:
        """End the task."""
        super().shutdown()
        self.run.abort()
        for each in (self._loader, self.found, self._newest):
            each.forget()


def _options_of(task: Task) -> list[Option]:
    return [o for _, offered in task.parts.values() for o in offered]


def _place_of(task: Task) -> Path | None:
    """Return what a task's result is called where it names none itself; None where it needs no name."""
    out = next((o for o in _options_of(task) if o.name == "out"), None)
    return task.out or (None if out is None or not isinstance(out.default, Path) else out.default)


def _form_of(task: Task) -> OptionsForm:
    """Return a task's form, no part of it made yet."""
    options = _options_of(task)
    needed = (*task.needed, *(() if _place_of(task) is None else ("out",)))  # what has a name in the terminal
    special = {o.name: _behaviour(o, needed=o.name in needed) for o in options if _names_files(o)}
    return OptionsForm(options, special, whole=False)


def _names_files(o: Option) -> bool:
    return Path in (o.item, *o.kinds) or o.declaration.metavar.endswith("FILE")


def _behaviour(o: Option, *, needed: bool) -> Behaviour:
    """Return how a path is chosen: what is written by a new name, what is read by what is there."""
    folder = o.declaration.metavar.removesuffix("...").strip("[]") in _FOLDERS
    if o.name in WRITTEN:
        return Behaviour(browse="folder" if folder else "save", needed=needed)
    exists = o.kinds == (Path,)
    return Behaviour(browse="folder" if folder else "open", must_exist=exists, needed=needed)
