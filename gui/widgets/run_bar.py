"""Start, pause and abort, with how far it is."""

from __future__ import annotations

from PySide6.QtCore import Signal
from PySide6.QtGui import QKeySequence
from PySide6.QtWidgets import QGridLayout, QLabel, QProgressBar, QPushButton, QSizePolicy, QWidget

from gui.procedure_run import Situation
from instrument.files.errors import duration

_STEPS = 1000


class RunBar(QWidget):
    """The buttons of a procedure and its progress.

    Signals
    -------
    start, pause, resume, abort
        A button was pressed.

    Parameters
    ----------
    words : str
        On the start button.
    parent : QWidget, optional
    """

    start = Signal()
    pause = Signal()
    resume = Signal()
    abort = Signal()

    def __init__(self, words: str = "Start", parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.start_button = QPushButton(words)
        self.start_button.setObjectName("primary")
        self.start_button.setShortcut(QKeySequence("Ctrl+Return"))
        self.pause_button = QPushButton("Pause")
        self.pause_button.setCheckable(True)
        self.pause_button.setToolTip("Wait before the next frame, light off; press again to go on")
        self.abort_button = QPushButton("Abort")
        self.abort_button.setToolTip("End before the next frame; what was taken is kept and can be resumed")
        self.bar = QProgressBar()
        self.bar.setRange(0, _STEPS)
        self.bar.setTextVisible(False)
        self.words = QLabel()
        self.words.setObjectName("dim")
        self.words.setWordWrap(True)
        self.words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        layout = QGridLayout(self)
        layout.setContentsMargins(0, 4, 0, 0)
        layout.addWidget(self.start_button, 0, 0)
        layout.addWidget(self.pause_button, 0, 1)
        layout.addWidget(self.abort_button, 0, 2)
        layout.addWidget(self.bar, 1, 0, 1, 3)
        layout.addWidget(self.words, 2, 0, 1, 3)
        layout.setColumnStretch(0, 2)
        self.start_button.clicked.connect(self.start)
        self.pause_button.clicked.connect(lambda on: (self.pause if on else self.resume).emit())
        self.abort_button.clicked.connect(self.abort)
        self._why_not = ""
        self.set_running(False)

    def set_startable(self, why_not: str = "") -> None:
        """Let the start button be pressed, or say why not."""
        self._why_not = why_not
        self._show_start(running=self.pause_button.isEnabled())

    def set_running(self, running: bool) -> None:
        """Show the buttons for a procedure that runs, or for none."""
        self.pause_button.setEnabled(running)
        self.abort_button.setEnabled(running)
        self.pause_button.setChecked(False)
        self._show_start(running=running)
        if running:
            self.bar.setValue(0)
            self.words.setText("Beginning")

    def show_situation(self, now: Situation) -> None:
        """Show how far it is."""
        self.bar.setRange(0, _STEPS if now.total else 0)
        if now.total:
            self.bar.setValue(round(_STEPS * now.done / now.total))
        words = [now.step[:1].upper() + now.step[1:]]
        if now.total > 1:
            words.append(f"{now.done:.0f} of {'at most ' if now.at_most else ''}{now.total:.0f}")
        elif now.total:
            words.append(f"{now.done / now.total:.0%}")
        if now.paused:
            words.append("PAUSED, light off")
        elif now.seconds_left is not None:
            words.append(f"{'at most ' if now.at_most else ''}{duration(now.seconds_left)} left")
        self.words.setText(", ".join(words))

    def show_end(self, words: str, *, complete: bool) -> None:
        """Show how it ended."""
        self.bar.setRange(0, _STEPS)
        self.bar.setValue(_STEPS if complete else self.bar.value())
        self.words.setText(words)

    def _show_start(self, *, running: bool) -> None:
        self.start_button.setEnabled(not running and not self._why_not)
        self.start_button.setToolTip(self._why_not or "Begin (Ctrl+Enter)")
