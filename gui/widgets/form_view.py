"""A form's fields on the screen: labels, units, tool tips, and reasons under what was refused."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from PySide6.QtCore import QSignalBlocker, QTimer, Signal
from PySide6.QtGui import QFontDatabase
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QFormLayout,
    QHBoxLayout,
    QLabel,
    QLineEdit,
    QPlainTextEdit,
    QPushButton,
    QScrollArea,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from gui.forms.field import Field, Form
from gui.widgets.number_edit import NumberEdit
from gui.widgets.question import choose_path

_TEXT_HEIGHT_PX = 300


class FormView(QWidget):
    """Shows a form. ``values`` reads it; what cannot be read is marked where it stands.

    Signals
    -------
    changed
        Something was typed, ticked or chosen.

    Parameters
    ----------
    form : Form
    parent : QWidget, optional
    """

    changed = Signal()

    def __init__(self, form: Form, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.form = form
        self.widgets: dict[str, QWidget] = {}
        self._reasons: dict[str, QLabel] = {}
        self._state: list[tuple[Any, str]] = []
        usual, seldom = self._rows(advanced=False), self._rows(advanced=True)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(usual)
        if seldom.rowCount():
            self.more = QToolButton()
            self.more.setText("More settings")
            self.more.setCheckable(True)
            self.more.setToolTip("Settings that seldom change")
            box = QWidget()
            box.setLayout(seldom)
            box.hide()
            self.more.toggled.connect(box.setVisible)
            layout.addWidget(self.more)
            layout.addWidget(box)
        layout.addStretch(1)
        self._state = [self._read(field) for field in form.fields]

    # Values --------------------------------------------------------------------------------------
    def values(self) -> dict[str, Any] | None:
        """Return the settings in their own units, None for what is left out; None when one cannot be read."""
        self.clear_reasons()
        found: dict[str, Any] = {}
        readable = True
        for field in self.form.fields:
            value, problem = self._read(field)
            if problem:
                self.refuse(field.name, problem)
                readable = False
            found[field.name] = value
        return found if readable else None

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Show settings; names that the form does not have are left out."""
        for field in self.form.fields:
            if field.name in values:
                self._show(field, values[field.name])
        self._edited()

    def begin_with(self, values: Mapping[str, Any]) -> None:
        """Show settings in the fields that are empty."""
        empty = {
            name
            for name, widget in self.widgets.items()
            if isinstance(widget, QLineEdit) and not widget.text() and not widget.placeholderText()
        }
        self.set_values({name: value for name, value in values.items() if name in empty})

    def refuse(self, name: str, why: str) -> bool:
        """Mark a field as wrong, with the reason below it; returns whether there is such a field."""
        widget = self.widgets.get(name)
        if widget is None:
            return False
        reason = self._reasons[name]
        text = why[:1].upper() + why[1:] + ("" if why.endswith(".") else ".")
        reason.setText(text)
        reason.show()
        _mark(widget, refused=True)
        return True

    def show_field(self, name: str) -> None:
        """Bring a field into sight, also from among those that seldom change."""
        if any(field.name == name and field.advanced for field in self.form.fields):
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
        for name, reason in self._reasons.items():
            if reason.text():
                reason.clear()
                reason.hide()
                _mark(self.widgets[name], refused=False)

    def reason(self, name: str) -> str:
        """Return why a field was refused; empty when it was not."""
        return self._reasons[name].text()

    # Inside --------------------------------------------------------------------------------------
    def _rows(self, *, advanced: bool) -> QFormLayout:
        rows = QFormLayout()
        rows.setContentsMargins(0, 0, 0, 0)
        rows.setVerticalSpacing(4)
        rows.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        rows.setRowWrapPolicy(QFormLayout.RowWrapPolicy.DontWrapRows)
        for field in self.form.fields:
            if field.advanced != advanced:
                continue
            widget, whole = self._make(field)
            reason = QLabel()
            reason.setObjectName("reason")
            reason.setWordWrap(True)
            reason.hide()
            self.widgets[field.name], self._reasons[field.name] = widget, reason
            label = QLabel(field.label)
            label.setToolTip(field.tip)
            label.setBuddy(widget)
            widget.setAccessibleName(field.label)
            if field.kind == "text":
                rows.addRow(whole)
            else:
                rows.addRow(label, whole)
            rows.addRow(reason)
            self._show(field, field.default)
        return rows

    def _make(self, field: Field) -> tuple[QWidget, QWidget]:
        """Return the widget that is edited, and what goes into the row."""
        if field.kind in ("number", "whole"):
            # An empty field shows no unit by itself.
            empty = f"{field.optional} ({field.unit})" if field.optional and field.unit else field.optional
            number = NumberEdit(field.unit, integer=field.kind == "whole", tip=field.tip, empty=empty)
            number.textEdited.connect(self._edited)
            number.submitted.connect(self._edited)
            return number, number
        if field.kind == "switch":
            box = QCheckBox()
            box.setToolTip(field.tip)
            box.toggled.connect(self._edited)
            return box, box
        if field.kind == "choice":
            choice = QComboBox()
            choice.addItems(list(field.choices))
            choice.setToolTip(field.tip)
            choice.currentIndexChanged.connect(self._edited)
            return choice, choice
        if field.kind == "text":
            text = QPlainTextEdit()
            text.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
            text.setLineWrapMode(QPlainTextEdit.LineWrapMode.NoWrap)
            text.setMinimumHeight(_TEXT_HEIGHT_PX)
            text.setToolTip(field.tip)
            text.setTabChangesFocus(True)
            text.textChanged.connect(self._edited)
            return text, text
        line = QLineEdit()
        line.setPlaceholderText(field.optional)
        line.setToolTip(field.tip)
        line.textChanged.connect(self._edited)
        browse = QPushButton("…")
        browse.setToolTip(f"Choose: {field.tip}")
        browse.setAccessibleName(f"Choose {field.label}")
        browse.setFixedWidth(32)
        browse.clicked.connect(partial(self._browse, field, line))
        row = QWidget()
        inner = QHBoxLayout(row)
        inner.setContentsMargins(0, 0, 0, 0)
        inner.addWidget(line, 1)
        inner.addWidget(browse)
        return line, row

    def _edited(self, _value: object = None) -> None:
        """Tell of a change; a field that is merely left, and shows its number anew, has not changed."""
        state = [self._read(field) for field in self.form.fields]
        if state != self._state:
            self._state = state
            self.changed.emit()

    def _browse(self, field: Field, line: QLineEdit) -> None:
        choose_path(line, "open", field.label, line.text(), lambda path: line.setText(str(path)))

    def _read(self, field: Field) -> tuple[Any, str]:
        widget = self.widgets[field.name]
        if isinstance(widget, NumberEdit):
            number, problem = widget.typed()
            if number is None or problem:
                return None, problem
            return (int(number) if field.kind == "whole" else number * field.scale), ""
        if isinstance(widget, QCheckBox):
            return widget.isChecked(), ""
        if isinstance(widget, QComboBox):
            return widget.currentText(), ""
        if isinstance(widget, QPlainTextEdit):
            return widget.toPlainText(), ""
        assert isinstance(widget, QLineEdit)
        text = widget.text().strip()
        return (Path(text).expanduser() if text else None), ""

    def _show(self, field: Field, value: Any) -> None:
        widget = self.widgets[field.name]
        blocked = QSignalBlocker(widget)
        if isinstance(widget, NumberEdit):
            widget.set_value(None if value is None else value / field.scale, overwrite=True)
        elif isinstance(widget, QCheckBox):
            widget.setChecked(bool(value))
        elif isinstance(widget, QComboBox):
            widget.setCurrentText(str(value))
        elif isinstance(widget, QPlainTextEdit):
            widget.setPlainText(str(value or ""))
        elif isinstance(widget, QLineEdit):
            widget.setText("" if value is None else str(value))
        blocked.unblock()


def _mark(widget: QWidget, *, refused: bool) -> None:
    widget.setProperty("refused", refused)
    widget.style().unpolish(widget)
    widget.style().polish(widget)
