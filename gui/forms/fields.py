"""One declared option as a field: the widget that fits its type, with its own words, unit and limits."""

from __future__ import annotations

import re
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PySide6.QtCore import QObject, QSignalBlocker, Qt, Signal
from PySide6.QtGui import QFontDatabase
from PySide6.QtWidgets import QCheckBox, QComboBox, QPlainTextEdit, QWidget

from gui.widgets.building import fill, narrow
from gui.widgets.dialogues import Browse
from gui.widgets.entry import Entry, NumberEdit, PathEntry, existing_path
from instrument.files.errors import BenchError
from recon.base.declare import Option
from recon.base.option_text import default_shown, metavar, read, shown
from recon.errors import InputError

AUTOMATIC = "automatic"
"""Shown for None among words to choose from, where the declaration has no word for it."""
_TEXT_HEIGHT_PX = 300


@dataclass(frozen=True, slots=True, kw_only=True)
class Behaviour:
    """What a field does besides what its declaration says.

    Attributes
    ----------
    browse : "open", "folder" or "save"
        What the dialogue of a path chooses.
    filters : str
        Of that dialogue, as QFileDialog has them.
    must_exist : bool
        Whether a path must name something that is there.
    needed : bool
        Whether it must be given here, although the declaration lets it be left out.
    needed_when : callable, optional
        Called when it was left out; returns why it is needed, empty where it is not.
    require : callable, optional
        Called with a value that the declaration allows; returns why it cannot be all the same, empty where
        it can.
    help_of : callable, optional
        Returns what is said of one of the words to choose from; empty for nothing.
    shown : callable
        Returns how one of the words to choose from reads.
    offers : callable, optional
        Returns the words on offer now, where a device and not the declaration knows them.
    enabled_when : callable, optional
        Called with what is chosen and ticked in the form, by name; returns why the field does not apply,
        empty where it does. One that does not apply has its default.
    beside : callable, optional
        Makes what stands beside a number: a button that finds it.
    worded : callable
        Puts the form's labels where a declaration's words have the terminal's flags.
    """

    browse: Browse = "open"
    filters: str = ""
    must_exist: bool = False
    needed: bool = False
    needed_when: Callable[[], str] | None = None
    require: Callable[[Any], str] | None = None
    help_of: Callable[[str], str] | None = None
    shown: Callable[[str], str] = str
    offers: Callable[[], Sequence[str]] | None = None
    enabled_when: Callable[[dict[str, Any]], str] | None = None
    beside: Callable[[], QWidget] | None = None
    worded: Callable[[str], str] = str


def _here(words: str) -> str:
    """Return what a default is in the window, of words that tell it for the terminal, too."""
    return words.rpartition("; in the window ")[2]


def bare_label(option: Option) -> str:
    """Return an option's label without its unit."""
    said = option.declaration
    return option.label.removesuffix(f" ({said.shown_unit or said.unit})")


class OptionField(QObject):
    """A declared option on the screen; subclasses are for kinds of values.

    Attributes
    ----------
    option : Option
    behaviour : Behaviour
    widget : QWidget
        That is edited, marked when its content is refused.
    whole : QWidget
        That goes into the row: ``widget``, or what it is part of.

    Signals
    -------
    edited
    refused : str
        Why the content cannot be used.
    settled
        The value was taken: chosen, or typed and the field left.
    """

    widget: QWidget
    whole: QWidget
    edited = Signal()
    refused = Signal(str)
    settled = Signal()

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__()
        self.option = option
        self.behaviour = behaviour
        said = option.declaration
        # What is said of it calls it by its label, as the terminal calls it by its flag.
        self._spoken = replace(option, name=self.bare_label, declaration=replace(said, flags=("",)))

    @property
    def unit(self) -> str:
        """The unit that people read."""
        said = self.option.declaration
        unit = said.shown_unit or said.unit
        return "µm" if unit == "um" else unit

    @property
    def bare_label(self) -> str:
        """Its label without the unit."""
        return bare_label(self.option)

    @property
    def label(self) -> str:
        """Its label, with the unit where the widget does not show it by itself."""
        return f"{self.bare_label} ({self.unit})" if self.unit else self.bare_label

    @property
    def tip(self) -> str:
        """What the declaration says of the option, with limits and default."""
        lines = [self.option.declaration.help]
        if limits := self.option.limits(typed=True):
            unit = f" {self.unit}" if self.unit else ""
            lines.append(f"{', '.join(limits)}{unit}".capitalize() + ".")
        if default := self.option.declaration.default_words:
            lines.append(f"Default: {_here(default)}.")
        return self.behaviour.worded("\n".join(lines))

    @property
    def default(self) -> Any:
        """The option's default; None where it has none and is needed."""
        return None if self.option.is_required else self.option.default

    def problem(self, value: Any) -> str:
        """Say why a value cannot be; empty where it can."""
        mistake = self._spoken.mistake(value, typed=True) or ""
        return mistake or ("" if self.behaviour.require is None else self.behaviour.require(value))

    def read(self) -> tuple[Any, str]:
        """Return the value, in the option's own unit, and why it cannot be used; empty where it can."""
        raise NotImplementedError

    def show(self, value: Any) -> None:
        """Show a value in the option's own unit; no change is signalled."""
        with QSignalBlocker(self.widget):
            self._set(value)

    def _set(self, value: Any) -> None:
        raise NotImplementedError

    @property
    def is_being_edited(self) -> bool:
        """Whether somebody is at it: what a device reads back must not take it away."""
        return False

    def raw(self) -> object:
        """Return what stands in the widget; equal as long as nothing was changed."""
        return self.read()


