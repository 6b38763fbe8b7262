"""A change of theme comes in small turns, and leaves nothing of the theme before."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QObject
from PySide6.QtWidgets import QWidget
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.theme import change_theme, sheet
from tests.gui.conftest import WAIT_MS

MOST = 150
"""Widgets that take a theme in one turn."""


def test_parts_that_are_seen_are_painted_in_turns_of_their_own(qtbot: QtBot, window: MainWindow) -> None:
    qtbot.waitUntil(lambda: "live" in window.maker.panels, timeout=WAIT_MS)

    with qtbot.waitSignal(window.session.jobs.job_ended, timeout=WAIT_MS):
        window.session.viewing.hold()  # its frames would be painted between the others

    class Painted(QObject):
        """Collects what is painted."""

        def eventFilter(self, watched: QObject, event: QEvent) -> bool:
            if event.type() == QEvent.Type.Paint and isinstance(watched, QWidget):
                painted.append(watched)
            return False

    painted: list[QWidget] = []
    live = window.maker.panels["live"]
    parts = [window._header, *live.wholes()]
    watch = Painted(window)
    for part in parts:
        part.installEventFilter(watch)
    qtbot.wait(100)
    painted.clear()
    together, seen, held = 0, set[QWidget](), set[QWidget]()
    for _ in change_theme("light", window, parts):
        freed, held = held, {part for part in parts if not part.updatesEnabled()}
        freed -= held
        qtbot.waitUntil(lambda freed=freed: freed <= set(painted), timeout=WAIT_MS)  # type: ignore[misc]
        qtbot.wait(30)
        together = max(together, len(set(painted)))
        seen |= set(painted)
        painted.clear()
    assert window.updatesEnabled()
    assert {part for part in parts if part.isVisible()} <= seen, "no paint was seen"
    assert all(part.updatesEnabled() and part.styleSheet() == sheet() for part in parts)
    assert together <= 1


def test_no_part_is_large(qtbot: QtBot, window: MainWindow) -> None:
    for name in ("live", "live_reconstruction", "reconstructions", "holograms"):
        window.show_panel(name)
        qtbot.waitUntil(lambda name=name: name in window.maker.panels, timeout=WAIT_MS)  # type: ignore[misc]
        wholes = window.maker.panels[name].wholes()
        assert any(part.findChildren(QWidget) for part in wholes), name
        large = {
            type(part).__name__: count for part in wholes if (count := len(part.findChildren(QWidget))) > MOST
        }
        assert not large, name
    window.set_theme("dark")
    qtbot.waitUntil(lambda: not window.is_restyling, timeout=WAIT_MS)
