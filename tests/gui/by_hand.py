"""An operator who clicks, types and looks; and the steps of a day, in their order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PySide6.QtCore import QSettings, QSize, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMessageBox, QPushButton

from gui.app import show_and_open
from gui.main_window import MainWindow
from gui.session import BenchSession
from gui.widgets.dialogues import TextWindow
from instrument.bench.config import BenchConfig
from instrument.bench.config_file import no_bench
from tests.gui.event_loop import wait_until

KEY, CONTROL = Qt.Key, Qt.KeyboardModifier.ControlModifier


class Operator:
    """Clicks, types and looks; a window after the other, as ``gui.app`` shows them."""

    def __init__(self, folder: Path, size: QSize, wait_s: float = 300.0) -> None:
        self.folder, self.size, self._wait_s = folder, size, wait_s
        self._settings = QSettings(str(folder / "window.ini"), QSettings.Format.IniFormat)
        self.photographs = 0
        self.open(no_bench(folder))

    def open(self, config: BenchConfig) -> None:
        """Show the window for a bench."""
        self.session = BenchSession(config)
        self.window = MainWindow(self.session, self._settings, self.size)
        opened: list[bool] = []
        self.session.opened.connect(lambda: opened.append(True))
        show_and_open(self.window)
        self.wait(lambda: bool(opened))
        self.window.activateWindow()
        self.wait(self.window.isActiveWindow)  # a screen gives the keyboard in its own time

    def another(self) -> None:
        """Wait until the window has closed for another bench, and show that one's."""
        before = self.window
        self.wait(lambda: before.session.is_closed and before.next_bench is not None)
        before.deleteLater()
        assert before.next_bench is not None
        self.open(before.next_bench)

    def wait(self, until: Callable[[], object]) -> None:
        """Let the window work until something is so."""
        wait_until(until, self._wait_s)

    def panel(self, name: str) -> Any:
        """Return a panel, once it is made."""
        self.wait(lambda: name in self.window.maker.panels)
        return self.window.maker.panels[name]

    def click(self, widget: Any) -> None:
        """Click a widget that can be clicked."""
        self.wait(lambda: widget.isEnabled() and widget.isVisible())
        QTest.mouseClick(widget, Qt.MouseButton.LeftButton)

    def keys(
        self, key: Qt.Key, modifier: Qt.KeyboardModifier = Qt.KeyboardModifier.NoModifier, on: Any = None
    ) -> None:
        """Press a key where the keyboard is, or bring the keyboard somewhere first."""
        self.window.activateWindow()
        if on is not None:
            on.setFocus()
        QTest.keyClick(on or QApplication.focusWidget() or self.window, key, modifier)

    def goes_to(self, name: str, key: Qt.Key, modifier: Qt.KeyboardModifier = CONTROL) -> None:
        """Bring a panel to the front by its keys."""
        self.window.activateWindow()
        self.wait(self.window.isActiveWindow)
        QTest.keyClick(self.window, key, modifier)
        self.wait(self.panel(name).isVisible)

    def types(self, field: Any, text: str) -> None:
        """Type into a field that takes keys, and press Return."""
        self.wait(field.isEnabled)
        field.setFocus()
        field.selectAll()
        QTest.keyClicks(field, text)
        QTest.keyClick(field, KEY.Key_Return)

    def idle(self) -> None:
        """Wait until no job that is shown runs."""
        self.wait(lambda: all(job.quiet for job in self.session.jobs.jobs))

    def answers(self, words: str) -> None:
        """Answer the question in front."""
        boxes = [box for box in self.window.findChildren(QMessageBox) if box.isVisible()]
        self.click(next(b for box in boxes for b in box.buttons() if b.text() == words))

    def reads_and_closes(self, words: str) -> None:
        """Wait until the text in front has some words, and close it."""
        shown: list[TextWindow] = []
        self.wait(
            lambda: shown.extend(w for w in self.window.findChildren(TextWindow) if w.isVisible()) or shown
        )
        self.wait(lambda: words in shown[0].view.toPlainText())
        self.click(next(b for b in shown[0].findChildren(QPushButton) if "Close" in b.text()))
        self.window.activateWindow()

    def ends(self) -> None:
        """Close the window and wait until the bench is closed."""
        self.window.close()
        self.wait(lambda: self.session.is_closed)
        self.session.join()


@dataclass(frozen=True, slots=True)
class DayStep:
    """A step: what the operator does, and the function that does it and looks whether it came about."""

    words: str
    do: Callable[[Operator], None]


STEPS: list[DayStep] = []


def step(words: str) -> Callable[[Callable[[Operator], None]], Callable[[Operator], None]]:
    """Add a step to the day."""

    def add(do: Callable[[Operator], None]) -> Callable[[Operator], None]:
        STEPS.append(DayStep(words, do))
        return do

    return add