class NumberField(OptionField):
    """A number with its unit."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        empty = ""
        if option.default is None:  # an empty field shows no unit by itself
            said = option.declaration
            empty = behaviour.worded(_here(said.default_words) or said.none_word or "none")
            empty += f" ({self.unit})" if self.unit else ""
        self.widget: NumberEdit = NumberEdit(self.unit, integer=option.is_whole, tip=self.tip, empty=empty)
        self.widget.check = lambda number: self.problem(self._in_own_unit(number))
        beside = behaviour.beside
        self.whole = (
            self.widget if beside is None else fill(QWidget(), (self.widget, 1), beside(), across=True)
        )
        self.widget.textChanged.connect(self.edited)
        self.widget.refused.connect(self.refused)
        self.widget.submitted.connect(self.settled)

    @property
    def label(self) -> str:
        """Its label; the unit stands behind the number."""
        return self.bare_label

    def _in_own_unit(self, number: float) -> float | int:
        # 22 mm are 22000 um, not 22000.000000000004.
        factor = self.option.declaration.shown_factor
        return int(number) if self.option.is_whole else float(f"{number * factor:.15g}")

    def read(self) -> tuple[Any, str]:
        """Return the value, and why it cannot be used."""
        number, problem = self.widget.typed()
        if number is None and not problem and self.behaviour.needed_when is not None:
            problem = self.behaviour.needed_when()
        return (None, problem) if number is None or problem else (self._in_own_unit(number), "")

    @property
    def is_being_edited(self) -> bool:
        """Whether a number was typed and is not in force."""
        return self.widget.isModified()

    def set_limits(self, least: float, most: float) -> None:
        """Keep to limits that a device gives, in the shown unit."""
        self.widget.set_limits(least, most)

    def raw(self) -> object:
        """Return the text without its unit."""
        return self.widget.text().strip().removesuffix(self.unit).strip()

    def _set(self, value: Any) -> None:
        scaled = None if value is None else value / self.option.declaration.shown_factor
        self.widget.set_value(scaled, overwrite=True)


class SwitchField(OptionField):
    """Yes or no."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        self.widget: QCheckBox = QCheckBox()
        self.whole = self.widget
        self.widget.setToolTip(self.tip)
        self.widget.toggled.connect(self.edited)
        self.widget.toggled.connect(self.settled)

    def read(self) -> tuple[Any, str]:
        """Return the value, and why it cannot be used."""
        return self.widget.isChecked(), ""

    def _set(self, value: Any) -> None:
        self.widget.setChecked(bool(value))


