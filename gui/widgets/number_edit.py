"""A number with its unit, edited in place, refused in place."""

from __future__ import annotations

import math
from collections.abc import Callable

from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QFocusEvent, QKeyEvent
from PySide6.QtWidgets import QLineEdit, QWidget

_LENGTHS_UM = {"nm": 1e-3, "um": 1.0, "µm": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6}
_TIMES_MS = {"us": 1e-3, "µs": 1e-3, "ms": 1.0, "s": 1e3, "min": 6e4}
_LETTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZµ×%/° "


def _factor(typed: str, unit: str) -> float | None:
    """Return what a number in a typed unit is multiplied with to be in another; None where that is none."""
    for scale in (_LENGTHS_UM, _TIMES_MS):
        if typed in scale and unit in scale:
            return scale[typed] / scale[unit]
    return None


class NumberEdit(QLineEdit):
    """A field for one number: ``12.5 ms``. Enter or leaving it submits; Up and Down step by a tenth.

    Lengths and times may be typed in another unit than the field's: ``2 s`` where it has milliseconds.

    A value that is none, or outside the limits, is refused where it stands, with the reason as tool tip; what
    was typed stays to be corrected. Nothing is ever clipped.

    Signals
    -------
    submitted : float
        A new number within the limits.
    refused : str
        Why what was typed was refused.

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
    parent : QWidget, optional
    """

    submitted = Signal(float)
    refused = Signal(str)

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
        parent: QWidget | None = None,
    ) -> None:
        super().__init__(parent)
        self.unit = unit
        self.minimum, self.maximum = minimum, maximum
        self.check: Callable[[float], str] | None = None
        """Further says of a number why it cannot be; empty where it can."""
        self._integer = integer
        self._tip = tip
        self._value = value
        self.setPlaceholderText(empty)
        self.setAlignment(Qt.AlignmentFlag.AlignRight)
        self.returnPressed.connect(self.submit)
        self._show()

    @property
    def value(self) -> float | None:
        """The last number that was accepted or set."""
        return self._value

    def typed(self) -> tuple[float | None, str]:
        """Return the number as it stands in the field, submitted or not, and why it is refused if it is.

        None for a number, and no reason, where the field may be empty and is.
        """
        return self._read()

    def set_value(self, value: float | None, *, overwrite: bool = False) -> None:
        """Show a number, e.g. as a device reads back; only ``overwrite`` replaces what is being typed."""
        self._value = value
        if overwrite or not self.isModified():
            self._show()

    def set_limits(self, minimum: float, maximum: float) -> None:
        """Change the limits."""
        if (minimum, maximum) != (self.minimum, self.maximum):
            self.minimum, self.maximum = minimum, maximum
            if not self.property("refused"):
                self.setToolTip(self._limits_tip())

    def refuse(self, why: str) -> None:
        """Show that the number was refused (by the device), and why; it stays to be corrected."""
        self.setModified(True)
        self._mark(why)
        self.refused.emit(why)

    def submit(self) -> bool:
        """Take what was typed, or refuse it; returns whether the field holds a number that is in force.

        To be called before what the number is for, too: not every key or click leaves the field.
        """
        if not self.isModified():
            return not self.property("refused")
        number, problem = self._read()
        if problem:
            self._mark(problem)
            self.refused.emit(problem)
            return False
        changed = number != self._value
        self._value = number
        self._show()
        if changed and number is not None:
            self.submitted.emit(number)
        return True

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802 - Qt's name
        """Step by Up and Down; give up what was typed by Ctrl+Z at its end as any field does."""
        if event.key() in (Qt.Key.Key_Up, Qt.Key.Key_Down):
            number, problem = self._read()
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

    def _read(self) -> tuple[float | None, str]:
        text = self.text().strip()
        if not text:
            return None, "" if self.placeholderText() else "A number is needed."
        digits = text.rstrip(_LETTERS).strip()
        typed = text[len(digits) :].strip() if digits else ""
        factor: float | None = 1.0 if typed in ("", self.unit) else _factor(typed, self.unit)
        try:
            number = float(digits.replace(",", "."))
        except ValueError:
            factor = None
        if factor is None:
            return None, f"{text!r} is no number{f' of {self.unit}' if self.unit else ''}."
        # 2 cm are 20 mm, not 20.000000000000004.
        number = float(f"{number * factor:.15g}")
        if not math.isfinite(number):
            return None, f"{text} is no finite number."
        if self._integer and number != int(number):
            return None, f"{number:g} is no whole number."
        if not self.minimum <= number <= self.maximum:
            unit = f" {self.unit}" if self.unit else ""
            in_force = "" if self._value is None else f" In force: {self._text(self._value)}."
            return None, f"{number:g}{unit} is outside what is allowed: {self._range()}.{in_force}"
        problem = "" if self.check is None else self.check(number)
        return (None, problem) if problem else (number, "")

    def _range(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.maximum):
            return f"{self.minimum:g}{unit} or more"
        if math.isinf(self.minimum):
            return f"{self.maximum:g}{unit} or less"
        return f"{self.minimum:g} to {self.maximum:g}{unit}"

    def _limits_tip(self) -> str:
        if math.isinf(self.minimum) and math.isinf(self.maximum):
            return f"{self._tip}\nin {self.unit}".strip() if self.unit else self._tip
        return f"{self._tip}\n{self._range()}".strip()

    def _text(self, number: float) -> str:
        digits = f"{number:.0f}" if self._integer else f"{number:.6g}"
        return f"{digits} {self.unit}".strip()

    def _show(self) -> None:
        text = "" if self._value is None else self._text(self._value)
        if text != self.text():
            self.setText(text)
        self.setModified(False)
        if self.property("refused") is not False:
            self.setProperty("refused", False)
            self.setToolTip(self._limits_tip())
            self._restyle()

    def _mark(self, why: str) -> None:
        self.setProperty("refused", True)
        self.setToolTip(why)
        self._restyle()

    def _restyle(self) -> None:
        self.style().unpolish(self)
        self.style().polish(self)
