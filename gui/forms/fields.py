"""One declared option as a field: the widget that fits its type, with its own words, unit and limits."""

from __future__ import annotations

import math
import typing
from collections.abc import Callable
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, Literal

from PySide6.QtCore import QSignalBlocker
from PySide6.QtGui import QFontDatabase
from PySide6.QtWidgets import QCheckBox, QComboBox, QPlainTextEdit, QWidget

from gui.widgets.dialogues import Browse
from gui.widgets.entry import Entry, PathEntry, narrow
from gui.widgets.number_edit import NumberEdit
from instrument.files.errors import BenchError
from recon.base.declare import Option

AUTOMATIC = "automatic"
"""Shown for None among words to choose from."""
_TEXT_HEIGHT_PX = 300


@dataclass(frozen=True, slots=True, kw_only=True)
class Behaviour:
    """What a field does besides what its declaration says.

    Attributes
    ----------
    understand : callable, optional
        Turns a text into the value; BenchError with the reason where it cannot. Needed where the value is
        neither a number, a path, a word to choose nor a text.
    browse : "open", "folder" or "save"
        What the dialogue of a path chooses.
    filters : str
        Of that dialogue, as QFileDialog has them.
    enabled_when : callable, optional
        Called with the form's present values by name; returns why the field does not apply, empty where it
        does. One that does not apply has its default.
    """

    understand: Callable[[str], Any] | None = None
    browse: Browse = "open"
    filters: str = ""
    enabled_when: Callable[[dict[str, Any]], str] | None = None


class OptionField:
    """A declared option on the screen; subclasses are for kinds of values.

    Attributes
    ----------
    option : Option
    behaviour : Behaviour
    widget : QWidget
        That is edited, marked when its content is refused.
    whole : QWidget
        That goes into the row: ``widget``, or what it is part of.
    """

    widget: QWidget
    whole: QWidget

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        self.option = option
        self.behaviour = behaviour

    @property
    def name(self) -> str:
        """Its label, with the unit where the widget does not show it by itself."""
        return self.option.label

    @property
    def tip(self) -> str:
        """What the declaration says of the option, with limits and default."""
        said = self.option.declaration
        lines = [said.help]
        if limits := allowed(self.option):
            lines.append(f"{limits[:1].upper()}{limits[1:]}.")
        if said.default_words:
            lines.append(f"Default: {said.default_words}.")
        return "\n".join(lines)

    @property
    def default(self) -> Any:
        """The option's default; None where it has none and is needed."""
        return None if self.option.default is MISSING else self.option.default

    def read(self) -> tuple[Any, str]:
        """Return the value, in the option's own unit, and why it cannot be used; empty where it can."""
        raise NotImplementedError

    def show(self, value: Any) -> None:
        """Show a value in the option's own unit; no change is told of."""
        raise NotImplementedError

    def listen(self, edited: Callable[[], object], refused: Callable[[str], object]) -> None:
        """Have changes and refusals told."""
        raise NotImplementedError


class NumberField(OptionField):
    """A number with its unit."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        said = option.declaration
        self.unit, self.scale = _pretty(said.shown_unit or said.unit), said.shown_factor
        self._is_whole = float not in option.kinds
        empty = ""
        if option.default is None:  # an empty field shows no unit by itself
            empty = f"{said.default_words or 'none'}{f' ({self.unit})' if self.unit else ''}"
        self.widget: NumberEdit = NumberEdit(self.unit, integer=self._is_whole, tip=self.tip, empty=empty)
        self.widget.check = self._problem
        self.whole = self.widget

    @property
    def name(self) -> str:
        """Its label; the unit stands behind the number."""
        said = self.option.declaration
        return self.option.label.removesuffix(f" ({said.shown_unit or said.unit})")

    def _problem(self, number: float) -> str:
        value = int(number) if self._is_whole else number * self.scale
        if self.option.mistake(value) is None:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name} must be {allowed(self.option)}, not {number:g}{unit}."

    def read(self) -> tuple[Any, str]:
        """Return the value, and why it cannot be used."""
        number, problem = self.widget.typed()
        if number is None or problem:
            return None, problem
        # 22 mm are 22000 um, not 22000.000000000004.
        return (int(number) if self._is_whole else float(f"{number * self.scale:.15g}")), ""

    def show(self, value: Any) -> None:
        """Show a value."""
        blocked = QSignalBlocker(self.widget)
        self.widget.set_value(None if value is None else value / self.scale, overwrite=True)
        blocked.unblock()

    def listen(self, edited: Callable[[], object], refused: Callable[[str], object]) -> None:
        """Have changes told."""
        self.widget.textEdited.connect(lambda _: edited())
        self.widget.submitted.connect(lambda _: edited())
        self.widget.refused.connect(refused)


class SwitchField(OptionField):
    """Yes or no."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        self.widget: QCheckBox = QCheckBox()
        self.whole = self.widget
        self.widget.setToolTip(self.tip)

    def read(self) -> tuple[Any, str]:
        """Return the value, and why it cannot be used."""
        return self.widget.isChecked(), ""

    def show(self, value: Any) -> None:
        """Show a value."""
        blocked = QSignalBlocker(self.widget)
        self.widget.setChecked(bool(value))
        blocked.unblock()

    def listen(self, edited: Callable[[], object], refused: Callable[[str], object]) -> None:
        """Have changes told."""
        self.widget.toggled.connect(lambda _: edited())


