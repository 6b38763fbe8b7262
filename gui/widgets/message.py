"""Texts that are longer than their place: elided where they stand, whole in a window, copyable."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtGui import QFontDatabase, QGuiApplication
from PySide6.QtWidgets import QDialog, QDialogButtonBox, QLabel, QPlainTextEdit, QVBoxLayout, QWidget

_MOST_CHARACTERS = 220


def elided(label: QLabel, text: str) -> None:
    """Show a text's beginning on a label, all of it as its tool tip."""
    first = " ".join(text.split())
    short = first if len(first) <= _MOST_CHARACTERS else first[: _MOST_CHARACTERS - 1] + "…"
    label.setText(short)
    label.setToolTip(text)


class TextWindow(QDialog):
    """A long text in a window of its own, which can be selected and copied; gone when it is closed.

    To be shown by ``show``: ``open`` and ``exec`` would keep clicks from STOP.

    Parameters
    ----------
    title, text : str
    parent : QWidget, optional
    """

    def __init__(self, title: str, text: str, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.setWindowTitle(title)
        self.resize(760, 420)
        self.view = QPlainTextEdit(text)
        self.view.setReadOnly(True)
        self.view.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        copy = buttons.addButton("Copy all", QDialogButtonBox.ButtonRole.ActionRole)
        copy.clicked.connect(lambda: QGuiApplication.clipboard().setText(self.view.toPlainText()))
        buttons.rejected.connect(self.reject)
        layout = QVBoxLayout(self)
        layout.addWidget(self.view)
        layout.addWidget(buttons)
