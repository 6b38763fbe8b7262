"""The keyboard's place: with the work while its part is off or hidden, and back in it afterwards."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication, QPushButton
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.widgets.tab_order import stops_of
from tests.gui.conftest import WAIT_MS


def test_what_is_typed_while_a_button_works_goes_into_no_field(qtbot: QtBot, window: MainWindow) -> None:
    """After *Auto* the keyboard was in *Gain*, its number selected."""
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    live = window.show_panel("live")
    auto = next(b for b in live.findChildren(QPushButton) if b.text() == "Auto")
    qtbot.waitUntil(auto.isEnabled, timeout=WAIT_MS)
    auto.setFocus()
    auto.setEnabled(False)
    assert QApplication.focusWidget() is None
    auto.setEnabled(True)
    assert auto.hasFocus(), "it has done its work"
    auto.setEnabled(False)
    window.stop_button.setFocus()
    auto.setEnabled(True)
    assert window.stop_button.hasFocus(), "the operator went on meanwhile"


def test_the_keyboard_of_a_part_that_is_hidden_waits_and_goes_on_from_there(
    qtbot: QtBot, window: MainWindow
) -> None:
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    live = window.show_panel("live")
    auto = next(b for b in live.findChildren(QPushButton) if b.text() == "Auto")
    qtbot.waitUntil(auto.isEnabled, timeout=WAIT_MS)
    stops = list(stops_of(window))
    before, after = (stops[stops.index(auto) + step] for step in (-1, 1))
    auto.setFocus()
    auto.hide()
    assert QApplication.focusWidget() is None, "what is typed goes to no field"
    auto.show()
    assert auto.hasFocus()
    for key, beside in ((Qt.Key.Key_Tab, after), (Qt.Key.Key_Backtab, before)):
        auto.setFocus()
        auto.hide()
        qtbot.keyClick(window, key)
        assert beside.hasFocus()
        auto.show()
        assert beside.hasFocus(), "the operator went on meanwhile"


def test_the_keyboard_comes_back_into_a_form_that_was_off_as_a_whole(
    qtbot: QtBot, window: MainWindow
) -> None:
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    live = window.show_panel("live")
    auto = next(b for b in live.findChildren(QPushButton) if b.text() == "Auto")
    qtbot.waitUntil(auto.isEnabled, timeout=WAIT_MS)
    auto.setFocus()
    live.setEnabled(False)
    assert QApplication.focusWidget() is None
    live.setEnabled(True)
    assert auto.hasFocus()


def test_a_part_that_comes_on_first_takes_the_keyboard_from_no_other(
    qtbot: QtBot, window: MainWindow
) -> None:
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    live = window.show_panel("live")
    parts = [b for b in live.findChildren(QPushButton) if b.isVisible() and b.isEnabled()][:2]
    for part in parts:
        part.setFocus()
        part.setEnabled(False)
    assert QApplication.focusWidget() is None
    for part in parts:
        part.setEnabled(True)
    assert parts[1].hasFocus(), "it had the keyboard last"
