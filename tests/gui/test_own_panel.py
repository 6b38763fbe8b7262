"""A panel is one file and one line in the table: with that it has a dock, keys, a form, and its Python."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from PySide6.QtCore import QSettings, Qt
from PySide6.QtWidgets import QApplication, QDockWidget
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels import PANELS, PanelEntry
from gui.session import BenchSession

LINE = PanelEntry("Blink", "tests.gui.own_panel:BlinkPanel", "right", "Ctrl+Shift+B", "Blink now and then")


@pytest.fixture
def own_window(
    qtbot: QtBot, make_session, settings: QSettings, monkeypatch: pytest.MonkeyPatch
) -> Iterator[MainWindow]:
    monkeypatch.setitem(PANELS, "blink", LINE)  # type: ignore[arg-type]
    session: BenchSession = make_session()
    window = MainWindow(session, settings)
    window.show()
    yield window
    for panel in window._panels.values():
        panel.shutdown()
    with qtbot.waitSignal(session.closed, timeout=60_000):
        session.close()
    window._may_close = True
    window.close()
    window.deleteLater()


def test_a_panel_of_ones_own_is_a_file_and_a_line(qtbot: QtBot, own_window: MainWindow) -> None:
    dock = own_window.findChild(QDockWidget, "dock-blink")
    assert dock is not None
    assert dock.toolTip() == LINE.tip
    qtbot.keyClick(
        own_window, Qt.Key.Key_B, Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
    )
    panel = own_window.panel("blink")
    qtbot.waitUntil(panel.isVisible)
    times = panel.form.widgets["times"]
    times.selectAll()
    qtbot.keyClicks(times, "0")
    qtbot.mouseClick(panel.button, Qt.MouseButton.LeftButton)
    assert "1 or more" in panel.form.reason("times")
    assert "1 or more" in panel._note.text()
    times.selectAll()
    qtbot.keyClicks(times, "5")
    qtbot.mouseClick(panel.button, Qt.MouseButton.LeftButton)
    assert not panel.form.reason("times")
    panel.copy_button.click()
    names: dict = {}
    exec(QApplication.clipboard().text(), names)
    assert (names["options"].times, names["options"].every_ms) == (5, 100.0)