class ChoiceField(OptionField):
    """One of several words; None is one of them where it can be."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        self.widget: QComboBox = QComboBox()
        self.whole = self.widget
        narrow(self.widget)
        self.widget.setToolTip(self.tip)
        if type(None) in typing.get_args(option.type):
            word = AUTOMATIC if option.default is None else "none"
            self.widget.addItem(option.declaration.none_word or word, None)
        if bool in option.kinds:
            self.widget.addItem("yes", True)
            self.widget.addItem("no", False)
        self._words_from = self.widget.count()
        self._add(option.words if behaviour.offers is None else behaviour.offers())
        self.widget.currentIndexChanged.connect(self.edited)
        self.widget.currentIndexChanged.connect(self.settled)

    @property
    def is_being_edited(self) -> bool:
        """Whether its words are listed."""
        return self.widget.view().isVisible()

    def offer(self, words: Sequence[str]) -> None:
        """Offer these of its words; the default, else the first, where another was chosen."""
        shown = [self.behaviour.shown(word) for word in words]
        if [self.widget.itemText(i) for i in range(self._words_from, self.widget.count())] == shown:
            return
        with QSignalBlocker(self.widget):
            chosen = self.widget.currentText()
            while self.widget.count() > self._words_from:
                self.widget.removeItem(self._words_from)
            self._add(words)
            default = (self.behaviour.shown(word) for word in words if word == self.option.default)
            left = chosen if chosen in shown else next(default, "")
            self.widget.setCurrentIndex(max(self.widget.findText(left), 0))

    def _add(self, words: Sequence[str]) -> None:
        for word in words:
            self.widget.addItem(self.behaviour.shown(word), read(self._spoken, word))
            said = "" if self.behaviour.help_of is None else self.behaviour.help_of(word)
            self.widget.setItemData(self.widget.count() - 1, said or None, Qt.ItemDataRole.ToolTipRole)

    def read(self) -> tuple[Any, str]:
        """Return the value, and why it cannot be used."""
        value = self.widget.currentData()
        return value, "" if value is None else self.problem(value)

    def _set(self, value: Any) -> None:
        at = [self.widget.itemData(i) for i in range(self.widget.count())]
        self.widget.setCurrentIndex(at.index(value) if value in at else 0)


class EntryField(OptionField):
    """A text that stands for something: a path, a place, a name."""

    def __init__(self, option: Option, behaviour: Behaviour) -> None:
        super().__init__(option, behaviour)
        optional = option.default is None and not behaviour.needed
        empty = default_shown(option) or ("none" if optional else "")
        self.widget: Entry = Entry(self._understood, self.tip, behaviour.worded(_here(empty)))
        self.whole = self.widget
        if Path in (option.item, *option.kinds[:1]) and len(option.kinds) == 1:
            browse = "folder" if option.declaration.metavar == "FOLDER" else behaviour.browse
            self.whole = path = PathEntry(self.widget, browse, behaviour.filters)
            path.button.setAccessibleName(f"Choose {self.bare_label}")
        self.widget.textChanged.connect(self.edited)
        self.widget.refused.connect(self.refused)
        self.widget.understood.connect(self.settled)

    def _understood(self, text: str) -> Any:
        if not text:
            if self.option.is_required or self.behaviour.needed:
                raise BenchError(f"{self.bare_label} is needed here.")
            return self.option.default
        try:
            value = read(self._spoken, self._parts(text))
        except InputError as error:
            raise BenchError(str(error)) from error
        except ValueError:  # not as many parts as are needed
            raise BenchError(f"{self.bare_label} must be {metavar(self.option)}, not {text!r}.") from None
        if self.option.kinds == (Path,):
            value = existing_path(text) if self.behaviour.must_exist else value.expanduser()
        if problem := self.problem(value):
            raise BenchError(problem)
        return value

    def _parts(self, text: str) -> str | list[str]:
        """Return one text, or the parts of what is repeated or has several words."""
        said = self.option.declaration
        if said.parse_all is not None:
            return re.split(r"[,;]?\s+", text)
        if self.option.item is Path:
            return [part.strip() for part in text.split(";") if part.strip()]
        if said.parse is None:
            has_parts = self.option.item is not None or isinstance(self.option.default, tuple)
            return text.replace(",", " ").split() if has_parts else text
        return [part.strip() for part in text.split(";") if part.strip()] if self.option.item else text

    def read(self) -> tuple[Any, str]:
        """Return the value, and why it cannot be used."""
        try:
            return self.widget.value(), ""
        except BenchError as error:
            return None, str(error)

    @property
    def is_being_edited(self) -> bool:
        """Whether it was typed in, and is refused or has the keyboard."""
        return self.widget.isModified() and (self.widget.hasFocus() or bool(self.widget.property("refused")))

    def raw(self) -> object:
        """Return the text: whether it names a file is not looked up at every key."""
        return self.widget.text()

    def _set(self, value: Any) -> None:
        said = self.option.declaration
        if said.parse is not None and said.default_words and value == self.option.default:
            self.widget.setText("")  # the place holder has it in words
        elif self.option.item is Path:
            self.widget.setText("; ".join(map(str, value or ())))
        else:
            self.widget.setText("" if value is None else shown(self.option, value))


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
        self.widget.textChanged.connect(self.edited)

    def read(self) -> tuple[Any, str]:
        """Return the text."""
        return self.widget.toPlainText(), ""

    def _set(self, value: Any) -> None:
        self.widget.setPlainText(str(value or ""))


def field_for(option: Option, behaviour: Behaviour) -> OptionField:
    """Return the field that fits an option's type."""
    if behaviour.offers is not None:
        return ChoiceField(option, behaviour)
    numbers = {int, float} & set(option.kinds)
    if option.kinds == (bool,) and option.default is not None:
        return SwitchField(option, behaviour)
    if (option.words and not numbers and Path not in option.kinds) or bool in option.kinds:
        return ChoiceField(option, behaviour)
    if numbers == set(option.kinds) and option.declaration.parse is None:
        return NumberField(option, behaviour)
    if isinstance(option.default, str) and "\n" in option.default:
        return LinesField(option, behaviour)
    return EntryField(option, behaviour)
