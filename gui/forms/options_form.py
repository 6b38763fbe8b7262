"""The one form: declared options on the screen: labels, units, tips, and the reason where one is refused."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from PySide6.QtCore import Qt, QTimer, Signal
from PySide6.QtWidgets import QFormLayout, QLabel, QLineEdit, QScrollArea, QToolButton, QWidget

from gui.background import NewestOnly
from gui.forms.fields import (
    Behaviour,
    ChoiceField,
    LinesField,
    OptionField,
    SwitchField,
    bare_label,
    field_for,
)
from gui.jobs import JobRunner
from gui.widgets.building import fill, in_row, label, mark
from instrument.files.errors import BenchError
from instrument.files.results import free_result
from recon.base.declare import Option, in_other_words, options_of
from recon.errors import InputError

FOLDED = ("Rarely needed", "Advanced")
"""Groups that are folded away, wherever they are declared."""

_ABOVE_HEADING_PX = 6
_T = TypeVar("_T")


class OptionsForm(QWidget):
    """Shows declared options. ``values`` reads them; what cannot be read is marked where it stands.

    Everything that a field says comes from the declaration: label, unit, tool tip, limits, choices, what an
    empty field means, its group's heading. Options that the declaration keeps from people (no flag) are not
    shown. Folded, what is set holds all the same.

    Signals
    -------
    changed
        Something was typed, ticked or chosen.
    refused : object, str
        A field's widget and why its content is refused.
    settled : str
        The name of an option whose value was taken: chosen, or typed and the field left.

    Parameters
    ----------
    declared : iterable of Option or of types
        Options, or classes whose options are all shown; names must differ.
    behaviour : mapping
        By name, what a field does besides what its declaration says.
    folded : collection of str
        Groups that are folded away.
    whole : bool
        Whether it has its fields at once; else ``parts`` makes them, where the form has its place by then.
    """

    changed = Signal()
    refused = Signal(object, str)
    settled = Signal(str)

    def __init__(
        self,
        declared: Iterable[Option | type],
        behaviour: Mapping[str, Behaviour] | None = None,
        *,
        folded: Collection[str] = FOLDED,
        whole: bool = True,
        parent: QWidget | None = None,
    ) -> None:
        super().__init__(parent)
        options = [o for d in declared for o in ((d,) if isinstance(d, Option) else options_of(d))]
        self._offered = [o for o in options if o.declaration.flags != ("",)]
        self._given = behaviour or {}
        self.fields: dict[str, OptionField] = {}
        self.widgets: dict[str, QWidget] = {}
        self._folded = frozenset(folded)
        self._reasons: dict[str, QLabel] = {}
        self._headings: dict[str, QLabel] = {}
        self._rows: dict[str, QFormLayout] = {}
        self._hidden: set[str] = set()
        self._disabled: dict[str, str] = {}
        if whole:
            for _ in self.parts():
                pass

    def parts(self) -> Iterator[None]:
        """Make the fields, then their rows, with a ``yield`` after each."""
        for option in self._offered:
            behaviour = replace(self._given.get(option.name, Behaviour()), worded=self.in_its_words)
            field = field_for(option, behaviour)
            field.show(field.default)
            self.fields[option.name], self.widgets[option.name] = field, field.widget
            yield
        folded = [field for field in self.fields.values() if self._is_folded(field)]
        self._usual, self._seldom = QWidget(), QWidget()
        self.more = QToolButton()
        self.more.setText(FOLDED[0])
        self.more.setCheckable(True)
        self.more.setAutoRaise(True)
        self.more.setArrowType(Qt.ArrowType.RightArrow)
        self.more.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextBesideIcon)
        self.more.setToolTip(", ".join(field.bare_label for field in folded) or FOLDED[0])
        self.more.toggled.connect(self._fold)
        self._seldom.hide()
        fill(self, self._usual, in_row(self.more, None), self._seldom, None, margins=(0, 6, 0, 2))
        self.more.setVisible(bool(folded))  # once it has its place
        yield from self._fill(self._usual, [field for field in self.fields.values() if field not in folded])
        yield from self._fill(self._seldom, folded)
        for name, field in self.fields.items():
            field.edited.connect(self._edited)
            field.refused.connect(partial(self._refused_itself, name))
            field.settled.connect(partial(self.settled.emit, name))
        self._begun = self._state = self._raw()
        self._update_enabled()

    @property
    def is_untouched(self) -> bool:
        """Whether it stands as it began: what is missing in it is no mistake yet."""
        return self._state == self._begun

    def wholes(self) -> list[QWidget]:
        """Return what takes a theme for itself, once it is made: what is seen first, and what is folded."""
        return [self._usual, self._seldom]

    # Values --------------------------------------------------------------------------------------
    def values(self) -> dict[str, Any] | None:
        """Return the options in their own units; None when one cannot be read.

        Of those that are not shown or do not apply, the default.
        """
        self.clear_reasons()
        values: dict[str, Any] = {}
        readable = True
        for name, field in self.fields.items():
            values[name], problem = field.read() if self.applies(name) else (field.default, "")
            if problem:
                self.refuse(name, problem)
                readable = False
        return values if readable else None

    def value(self, name: str) -> Any:
        """Return one option's value.

        Raises BenchError when it cannot be read.
        """
        if not self.applies(name):
            return self.fields[name].default
        value, problem = self.fields[name].read()
        if problem:
            raise BenchError(problem)
        return value

    def make(self, declared: type[_T]) -> _T:
        """Return the options of one class, as they stand here.

        Raises BenchError when one cannot be read, or they do not go together.
        """
        names = [o.name for o in options_of(declared) if o.name in self.fields]
        try:
            return declared(**{name: self.value(name) for name in names})
        except InputError as error:
            raise BenchError(str(error)) from error

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Show values; names that the form does not have are left out."""
        known = {name: value for name, value in values.items() if name in self.fields}
        for name, value in known.items():
            self.fields[name].show(value)
        self._edited()
        for name in known:
            self.settled.emit(name)

    def show_present(self, values: Mapping[str, Any]) -> None:
        """Show what a device reads back, but for fields that are being edited; nothing is settled by that."""
        for name, value in values.items():
            field = self.fields[name]
            if not field.is_being_edited:
                field.show(value)
                self._clear_reason(name)
        self._edited()

    def begin_with(self, values: Mapping[str, Any]) -> None:
        """Show values in the fields that are empty."""
        empty = {
            name
            for name, widget in self.widgets.items()
            if isinstance(widget, QLineEdit) and not widget.text() and not widget.placeholderText()
        }
        untouched = self.is_untouched
        self.set_values({name: value for name, value in values.items() if name in empty})
        if untouched:
            self._begun = self._state

    def in_its_words(self, text: str) -> str:
        """Return a message with labels where the terminal's has flags, another form's as words."""
        return in_other_words(
            text,
            self._offered,
            lambda option: f"“{bare_label(option)}”",
            lambda flag: f"“{flag[2:].replace('-', ' ')}”",
        )

    # What applies --------------------------------------------------------------------------------
    def applies(self, name: str) -> bool:
        """Whether a field is shown for what is asked for, and goes with the others."""
        return name not in self._hidden and name not in self._disabled

    def show_for(self, *subjects: str, but_not: Collection[str] = ()) -> None:
        """Show what is declared to apply to one of these subjects, or to everything, but not some fields."""
        self.hide_fields(
            name
            for name, field in self.fields.items()
            if name in but_not
            or ((about := field.option.declaration.applies) and not set(about) & set(subjects))
        )

    def hide_fields(self, names: Iterable[str]) -> None:
        """Hide these fields and no others; they have their defaults."""
        self._hidden = set(names)
        for name, field in self.fields.items():
            self._rows[name].setRowVisible(field.whole, name not in self._hidden)
            if name in self._hidden:
                self._reasons[name].hide()
        for group, heading in self._headings.items():
            heading.setVisible(any(self._group(f) == group for f in self._shown_fields()))
        self.more.setVisible(any(map(self._is_folded, self._shown_fields())))
        self._edited()

    # Reasons -------------------------------------------------------------------------------------
    def check(self) -> bool:
        """Return whether all can be read; the first that cannot is brought into sight, with the reason."""
        if self.values() is not None:
            return True
        name = next(name for name, reason in self._reasons.items() if reason.text())
        self.show_field(name)
        self.widgets[name].setFocus()
        self.refused.emit(self.widgets[name], self._reasons[name].text())
        return False

    def recheck(self, *names: str) -> bool:
        """Look again at some fields, whose limits another one sets, and return whether all of them can be."""
        good = True
        for name in names:
            problem = self.fields[name].read()[1] if self.applies(name) else ""
            if problem:
                good = False
                self._refused_itself(name, problem)
            else:
                self._clear_reason(name)
        return good

    def refuse(self, name: str, why: str) -> bool:
        """Mark a field as wrong, with the reason below it; returns whether there is such a field."""
        widget = self.widgets.get(name)
        if widget is None:
            return False
        reason = self._reasons[name]
        why = self.in_its_words(why)
        text = why if why.endswith((".", "?")) else f"{why}."
        if text.partition(" ")[0].isalpha():  # no file's name
            text = text[:1].upper() + text[1:]
        reason.setText(text)
        reason.show()
        widget.setToolTip(text)
        mark(widget, "refused", True)
        return True

    def show_field(self, name: str) -> None:
        """Bring a field into sight, also from among those that are folded away."""
        if self._is_folded(self.fields[name]):
            self.more.setChecked(True)
        scroll = self.parent()
        while scroll is not None and not isinstance(scroll, QScrollArea):
            scroll = scroll.parent()
        if scroll is not None:
            # After the layout has made room for the reason.
            reason = self._reasons[name]
            QTimer.singleShot(0, reason, lambda: scroll.ensureWidgetVisible(reason))

    def clear_reasons(self) -> None:
        """Take all reasons away."""
        for name in self._reasons:
            self._clear_reason(name)

    def reason(self, name: str) -> str:
        """Return why a field was refused; empty when it was not."""
        return self._reasons[name].text()

    # Inside --------------------------------------------------------------------------------------
    def _fill(self, box: QWidget, fields: list[OptionField]) -> Iterator[None]:
        rows = QFormLayout(box)
        rows.setContentsMargins(0, 0, 0, 0)
        rows.setVerticalSpacing(4)
        rows.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        rows.setRowWrapPolicy(QFormLayout.RowWrapPolicy.DontWrapRows)
        groups = list(dict.fromkeys(map(self._group, fields)))
        for group in groups:
            if group and (len(groups) > 1) and group not in FOLDED:
                self._headings[group] = heading = label(group, "heading")
                heading.setContentsMargins(0, _ABOVE_HEADING_PX if rows.rowCount() else 0, 0, 0)
                rows.addRow(heading)
            for field in (f for f in fields if self._group(f) == group):
                self._add(rows, field)
                yield

    def _add(self, rows: QFormLayout, field: OptionField) -> None:
        name = field.option.name
        self._rows[name] = rows
        self._reasons[name] = reason = label(wraps=True)
        reason.setObjectName("reason")
        reason.hide()
        words = label(field.label)
        words.setToolTip(field.tip)
        words.setBuddy(field.widget)
        field.widget.setAccessibleName(field.bare_label)
        if isinstance(field, LinesField):
            rows.addRow(field.whole)
        else:
            rows.addRow(words, field.whole)
        rows.addRow(reason)

    def _fold(self, opened: bool) -> None:
        self.more.setArrowType(Qt.ArrowType.DownArrow if opened else Qt.ArrowType.RightArrow)
        self._seldom.setVisible(opened)

    def _group(self, field: OptionField) -> str:
        return field.option.declaration.group

    def _is_folded(self, field: OptionField) -> bool:
        return self._group(field) in self._folded

    def _shown_fields(self) -> list[OptionField]:
        return [field for name, field in self.fields.items() if name not in self._hidden]

    def _raw(self) -> dict[str, object]:
        return {name: field.raw() for name, field in self.fields.items()}

    def _edited(self) -> None:
        """Tell of a change; a field that is merely left, and shows its number anew, has not changed."""
        state = self._raw()
        if state == self._state:
            return
        for name in state:
            if state[name] != self._state[name]:
                self._clear_reason(name)
        self._state = state
        self._update_enabled()
        self.changed.emit()

    def _update_enabled(self) -> None:
        """Disable what does not go with the others, with the reason as its tool tip."""
        ruled = {name: rule for name, f in self.fields.items() if (rule := f.behaviour.enabled_when)}
        chosen = (ChoiceField, SwitchField)  # texts have no say: to read one may look for a file
        usable = {n: f for n, f in self.fields.items() if n not in self._hidden and isinstance(f, chosen)}
        present = {name: field.read()[0] for name, field in usable.items()}
        for name, rule in ruled.items():
            field, why = self.fields[name], rule(present)
            if why == self._disabled.get(name, ""):
                continue
            if why:
                self._disabled[name] = why
                self._clear_reason(name)
            else:
                del self._disabled[name]
            field.whole.setEnabled(not why)
            field.widget.setToolTip(why or field.tip)

    def _refused_itself(self, name: str, why: str) -> None:
        if self.applies(name):
            self.refuse(name, why)
            self.refused.emit(self.widgets[name], self._reasons[name].text())

    def _clear_reason(self, name: str) -> None:
        reason = self._reasons[name]
        if reason.text():
            reason.clear()
            reason.hide()
            self.widgets[name].setToolTip(self.fields[name].tip)
            mark(self.widgets[name], "refused", False)


