"""What every panel has: its session, "Copy as Python", a line for what was refused."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QGuiApplication
from PySide6.QtWidgets import QHBoxLayout, QLabel, QPushButton, QSizePolicy, QVBoxLayout, QWidget

from gui.jobs import Job, JobRunner
from gui.session import BenchSession
from gui.widgets.dialogues import elided

_REFUSAL_MS = 12_000


class Panel(QWidget):
    """A part of the window. Subclasses set ``title``, fill ``body`` and say ``as_python``.

    Parameters
    ----------
    session : BenchSession
    parent : QWidget, optional
    """

    title: ClassVar[str] = ""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.session = session
        self.body = QWidget()
        """Where the panel's own widgets go: give it a layout."""
        self.body.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self._note = QLabel()
        self._note.setObjectName("refusal")
        self._note.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self._note.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self._note.setWordWrap(True)
        self.copy_button = QPushButton("Copy as Python")
        self.copy_button.setObjectName("copy-as-python")
        self.copy_button.setFlat(True)
        self.copy_button.setToolTip("Copy the lines of Python that do what this panel is set to")
        self.copy_button.clicked.connect(self.copy_as_python)
        self._fade = QTimer(self)
        self._fade.setSingleShot(True)
        self._fade.timeout.connect(self.accepted)
        foot = QHBoxLayout()
        foot.addWidget(self._note, 1)
        foot.addWidget(self.copy_button)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(8, 8, 8, 4)
        layout.setSpacing(4)
        layout.addWidget(self.body, 1)
        layout.addLayout(foot)

    @property
    def jobs(self) -> JobRunner:
        """Where the panel's work is done."""
        return self.session.jobs

    def as_python(self) -> str:
        """Return the lines of Python that do what the panel is set to do."""
        raise NotImplementedError

    def copy_as_python(self) -> None:
        """Put the panel's Python lines on the clipboard."""
        QGuiApplication.clipboard().setText(self.as_python())
        self.session.log("info", f"{self.title}: copied as Python.")

    def take(self, path: Path) -> None:
        """Work with a file or folder that another panel hands on; for panels that can."""
        raise NotImplementedError

    def shutdown(self) -> None:
        """End what the panel runs of its own (timers, workers); called before the window closes."""

    def theme_changed(self) -> None:
        """Take over another theme where the style sheet does not reach: plots, images."""

    # Telling the user ----------------------------------------------------------------------------
    def refused(self, field: QWidget | None, why: str) -> None:
        """Show why something was refused: at the field, and in the panel's last line."""
        if field is not None:
            field.setProperty("refused", True)
            field.setToolTip(why)
            _restyle(field)
        elided(self._note, why)
        self._fade.start(_REFUSAL_MS)

    def accepted(self, field: QWidget | None = None) -> None:
        """Clear what ``refused`` showed."""
        if field is not None:
            field.setProperty("refused", False)
            _restyle(field)
        self._note.clear()
        self._note.setToolTip("")

    def tells(self, job: Job) -> Job:
        """Have a job's failure shown in this panel's last line; returns the job."""
        job.failed.connect(lambda why: self.refused(None, why))
        return job


def _restyle(widget: QWidget) -> None:
    """Apply the style sheet again after a property has changed."""
    widget.style().unpolish(widget)
    widget.style().polish(widget)
