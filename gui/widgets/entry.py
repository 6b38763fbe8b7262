"""A field for words that mean something: understood when it is left, refused where it stands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from PySide6.QtCore import Signal
from PySide6.QtGui import QFocusEvent
from PySide6.QtWidgets import QComboBox, QHBoxLayout, QLineEdit, QToolButton, QWidget

from gui.widgets.dialogues import Browse, choose_path
from instrument.files.errors import BenchError


class Entry(QLineEdit):
    """A text and the value that it stands for.

    Parameters
    ----------
    understand : callable
        Turns the text into a value; BenchError with the reason where it cannot.
    text : str
    tip : str
        The tool tip: what may be written, with units.

    Signals
    -------
    refused : str
        Why what was written is not understood.
    understood
        It is.
    """

    refused = Signal(str)
    understood = Signal()

    def __init__(
        self,
        understand: Callable[[str], Any],
        text: str = "",
        *,
        tip: str = "",
        placeholder: str = "",
        parent: QWidget | None = None,
    ) -> None:
        super().__init__(text, parent)
        self._understand = understand
        self._tip = tip
        self.setToolTip(tip)
        self.setPlaceholderText(placeholder)
        self.setMinimumWidth(40)
        self.returnPressed.connect(self.check)
        self.textEdited.connect(lambda _: self._mark(""))

    def value(self) -> Any:
        """Return what the text stands for.

        Raises
        ------
        BenchError
        """
        return self._understand(self.text().strip())

    def check(self) -> bool:
        """Tell whether the text is understood, and show the reason where it is not."""
        try:
            self.value()
        except BenchError as error:
            self.refuse(str(error))
            return False
        self._mark("")
        self.understood.emit()
        return True

    def refuse(self, why: str) -> None:
        """Show why the text cannot be used."""
        self._mark(why)
        self.refused.emit(why)

    def focusOutEvent(self, event: QFocusEvent) -> None:  # noqa: N802 - Qt's name
        """Check when the field is left."""
        super().focusOutEvent(event)
        self.check()

    def _mark(self, why: str) -> None:
        self.setProperty("refused", bool(why))
        self.setToolTip(why or self._tip)
        self.style().unpolish(self)
        self.style().polish(self)


class PathEntry(QWidget):
    """An :class:`Entry` for a path, with a button that opens a dialogue to choose it."""

    def __init__(
        self, entry: Entry, browse: Browse, filters: str = "", parent: QWidget | None = None
    ) -> None:
        super().__init__(parent)
        self.entry = entry
        self._browse: Browse = browse
        self._filters = filters
        self.button = QToolButton()
        self.button.setText("…")
        self.button.setToolTip("Choose")
        self.button.clicked.connect(self._choose)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(3)
        row.addWidget(entry, 1)
        row.addWidget(self.button)

    def set_browse(self, browse: Browse) -> None:
        """Choose files, folders, or names to save under from now on."""
        self._browse = browse

    def _choose(self) -> None:
        words = {"open": "Choose a file", "folder": "Choose a folder", "save": "Choose a name"}[self._browse]
        choose_path(self, self._browse, words, self.entry.text(), self._chosen, self._filters)

    def _chosen(self, path: Path) -> None:
        self.entry.setText(str(path))
        self.entry.check()
        self.entry.editingFinished.emit()  # as if it had been typed


def narrow(box: QComboBox) -> None:
    """Let a box be narrower than its longest entry."""
    box.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
    box.setMinimumContentsLength(5)


def existing_path(text: str) -> Path:
    """Return the path that a text names; BenchError where nothing is there."""
    if not text:
        raise BenchError("A file or folder is needed here.")
    path = Path(text).expanduser()
    if not path.exists():
        raise BenchError(f"{path}: there is no such file or folder.")
    return path


def number(name: str, unit: str, *, above_zero: bool = False, whole: bool = False) -> Callable[[str], Any]:
    """Return what understands a number with or without its unit; an empty text or ``auto`` is None."""

    def understand(text: str) -> float | int | None:
        bare = text.removesuffix(unit).strip() if unit else text
        if bare in ("", "auto"):
            return None
        try:
            value = float(bare.replace(",", "."))
        except ValueError:
            raise BenchError(f"{name} {text!r} is no number{f' of {unit}' if unit else ''}.") from None
        if not (value == value and abs(value) != float("inf")) or value < 0 or (above_zero and value == 0):
            least = "above 0" if above_zero else "0 or more"
            raise BenchError(f"{name} must be {least}{f' {unit}' if unit else ''}, not {text}.")
        if whole and value != int(value):
            raise BenchError(f"{name} must be a whole number, not {text}.")
        return int(value) if whole else value

    return understand
