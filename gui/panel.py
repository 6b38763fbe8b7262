"""What every panel has: its session, "Copy as Python", a line for what was refused; panels of one device."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar, cast

from PySide6.QtCore import QTimer
from PySide6.QtGui import QGuiApplication
from PySide6.QtWidgets import QAbstractButton, QBoxLayout, QLabel, QSizePolicy, QWidget

from gui.forms.options_form import OptionsForm
from gui.jobs import BusyError, Job, JobRunner, Work
from gui.session import BenchSession
from gui.session_news import name_of
from gui.widgets.building import Hint, after_rest, button, every, fill, in_row, label, mark
from gui.widgets.dialogues import elided
from gui.widgets.entry import Refusing
from gui.words import in_the_window
from instrument.bench.config import Kind
from instrument.files.errors import BenchError
from recon.base.as_python import Imports
from recon.errors import InputError

_REFUSAL_MS = 12_000
_T = TypeVar("_T")


class Panel(QWidget):
    """A part of the window. Subclasses fill ``body`` and say ``as_python``.

    One with many widgets makes them in ``parts``, so that STOP is heard in between.

    Parameters
    ----------
    session : BenchSession
    """

    title = ""
    """On its tab; the table of panels has it."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.session = session
        self.destroyed.connect(session.jobs.silence)  # panels live as long as their window
        self._needing: dict[QWidget, tuple[Sequence[Kind], str]] = {}
        """Which devices a button needs, with its tool tip of where it has them."""
        session.device_changed.connect(self._forget_fault)
        session.device_changed.connect(self.let_press)
        self.body = QWidget()
        """Where the panel's own widgets go: give it a layout."""
        self.body.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self._note = label(selectable=True, wraps=True, yields=True)
        self._note.setObjectName("refusal")
        tip = "Copy the lines of Python that do what this panel is set to"
        self.copy_button = button("Copy as Python", tip, self.copy_as_python)
        self.copy_button.setObjectName("copy-as-python")
        self.copy_button.setFlat(True)
        self._tips: dict[QWidget, str] = {}
        """What was refused here, with the tool tip that it had."""
        self._said_of: QWidget | None = None
        """The field that the last line is about, where it is about one."""
        self._heeded: set[Refusing] = set()
        self._busy: tuple[str, QWidget | None] | None = None
        """What was refused last because something else went on, and at which field."""
        session.jobs.job_ended.connect(self._forget_busy)
        self._fade = after_rest(self, _REFUSAL_MS, self.accepted)
        fill(self, (self.body, 1), in_row((self._note, 1), self.copy_button), margins=(8, 8, 8, 4), spacing=4)

    @classmethod
    def prepare(cls) -> None:
        """Import and compile what the panel needs first; in any thread, before one is made."""

    def parts(self) -> Iterator[None]:
        """Make the panel's widgets, with a ``yield`` at least every 20 ms of processor time."""
        yield

    def wholes(self) -> Sequence[QWidget]:
        """Return what takes a theme for itself: large forms, each in a turn; the panel where it has none.

        What holds one looks as the palette says, and what is put straight into that later is to be dressed.
        """
        return [self]

    @property
    def jobs(self) -> JobRunner:
        """Where the panel's work is done."""
        return self.session.jobs

    def as_python(self) -> str:
        """Return the lines of Python that do what the panel is set to do."""
        raise NotImplementedError

    def copy_as_python(self) -> None:
        """Put the panel's Python lines on the clipboard."""
        QGuiApplication.clipboard().setText(self.as_python())
        self.session.log("info", f"{self.title}: copied as Python.")

    def take(self, what: Any) -> None:
        """Work with what another panel hands on: mostly the path of a file or folder; for panels that can."""
        raise NotImplementedError

    def shutdown(self) -> None:
        """End the timers in the panel, and in subclasses its work; called before the window closes."""
        for timer in self.findChildren(QTimer):
            timer.stop()

    def put_below(self, widget: QWidget, stretch: int = 0) -> None:
        """Put something between ``body`` and the panel's last line."""
        own = self.layout()
        assert isinstance(own, QBoxLayout)
        own.insertWidget(1, widget, stretch)

    # Telling the user ----------------------------------------------------------------------------
    @property
    def options_form(self) -> OptionsForm | None:
        """The form whose fields messages are about; None where the panel has none."""
        return None

    def in_its_words(self, text: str) -> str:
        """Return a message with the form's labels for the terminal's flags, and panels for its commands."""
        text = in_the_window(text)
        return text if self.options_form is None else self.options_form.in_its_words(text)

    def refused(self, field: QWidget | None, why: str) -> None:
        """Show why something was refused: at the field, and in the panel's last line."""
        why = self.in_its_words(why)
        if field is not None:
            if not field.property("refused"):
                self._tips[field] = field.toolTip()
            mark(field, "refused", True)
            field.setToolTip(why)
        elided(self._note, why)
        self._said_of = field
        if isinstance(field, Refusing):
            self._clear_with(field)
        self._fade.start()

    def heed(self, field: Refusing) -> None:
        """Have what a field refuses told in the panel's last line, until it is mended."""

        def refused(why: str) -> None:
            self.refused(None, why)
            self._said_of = field

        field.refused.connect(refused)
        self._clear_with(field)

    def _clear_with(self, field: Refusing) -> None:
        """Clear the last line when a field that it is about is mended."""

        def mended() -> None:
            if self._said_of is field:
                self.accepted()

        if field not in self._heeded:
            self._heeded.add(field)
            field.mended.connect(mended)

    def accepted(self, field: QWidget | None = None) -> None:
        """Clear what ``refused`` showed: the line, the field, and all buttons, which hold nothing to mend."""
        if isinstance(field, Refusing):  # which may have marked itself, and knows its own tip
            field.accept()
            self._tips.pop(field, None)
        for each in [w for w in self._tips if w is field or isinstance(w, QAbstractButton)]:
            mark(each, "refused", False)
            each.setToolTip(self._tips.pop(each))
        self._note.clear()
        self._note.setToolTip("")

    def _forget_fault(self, kind: str) -> None:
        """Take a device's failure away that is over; the log keeps it."""
        device = self.session.bench.devices.get(cast(Kind, kind))
        if device is None or not self.session.is_open(kind):
            return
        if in_the_window(device.name) in self._note.toolTip():
            self.accepted()

    # What needs a device -------------------------------------------------------------------------
    def lacks(self, kinds: Sequence[Kind]) -> str:
        """Return why devices of the bench cannot be used now, the first of them that cannot; or nothing."""
        for kind in kinds:
            state = self.session.state(kind)
            if kind in self.session.kinds and state.condition != "open":
                return state.text or f"The {name_of(kind)} is {state.condition}."
        return ""

    def only_with(self, kinds: Sequence[Kind], *buttons: QWidget) -> None:
        """Have buttons pressed only while devices are open; their tool tips say why they are not."""
        for each in buttons:
            _, tip = self._needing.get(each, ((), each.toolTip()))
            self._needing[each] = kinds, tip
        self.let_press()

    def let_press(self, _kind: str = "") -> None:
        """Let buttons be pressed whose devices are open."""
        for each, (kinds, tip) in self._needing.items():
            why = self.lacks(kinds)
            if each in self._tips and why:  # what it was refused for is the same, or older
                mark(each, "refused", False)
                del self._tips[each]
            if each not in self._tips:
                each.setToolTip(f"{tip}. {why}" if why else tip)
            each.setEnabled(not why)

    def asked(self, make: Callable[[], _T]) -> _T | None:
        """Return what a form asks for; None, and the reason shown, where that makes no sense."""
        try:
            made = make()
        except (BenchError, InputError) as error:
            self.refused(None, str(error))
            return None
        self.accepted()
        return made

    def follow(self, job: Job, field: QWidget | None = None) -> Job:
        """Have a job's failure shown at a field and in this panel's last line; returns the job."""
        job.failed.connect(lambda why: self.refused(field, why))
        return job

    def begin(self, start: Callable[[], Job], field: QWidget | None = None) -> Job | None:
        """Start a job, or show why not (None): the devices may be too busy. Its failure is shown, too."""
        try:
            return self.follow(start(), field)
        except BusyError as error:
            self.refused(field, str(error))
            self._busy = self._note.toolTip(), field
            return None

    def _forget_busy(self, job: Job) -> None:
        """Take away that something was in the way, once it has ended."""
        if self._busy is not None and (job.exclusive or job.endless):
            (said, field), self._busy = self._busy, None
            if self._note.toolTip() == said:
                self.accepted(field)