class SuggestedName:
    """Suggests where a form's result goes, in its option ``out``, under a name that no file has.

    A name that was chosen stays. Which names are taken is looked up in a job.

    Parameters
    ----------
    jobs : JobRunner
    form : OptionsForm
    folder : Path
        Made when something is written there.
    suffix : str
    """

    def __init__(self, jobs: JobRunner, form: OptionsForm, folder: Path, suffix: str) -> None:
        self._form, self._folder, self._suffix = form, folder, suffix
        self._reader = NewestOnly(jobs, "Looking for a free name")
        self._suggested: Path | None = None

    def suggest(self, stem: str) -> None:
        """Name the result after what it is made of."""
        self._take(self._folder / f"{stem}{self._suffix}")
        self._reader.ask(lambda: free_result(self._folder, stem, self._suffix), self._take)

    def once_known(self, call: Callable[[], object]) -> bool:
        """Have something called when the name is known; returns whether it still is looked for."""
        if not self._reader.is_reading:
            return False
        self._reader.ask(lambda: None, lambda _: QTimer.singleShot(0, self._form, call), "then")
        return True

    def make_room(self, out: Path) -> None:
        """Make the folder of suggested names where a result goes there; for a job's thread."""
        if out.parent == self._folder:
            self._folder.mkdir(parents=True, exist_ok=True)

    def _take(self, path: Path) -> None:
        if str(self._form.fields["out"].raw()).strip() in ("", str(self._suggested)):
            self._suggested = path
            self._form.set_values({"out": path})
