"""Fields for words and numbers that mean something: taken when they are left, refused where they stand."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QFocusEvent, QKeyEvent
from PySide6.QtWidgets import QLineEdit, QWidget

from gui.widgets.building import button, fill, mark
from gui.widgets.dialogues import Browse, choose_path
from gui.words import THIN, grouped
from instrument.files.errors import BenchError


class Refusing(QLineEdit):
    """A field that is marked, with the reason as its tool tip, where its content is refused.

    Signals
    -------
    refused : str
        Why it is.
    mended
        It is not any more.
    """

    refused = Signal(str)
    mended = Signal()

    def _tip_now(self) -> str:
        """Return the tool tip of a field that is not refused."""
        raise NotImplementedError

    def refuse(self, why: str) -> None:
        """Show why the content cannot be used."""
        self._mark(why)
        self.refused.emit(why)

    def accept(self) -> None:
        """Take back what was shown: the content is used after all."""
        if self.property("refused"):
            self._mark("")

    def _mark(self, why: str) -> None:
        was_refused = bool(self.property("refused"))
        mark(self, "refused", bool(why))
        self.setToolTip(why or self._tip_now())
        if was_refused and not why:
            self.mended.emit()


class Entry(Refusing):
    """A text and the value that it stands for.

    Parameters
    ----------
    understand : callable
        Turns the text into a value; BenchError with the reason where it cannot.
    tip : str
        The tool tip: what may be written, with units.

    Signals
    -------
    understood
        What was written is understood.
    """

    understood = Signal()

    def __init__(self, understand: Callable[[str], Any], tip: str, placeholder: str) -> None:
        super().__init__()
        self._understand = understand
        self._tip = tip
        self.setToolTip(tip)
        self.setPlaceholderText(placeholder)
        self.setMinimumWidth(40)
        self.returnPressed.connect(self.check)
        self._written = False
        """Whether anything was written by hand: an empty field that nobody touched is not yet wrong."""
        self.textEdited.connect(self._edited)

    def _tip_now(self) -> str:
        return self._tip

    def _edited(self, _text: str) -> None:
        self._written = True
        self._mark("")

    def value(self) -> Any:
        """Return what the text stands for.

        Raises
        ------
        BenchError
        """
        return self._understand(self.text().strip())

    def check(self) -> bool:
        """Return whether the text is understood, and show the reason where it is not."""
        try:
            self.value()
        except BenchError as error:
            self.refuse(str(error))
            return False
        self._mark("")
        self.understood.emit()
        return True

    def focusOutEvent(self, event: QFocusEvent) -> None:  # noqa: N802 - Qt's name
        """Check when the field is left, if there is or was something in it."""
        super().focusOutEvent(event)
        if self._written or self.text():
            self.check()


class PathEntry(QWidget):
    """An :class:`Entry` for a path, with a button that opens a dialogue to choose it."""

    def __init__(self, entry: Entry, browse: Browse, filters: str = "") -> None:
        super().__init__()
        self.entry = entry
        self._browse: Browse = browse
        self._filters = filters
        self.button = button("…", "Choose", self._choose)
        self.button.setAccessibleName("Choose")
        fill(self, (entry, 1), self.button, across=True, spacing=3)

    def _choose(self) -> None:
        words = {"open": "Choose a file", "folder": "Choose a folder", "save": "Choose a name"}[self._browse]
        choose_path(self, self._browse, words, self.entry.text(), self._chosen, self._filters)

    def _chosen(self, path: Path) -> None:
        self.entry.setText(str(path))
        self.entry.check()
        self.entry.editingFinished.emit()  # as if it had been typed


def existing_path(text: str) -> Path:
    """Return the path that a text names; BenchError where nothing is there."""
    if not text:
        raise BenchError("A file or folder is needed here.")
    path = Path(text).expanduser()
    if not path.exists():
        raise BenchError(f"{path}: there is no such file or folder.")
    return path


_LENGTHS_UM = {"nm": 1e-3, "um": 1.0, "µm": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6}
_TIMES_MS = {"us": 1e-3, "µs": 1e-3, "ms": 1.0, "s": 1e3, "min": 6e4}
_MM_UM = 1e3
_LONG_UM = 1e4
"""A field whose numbers may reach this far shows millimetres."""
_LETTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZµ×%/° "


_LONGEST_ABBREVIATION = 3


def _one(unit: str) -> str:
    """Return a unit in the singular: 1 frame, 2 frames; an abbreviation has one form."""
    return unit.removesuffix("s") if len(unit) > _LONGEST_ABBREVIATION else unit


def _factor(typed: str, unit: str) -> float | None:
    """Return what a number in a typed unit is multiplied with to be in another; None where that is none."""
    for scale in (_LENGTHS_UM, _TIMES_MS):
        if typed in scale and unit in scale:
            return scale[typed] / scale[unit]
    return None


class NumberEdit(Refusing):
    """A field for one number: ``12.5 ms``. Enter or leaving it submits; Up and Down step by a tenth.

    Lengths and times may be typed in another unit than the field's: ``2 s`` where it has milliseconds. One
    for micrometres shows millimetres where its limits are far apart or, without limits, where what it shows
    first is 1 mm or more; a number typed without a unit is in the one that the field shows, which stays.

    A value that is none, or outside the limits, is refused where it stands, with the reason as tool tip; what
    was typed stays to be corrected. Nothing is ever clipped.

    Signals
    -------
    submitted : float
        A new number within the limits.

    Parameters
    ----------
    unit : str
        Shown behind the number; may be empty.
    value : float, optional
    minimum, maximum : float
        Limits, inclusive.
    integer : bool
        Whether only whole numbers are numbers.
    tip : str
        The tool tip; the limits are added.
    empty : str
        What an empty field means, shown in it; where this is empty, a number is needed.
    """

    submitted = Signal(float)

    def __init__(
        self,
        unit: str = "",
        value: float | None = None,
        *,
        minimum: float = -math.inf,
        maximum: float = math.inf,
        integer: bool = False,
        tip: str = "",
        empty: str = "",
    ) -> None:
        super().__init__()
        self.unit = unit
        self._shown = ""
        """The unit in the field; empty until there is something to choose it by."""
        self.minimum, self.maximum = minimum, maximum
        self.check: Callable[[float], str] | None = None
        """Further says of a number why it cannot be; empty where it can."""
        self._integer = integer
        self._tip = tip
        self._value = value
        self.setAccessibleName(tip.partition("\n")[0] or "Number")  # a form's label takes its place
        self.setPlaceholderText(empty)
        self.setAlignment(Qt.AlignmentFlag.AlignRight)
        self.returnPressed.connect(self.submit)
        self._show()

    @property
    def value(self) -> float | None:
        """The last number that was accepted or set."""
        return self._value

    @property
    def shown_unit(self) -> str:
        """The unit that stands in the field, and that a number typed without one is in."""
        return self._shown or self.unit

    def _choose_unit(self) -> None:
        if self.unit != "µm" or self._shown:
            return
        farthest = max(abs(self.minimum), abs(self.maximum))
        if math.isfinite(farthest):
            self._shown = "mm" if farthest >= _LONG_UM else "µm"
        elif self._value is not None:
            self._shown = "mm" if abs(self._value) >= _MM_UM else "µm"

    def typed(self) -> tuple[float | None, str]:
        """Return the number as it stands in the field, submitted or not, and why it is refused if it is.

        None for a number, and no reason, where the field may be empty and is.
        """
        text = self.text().strip()
        if not text:
            return None, "" if self.placeholderText() else "A number is needed."
        digits = text.replace(THIN, "").rstrip(_LETTERS).strip()
        typed = text.replace(THIN, "")[len(digits) :].strip() if digits else ""
        typed = typed or self.shown_unit
        factor: float | None = 1.0 if typed in (self.unit, _one(self.unit)) else _factor(typed, self.unit)
        try:
            number = float(digits.replace(",", "."))
        except ValueError:
            factor = None
        if factor is None:
            return (
                None,
                f"{text!r} is no number{f' of {self.shown_unit}' if self.unit not in ('', '×') else ''}.",
            )
        # 2 cm are 20 mm, not 20.000000000000004.
        number = float(f"{number * factor:.15g}")
        if not math.isfinite(number):
            return None, f"{text} is no finite number."
        if self._integer and number != int(number):
            return None, f"{number:g} is no whole number."
        if not self.minimum <= number <= self.maximum:
            in_force = "" if self._value is None else f" In force: {self._text(self._value)}."
            return None, f"{self._text(number)} is outside what is allowed: {self._range()}.{in_force}"
        problem = "" if self.check is None else self.check(number)
        return (None, problem) if problem else (number, "")

    def set_value(self, value: float | None, *, overwrite: bool = False) -> None:
        """Show a number, e.g. as a device reads back; only ``overwrite`` replaces what is being typed."""
        self._value = value
        if overwrite:
            self._shown = ""
        if overwrite or not self.isModified():
            self._show()

    def set_limits(self, minimum: float, maximum: float) -> None:
        """Change the limits."""
        if (minimum, maximum) != (self.minimum, self.maximum):
            self.minimum, self.maximum = minimum, maximum
            if not self.property("refused"):
                self.setToolTip(self._tip_now())

    def refuse(self, why: str) -> None:
        """Show that the number was refused (by the device), and why; it stays to be corrected."""
        self.setModified(True)
        super().refuse(why)

    def submit(self) -> bool:
        """Take what was typed, or refuse it; returns whether the field holds a number that is in force.

        To be called before what the number is for, too: not every key or click leaves the field.
        """
        if not self.isModified():
            return not self.property("refused")
        number, problem = self.typed()
        if problem:
            super().refuse(problem)
            return False
        if self.text().strip()[-1:] not in _LETTERS:  # so was it meant, and so is the next
            self._shown = self.shown_unit
        changed = number != self._value
        self._value = number
        self._show()
        if changed and number is not None:
            self.submitted.emit(number)
        return True

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802 - Qt's name
        """Step by Up and Down; give up what was typed by Ctrl+Z at its end as any field does."""
        if event.key() in (Qt.Key.Key_Up, Qt.Key.Key_Down):
            number, problem = self.typed()
            if number is not None and not problem:
                step = self._step(number)
                stepped = number + (step if event.key() == Qt.Key.Key_Up else -step)
                self.setText(self._text(stepped))
                self.setModified(True)
                self.submit()
            return
        super().keyPressEvent(event)

    def focusOutEvent(self, event: QFocusEvent) -> None:  # noqa: N802 - Qt's name
        """Submit when the field is left."""
        super().focusOutEvent(event)
        self.submit()

    def _step(self, number: float) -> float:
        """Return a step in the number's second digit."""
        if self._integer:
            return 1.0
        return float(10 ** (math.floor(math.log10(abs(number))) - 1)) if number else 0.1

    def _range(self) -> str:
        if math.isinf(self.maximum):
            return f"{self._text(self.minimum)} or more"
        if math.isinf(self.minimum):
            return f"{self._text(self.maximum)} or less"
        return f"{self._text(self.minimum)} to {self._text(self.maximum)}"

    def _tip_now(self) -> str:
        if math.isinf(self.minimum) and math.isinf(self.maximum):
            return f"{self._tip}\nin {self.shown_unit}".strip() if self.unit else self._tip
        return f"{self._tip}\n{self._range()}".strip()

    def _text(self, number: float) -> str:
        if self.shown_unit != self.unit:
            number = float(f"{number / _MM_UM:.15g}")
        digits = f"{number:.0f}" if self._integer else f"{number:.6g}"
        unit = _one(self.shown_unit) if number == 1 else self.shown_unit
        return f"{grouped(digits)} {unit}".strip()

    def _show(self) -> None:
        self._choose_unit()
        text = "" if self._value is None else self._text(self._value)
        if text != self.text():
            self.setText(text)
        self.setModified(False)
        if self.property("refused") is not False:
            self._mark("")
