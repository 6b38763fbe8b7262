"""The stage: where it is, where it shall go, jogging by keys, home."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from PySide6.QtCore import Qt
from PySide6.QtGui import QFocusEvent, QKeyEvent
from PySide6.QtWidgets import QFrame, QGridLayout, QLabel, QProgressBar, QPushButton, QVBoxLayout, QWidget

from drivers.stage import StageAxis
from gui.background import NewestOnly
from gui.jobs import Job
from gui.panel import DevicePanel, on_bench
from gui.session import BenchSession
from gui.widgets.building import button, fill, in_column, in_row, label, mark, share_bar
from gui.widgets.dialogues import Question
from gui.widgets.entry import NumberEdit
from gui.widgets.image_view import step_factor
from gui.widgets.kept_bar import KeptBar
from gui.words import grouped, quantity
from instrument.plan import Plan
from recon.base.as_python import Imports

_STEPS = {"um": 100.0, "mrad": 1.0}
"""Steps to begin with, by unit: a tenth of a millimetre, a milliradian."""
_KEYS: dict[Qt.Key, tuple[str, int]] = {
    Qt.Key.Key_Left: ("x", -1),
    Qt.Key.Key_Right: ("x", 1),
    Qt.Key.Key_Down: ("y", -1),
    Qt.Key.Key_Up: ("y", 1),
    Qt.Key.Key_PageDown: ("z", -1),
    Qt.Key.Key_PageUp: ("z", 1),
}
_GAUGE = 1000


@dataclass(slots=True)
class _Row:
    axis: StageAxis
    position: QLabel
    gauge: QProgressBar
    target: NumberEdit
    buttons: tuple[QPushButton, QPushButton]


class JogPad(QFrame):
    """Takes the arrow keys and PgUp, PgDn; its border shows when it does."""

    def __init__(self, panel: StagePanel) -> None:
        super().__init__(panel)
        self._panel = panel
        self.setObjectName("jog-pad")
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setAccessibleName("Jog by arrow keys")
        self.setToolTip(
            "With this in focus: arrow keys move x and y, PgUp and PgDn z;\nShift: ten steps, Ctrl: a tenth"
        )
        self.words = label("Click here, then  ← → ↑ ↓  PgUp PgDn\nShift × 10    Ctrl × 0.1", "dim")
        self.words.setAlignment(Qt.AlignmentFlag.AlignCenter)
        QVBoxLayout(self).addWidget(self.words)
        mark(self, "active", False)

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802 - Qt's name
        """Jog."""
        direction = _KEYS.get(Qt.Key(event.key()))
        if direction is None:
            super().keyPressEvent(event)
            return
        letter, sign = direction
        self._panel.jog(letter, sign * step_factor(event), repeated=event.isAutoRepeat())

    def focusInEvent(self, event: QFocusEvent) -> None:  # noqa: N802 - Qt's name
        """Show that keys go here."""
        super().focusInEvent(event)
        mark(self, "active", True)

    def focusOutEvent(self, event: QFocusEvent) -> None:  # noqa: N802 - Qt's name
        """Show that they do not any more."""
        super().focusOutEvent(event)
        mark(self, "active", False)


class StagePanel(DevicePanel):
    """Position, targets and limits of every axis; jogging; home, which asks first."""

    kind = "stage"
    look_ms = 200

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.rows: dict[str, _Row] = {}
        self.steps: dict[str, NumberEdit] = {}
        self.question: Question | None = None
        self._reader = NewestOnly(session.jobs, "Reading the stage")
        self.state = label(wraps=True)
        self.pad = JogPad(self)
        self.setFocusProxy(self.pad)
        tip = "Find the reference of every axis: the stage moves; asks first, and reconnects after a fault"
        self.home_button = button("Home…", tip, self.ask_home)
        tip = "End an alarm that homing does not end; asks first"
        self.unlock_button = button("Unlock…", tip, self.ask_unlock)
        self.unlock_button.hide()
        self._here: dict[str, float] | None = None
        """Where the stage said that it is."""
        self._is_homed = False
        self.places = KeptBar(session, "places", "Places", self._place_to_keep, self._go_to, "Go")
        tip = "Make a plan that takes a frame of the lit scene at every place: look at it, then start it"
        self.all_button = button("Photograph all places…", tip, self.photograph_all)
        session.kept_changed.connect(self._places_changed)
        self._places_changed()
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(6)
        self._grid.setColumnStretch(2, 1)
        self._step_row = in_row()
        fill(
            self.body,
            in_row((self.state, 1), self.unlock_button, self.home_button),
            self._grid,
            self._step_row,
            self.places,
            in_row(None, self.all_button),
            self.pad,
            None,
        )
        self.watch_device(self.state, ("Home…", self.ask_home))

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that bring the stage to where it is now."""
        here = {name: row.target.value for name, row in self.rows.items()}
        lines = ["if not bench.stage.is_homed:", "    bench.stage.home()", f"bench.stage.move_to({here!r})"]
        return on_bench(self.session.config.path, lines, Imports())

    # Rows ----------------------------------------------------------------------------------------
    def show_device(self, is_open: bool) -> None:
        """Let the stage be moved, or not; its axes have rows from when it is first open."""
        edited = [widget for row in self.rows.values() for widget in (row.target, *row.buttons)]
        for widget in (self.pad, self.places, *edited):
            widget.setEnabled(is_open)
        self.home_button.setEnabled(is_open or self.session.state(self.kind).condition == "failed")
        if is_open and not self.rows and self.session.bench.stage is not None:
            self._make_rows(self.session.bench.stage.axes)

    def _make_rows(self, axes: tuple[StageAxis, ...]) -> None:
        for number, axis in enumerate(axes):
            letter, unit = axis.name.rsplit("_", 1)[0], _words(axis.unit)
            position = label("–", "value")
            position.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
            position.setMinimumWidth(110)
            position.setToolTip(f"Where the stage says that {letter} is")
            gauge = share_bar(_GAUGE)
            lower, upper = quantity(axis.lower_limit, unit, 6), quantity(axis.upper_limit, unit, 6)
            limits = f"{lower} to {upper}"
            gauge.setToolTip(f"Place between the soft limits: {limits}")
            target = NumberEdit(
                unit,
                minimum=axis.lower_limit,
                maximum=axis.upper_limit,
                tip=f"Where to move {letter}; Enter moves. Soft limits:",
            )
            target.setFixedWidth(120)
            target.submitted.connect(partial(self._move_to, axis.name))
            self.heed(target)
            minus, plus = (
                button(text, "Jog by one step", partial(self._jog_clicked, letter, sign))
                for text, sign in (("−", -1), ("+", 1))
            )
            minus.setAccessibleName(f"{letter}: one step back")
            plus.setAccessibleName(f"{letter}: one step forward")
            minus.setFixedWidth(34)
            plus.setFixedWidth(34)
            span = f"{lower.removesuffix(upper.split()[-1]).rstrip()} … {upper}"
            limit = label(span.replace("-", "−"), "dim")
            limit.setToolTip("Soft limits")
            self._grid.addWidget(label(letter, "value"), number, 0)
            self._grid.addLayout(in_column(gauge, limit, spacing=1), number, 2)
            for place, widget in {1: position, 3: minus, 4: target, 5: plus}.items():
                self._grid.addWidget(widget, number, place)
            self.rows[axis.name] = _Row(axis, position, gauge, target, (minus, plus))
        for unit in dict.fromkeys(axis.unit for axis in axes):
            step = NumberEdit(
                _words(unit), _STEPS.get(unit, 1.0), minimum=1e-6, tip="A jog; Shift × 10, Ctrl × 0.1"
            )
            step.setFixedWidth(110)
            self.heed(step)
            self.steps[unit] = step
            self._step_row.addWidget(label("Step"))
            self._step_row.addWidget(step)
        self._step_row.addStretch(1)

    # Reading -------------------------------------------------------------------------------------
    def look(self) -> None:
        """Ask the stage where it is, whatever else is going on."""
        stage = self.session.bench.stage
        if stage is not None and self.is_ready and not self._reader.is_reading:
            # Whether it moves first: where a stage at rest is, is where it stays.
            self._reader.ask(
                lambda: (stage.is_moving, stage.position(), stage.is_homed, stage.needs_unlocking), self._show
            )

    def _show(self, reading: tuple[bool, dict[str, float], bool, bool]) -> None:
        is_moving, position, is_homed, is_locked = reading
        self.unlock_button.setVisible(is_locked)
        self._here, self._is_homed = position, is_homed
        for name, row in self.rows.items():
            here = position[name]
            row.position.setText(_place(here, row.target.shown_unit))
            travel = row.axis.upper_limit - row.axis.lower_limit
            row.gauge.setValue(round(_GAUGE * (here - row.axis.lower_limit) / travel) if travel else 0)
            # A field with the keyboard is filled once, after STOP: with where the stage comes to rest.
            if (row.target.value is None and not is_moving) or not row.target.hasFocus():
                row.target.set_value(round(here, 3))
        if is_moving:
            self.state.setText("Moving …  Esc stops")
        elif is_locked:
            self.state.setText("Locked by an alarm. Look what it was for, then unlock the stage and home it.")
        elif not is_homed:
            self.state.setText("Not homed: positions have no reference. Home it first.")
        else:
            self.state.setText("At rest, homed")

    # Moving --------------------------------------------------------------------------------------
    def jog(self, letter: str, steps: float, *, repeated: bool = False) -> None:
        """Move an axis by steps; a held key's repeats are let go while it still moves."""
        row = next((row for row in self.rows.values() if row.axis.name.startswith(f"{letter}_")), None)
        stage = self.session.bench.stage
        if row is None or stage is None:
            self.refused(self.pad, f"This stage has no axis {letter}.")
            return
        if repeated and self.session.jobs.is_busy("stage"):
            return
        field = self.steps[row.axis.unit]
        if not field.submit():  # not by the step of before
            field.setFocus()
            return
        delta = steps * (field.value or 0.0)
        words = f"Jog {letter} by {quantity(delta, row.axis.unit, 6)}"
        self._start(words, {row.axis.name: delta}, relative=True)

    def _place_to_keep(self) -> dict[str, float] | None:
        """Return where the stage is; None, and why, where that has no reference."""
        if not self._is_homed:
            self.refused(self.places.save_button, "Not homed: a place would mean nothing. Home it first.")
            return None
        self.accepted(self.places.save_button)
        return self._here

    def _go_to(self, name: str, place: dict[str, float]) -> None:
        self._start(f"Move to {name}", place, relative=False)

    def _places_changed(self) -> None:
        self.all_button.setEnabled(bool(self.session.kept.of("places")))

    def photograph_all(self) -> None:
        """Hand a plan on that takes a frame at every place that is kept."""
        kept = self.session.kept.of("places")
        labels = [name.replace("/", "-") for name in sorted(kept)]
        parts = [
            {
                "label": label if labels.count(label) == 1 else f"{label}-{number}",
                "positions": {"kind": "stage", "points": [kept[name]]},
                "scene_lit": True,
            }
            for number, (name, label) in enumerate(zip(sorted(kept), labels, strict=True), 1)
        ]
        plan = self.asked(lambda: Plan.checked({"label": "places", "parts": parts}, "the places"))
        if plan is not None:
            self.session.handed_on.emit("sweeps", plan)

    def _jog_clicked(self, letter: str, sign: int, _checked: bool = False) -> None:
        self.jog(letter, sign)

    def _move_to(self, name: str, value: float) -> None:
        row = self.rows[name]
        words = f"Move {name.rpartition('_')[0] or name} to {quantity(value, row.axis.unit, 6)}"
        job = self._start(words, {name: value}, relative=False)
        if job is not None:
            job.failed.connect(row.target.refuse)
            # Stopped on its way: the field shows where it is, unless the next target is being typed there
            # already, and the same target can be entered again.
            job.cancelled.connect(lambda _: row.target.set_value(None))

    def _start(self, title: str, where: dict[str, float], *, relative: bool) -> Job | None:
        stage = self.session.bench.stage
        assert stage is not None
        move = stage.move_by if relative else stage.move_to
        return self.command(title, lambda _: move(where))

    def ask_home(self) -> None:
        """Ask whether the stage may be homed, then do it."""
        text = "Every axis moves to its reference and then to its home position. Is its way free?"
        self._ask("Home the stage?", text, ("Home", "Stay"), self._home_answered)

    def ask_unlock(self) -> None:
        """Ask whether somebody has looked what the alarm was for, then end it."""
        text = "Its position is lost with the alarm. Was its cause looked at, and are the axes free?"
        self._ask("Unlock the stage?", text, ("Unlock", "Leave it locked"), self._unlock_answered)

    def _ask(
        self, title: str, text: str, answers: tuple[str, str], answered: Callable[[bool], object]
    ) -> None:
        if self.question is not None and self.question.text() != text:  # of the other button
            self.question.reject()
        if self.question is None:
            self.question = Question(self, title, text, answers, answered)
            self.session.stop_pressed.connect(self.question.reject)
        self.question.ask()

    def _unlock_answered(self, agreed: bool) -> None:
        self.question = None
        stage = self.session.bench.stage
        if agreed and stage is not None:
            self.command("Unlocking the stage", lambda _: stage.unlock(), self.unlock_button)

    def _home_answered(self, agreed: bool) -> None:
        self.question = None
        stage = self.session.bench.stage
        if agreed and stage is not None:
            if not self.session.is_open(self.kind):
                self.session.reconnect(self.kind)  # homing waits for it
            self.command("Homing the stage", lambda _: stage.home())


def _words(unit: str) -> str:
    return {"um": "µm"}.get(unit, unit)


def _place(here: float, unit: str) -> str:
    """Return where an axis is, to a tenth of a micrometre or milliradian, in the unit of its target."""
    return f"{here / 1e3:.4f} mm" if unit == "mm" else f"{grouped(f'{here:.1f}')} {unit}"