class _InParts(Protocol):
    def parts(self) -> Iterator[None]: ...


_P = TypeVar("_P", bound=_InParts)


def whole(widget: _P) -> _P:
    """Return a panel, or what else is made in parts, with all of them made, at once."""
    for _ in widget.parts():
        pass
    return widget


class DevicePanel(Panel):
    """A panel of one kind of device, which looks at it again and again while it is seen.

    Subclasses set ``kind`` and ``look_ms``, call ``watch_device`` when they are made, and have ``look`` and
    ``show_device``.
    """

    kind: ClassVar[Kind]
    look_ms: ClassVar[int]

    def watch_device(self, state: QLabel, other: tuple[str, Callable[[], object]] | None = None) -> None:
        """Begin to look at the device; while it is not open, there is only why, and the way on.

        ``state`` says the same. ``other``: another way on than to reconnect, its words and what it does.
        """
        self._state_label = state
        again = partial(self.session.reconnect, self.kind)
        self.closed = Hint("", f"Reconnect the {name_of(self.kind)}", again, other)
        """In the place of ``body`` while the device is not open."""
        self.put_below(self.closed, 1)
        self.session.device_changed.connect(self._device_changed)
        every(self, self.look_ms, self.look)
        self._device_changed(self.kind)

    @property
    def is_ready(self) -> bool:
        """Whether the panel is seen and the device is open."""
        return self.isVisible() and self.session.is_open(self.kind)

    def look(self) -> None:
        """Show how the device is now."""
        raise NotImplementedError

    def command(self, title: str, work: Work, field: QWidget | None = None) -> Job | None:
        """Have the device do something, in a job; a refusal is shown at the field, then how the device is."""
        job = self.begin(lambda: self.jobs.device(title, work, {self.kind}), field)
        if job is not None:
            job.succeeded.connect(lambda _: self._done(field))
        return job

    def _done(self, field: QWidget | None) -> None:
        self.accepted(field)
        self.look()

    def show_device(self, is_open: bool) -> None:
        """Let it be used, or not."""
        raise NotImplementedError

    def _device_changed(self, kind: str) -> None:
        if kind != self.kind:
            return
        is_open = self.session.is_open(kind)
        self.show_device(is_open)
        self.body.setVisible(is_open)
        self.closed.setVisible(not is_open)
        if not is_open:
            state, name = self.session.state(kind), name_of(kind)
            has_one = kind in self.session.kinds
            why = (
                state.text or f"The {name} is {state.condition}." if has_one else f"This bench has no {name}."
            )
            elided(self._state_label, why)
            self.closed.say(why, busy=state.condition != "failed")


def on_bench(bench: Path | None, lines: Sequence[str], imports: Imports, before: Sequence[str] = ()) -> str:
    """Return Python lines that are done with a bench open: ``bench``.

    Parameters
    ----------
    bench : Path, optional
        Its bench.toml; None: the built-in simulated bench.
    lines : sequence of str
        What is done with it.
    imports : Imports
        Of what ``lines`` and ``before`` need.
    before : sequence of str
        What is done before.
    """
    imports.names.add(("instrument.bench.bench", "open_bench"))
    opened = "with open_bench() as bench:" if bench is None else f"with open_bench({str(bench)!r}) as bench:"
    return "\n".join([*imports.lines(), "", *before, opened, *(f"    {line}" for line in lines), ""])