class ChoiceField(OptionField):
    """One of several words; None is one of them where it is the default."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        self.widget: QComboBox = QComboBox()
        self.whole = self.widget
        narrow(self.widget)
        self.widget.setToolTip(self.tip)
        if option.default is None:
            self.widget.addItem(AUTOMATIC, None)
        if bool in option.kinds:
            self.widget.addItem("yes", True)
            self.widget.addItem("no", False)
        for word in words_of(option):
            self.widget.addItem(str(word), word)

    def read(self) -> tuple[Any, str]:
        """Return the value, and why it cannot be used."""
        return self.widget.currentData(), ""

    def show(self, value: Any) -> None:
        """Show a value."""
        blocked = QSignalBlocker(self.widget)
        self.widget.setCurrentIndex(max(self.widget.findData(value), 0))
        blocked.unblock()

    def listen(self, edited: Callable[[], object], refused: Callable[[str], object]) -> None:
        """Have changes told."""
        self.widget.currentIndexChanged.connect(lambda _: edited())


class EntryField(OptionField):
    """A text that stands for something: a path, a place, a name."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        self.widget: Entry = Entry(self._understood, tip=self.tip, placeholder=self._empty())
        self.whole = self.widget
        if option.kinds == (Path,):
            browse = "folder" if option.declaration.metavar == "FOLDER" else behaviour.browse
            self.whole = path = PathEntry(self.widget, browse, behaviour.filters)
            path.button.setAccessibleName(f"Choose {option.label}")

    def _empty(self) -> str:
        return self.option.declaration.default_words or ("none" if self.option.default is None else "")

    def _understood(self, text: str) -> Any:
        if not text and self.option.default is None:
            return None
        if not text and self.option.default is MISSING:
            raise BenchError(f"{self.name} is needed here.")
        if self.behaviour.understand is not None:
            return self.behaviour.understand(text)
        value: Any = Path(text).expanduser() if Path in self.option.kinds else text
        if problem := self.option.mistake(value):
            raise BenchError(problem)
        return value

    def read(self) -> tuple[Any, str]:
        """Return the value, and why it cannot be used."""
        try:
            return self.widget.value(), ""
        except BenchError as error:
            return None, str(error)

    def show(self, value: Any) -> None:
        """Show a value."""
        blocked = QSignalBlocker(self.widget)
        self.widget.setText("" if value is None or value is MISSING else str(value))
        blocked.unblock()

    def listen(self, edited: Callable[[], object], refused: Callable[[str], object]) -> None:
        """Have changes told."""
        self.widget.textChanged.connect(lambda _: edited())
        self.widget.refused.connect(refused)


class LinesField(OptionField):
    """A text of several lines, as its default has."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        self.widget: QPlainTextEdit = QPlainTextEdit()
        self.whole = self.widget
        self.widget.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
        self.widget.setLineWrapMode(QPlainTextEdit.LineWrapMode.NoWrap)
        self.widget.setMinimumHeight(_TEXT_HEIGHT_PX)
        self.widget.setToolTip(self.tip)
        self.widget.setTabChangesFocus(True)

    def read(self) -> tuple[Any, str]:
        """Return the text."""
        return self.widget.toPlainText(), ""

    def show(self, value: Any) -> None:
        """Show a text."""
        blocked = QSignalBlocker(self.widget)
        self.widget.setPlainText(str(value or ""))
        blocked.unblock()

    def listen(self, edited: Callable[[], object], refused: Callable[[str], object]) -> None:
        """Have changes told."""
        self.widget.textChanged.connect(edited)


def field_for(option: Option, behaviour: Behaviour) -> OptionField:
    """Return the field that fits an option's type."""
    if words_of(option) or (bool in option.kinds and option.default is None):
        return ChoiceField(option, behaviour)
    if option.kinds == (bool,):
        return SwitchField(option, behaviour)
    if behaviour.understand is None and set(option.kinds) <= {int, float}:
        return NumberField(option, behaviour)
    if isinstance(option.default, str) and "\n" in option.default:
        return LinesField(option, behaviour)
    return EntryField(option, behaviour)


def words_of(option: Option) -> tuple[str, ...]:
    """Return the words that an option can be: as declared, or as its type lists them."""
    listed = [word for kind in option.kinds if typing.get_origin(kind) is Literal for word in kind.__args__]
    only_words = len(listed) > 0 and all(typing.get_origin(kind) is Literal for kind in option.kinds)
    return option.declaration.words() or (tuple(listed) if only_words else ())


def allowed(option: Option) -> str:
    """Return which numbers an option can be, in the unit that people read; empty where any."""
    said = option.declaration
    unit = _pretty(said.shown_unit or said.unit)
    limits = (
        ("", said.least, " or more"),
        ("above ", said.above, ""),
        ("", said.most, " or less"),
        ("below ", said.below, ""),
    )
    found = [
        f"{before}{value / said.shown_factor:g}{f' {unit}' if unit else ''}{after}"
        for before, value, after in limits
        if math.isfinite(value)
    ]
    return ", ".join(found)


def _pretty(unit: str) -> str:
    return "µm" if unit == "um" else unit
