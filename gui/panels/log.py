"""The log: what happened, filtered by level and text, copyable."""

from __future__ import annotations

from collections import deque
from datetime import datetime
from typing import NamedTuple

from PySide6.QtGui import QColor, QTextCharFormat, QTextCursor
from PySide6.QtWidgets import QLineEdit, QPlainTextEdit, QWidget

from gui.panel import Panel
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.building import button, choice, fill, in_row, text_view

LEVELS = ("debug", "info", "warning", "error")
MOST_LINES = 2000
"""Kept; older ones go, so that a long day stays flat in memory."""


class _Line(NamedTuple):
    when: datetime
    level: str
    text: str


class LogPanel(Panel):
    """Lines of the session's log, newest last."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self._lines: deque[_Line] = deque(maxlen=MOST_LINES)
        words = ["everything", "info and above", "warnings and errors", "errors"]
        self.level = choice(words, "Which lines are shown", self._show_all)
        self.words = QLineEdit()
        self.words.setPlaceholderText("only lines with …")
        self.words.setClearButtonEnabled(True)
        self.words.setAccessibleName("Only lines with")
        self.words.setToolTip("Show only lines that contain this text")
        self.words.textChanged.connect(self._show_all)
        self.clear_button = button("Clear", "Empty the log", self._clear)
        self.view = text_view()
        self.view.setAccessibleName("Log")
        self.view.setMinimumHeight(30)
        self.view.setMaximumBlockCount(MOST_LINES)
        self.view.setLineWrapMode(QPlainTextEdit.LineWrapMode.WidgetWidth)
        self.level.setCurrentIndex(1)
        fill(self.body, in_row(self.level, (self.words, 1), self.clear_button), (self.view, 1))
        session.logged.connect(self.add)

    def add(self, level: str, text: str) -> None:
        """Add a line."""
        line = _Line(datetime.now().astimezone(), level, text)
        self._lines.append(line)
        if self._is_shown(line):
            self._write(line)

    def as_python(self) -> str:
        """Return lines that let a script log the same."""
        return (
            "import logging\n\n"
            'line = "%(asctime)s %(levelname)s %(name)s: %(message)s"\n'
            "logging.basicConfig(level=logging.INFO, format=line)\n"
        )

    def restyle(self) -> None:
        """Write the lines anew: their colours say what they are."""
        self._show_all()

    def _is_shown(self, line: _Line) -> bool:
        level = LEVELS.index(line.level) if line.level in LEVELS else 1
        return level >= self.level.currentIndex() and self.words.text().lower() in line.text.lower()

    def _show_all(self, *_: object) -> None:
        self.view.clear()
        for line in self._lines:
            if self._is_shown(line):
                self._write(line)

    def _write(self, line: _Line) -> None:
        bar = self.view.verticalScrollBar()
        at_end = bar.value() >= bar.maximum() - 2
        cursor = QTextCursor(self.view.document())
        cursor.movePosition(QTextCursor.MoveOperation.End)
        if not self.view.document().isEmpty():
            cursor.insertBlock()
        now = colours()
        style = QTextCharFormat()
        style.setForeground(QColor(now.dim))
        cursor.insertText(f"{line.when:%H:%M:%S}  ", style)
        colour = {"error": now.error, "warning": now.warning, "debug": now.dim}.get(line.level, now.text)
        style.setForeground(QColor(colour))
        word = f"{line.level.upper()}: " if line.level in ("warning", "error") else ""
        cursor.insertText(f"{word}{line.text}", style)
        if at_end:
            bar.setValue(bar.maximum())

    def _clear(self) -> None:
        self._lines.clear()
        self.view.clear()
