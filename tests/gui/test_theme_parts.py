"""A change of theme comes in small turns, and leaves nothing of the theme before."""

from __future__ import annotations

import pytest
from PySide6.QtCore import QEvent, QObject, QSettings
from PySide6.QtGui import QColor
from PySide6.QtWidgets import QLabel, QWidget
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels.tasks import TasksPanel
from gui.theme import RED, THEMES, change_theme, sheet
from gui.widgets.dialogues import Question
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


def test_no_part_that_takes_a_theme_at_once_has_hundreds_of_widgets(
    qtbot: QtBot, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = window.panel("tasks")
    assert isinstance(files, TasksPanel)
    window.panel("holograms")
    reconstructions = window.panel("reconstructions")
    for name in ("video", "patterned"):  # as in a day's work
        files.choose(name)
        qtbot.waitUntil(lambda name=name: name in files._pages, timeout=WAIT_MS)
    sizes: list[int] = []
    monkeypatch.setattr("gui.theme.dress", lambda part: sizes.append(len(part.findChildren(QWidget))))
    window.set_theme("light")
    qtbot.waitUntil(lambda: not window.is_restyling, timeout=WAIT_MS)
    monkeypatch.undo()
    assert len(files.findChildren(QWidget)) > 400
    assert len(reconstructions.findChildren(QWidget)) > 300
    assert max(sizes) < 250
    window.set_theme("red")
    qtbot.waitUntil(lambda: not window.is_restyling, timeout=WAIT_MS)
    files.choose("activity")  # made under another theme than those beside it
    qtbot.waitUntil(lambda: "activity" in files._pages, timeout=WAIT_MS)
    for name in ("video", "activity"):
        words = next(each for each in files._pages[name].form.findChildren(QLabel) if each.text())
        assert words.palette().windowText().color().name() in (RED.text, RED.dim), name
    window.set_theme("dark")
    qtbot.waitUntil(lambda: not window.is_restyling, timeout=WAIT_MS)


@pytest.mark.parametrize("name", sorted(THEMES))
def test_a_theme_can_be_chosen_and_another_before_it_is_there(
    qtbot: QtBot, window: MainWindow, settings: QSettings, name: str
) -> None:
    window.panel("reconstructions")
    for chosen in ("light", name):
        window.set_theme(chosen)
    qtbot.waitUntil(lambda: not window.is_restyling, timeout=WAIT_MS)
    assert window.updatesEnabled()
    assert settings.value("theme") == name
    late = window.panel("films")  # made under the theme that is not the program's first
    question = Question(window, "Title", "Text", ("Yes", "No"), lambda _: None)
    assert window.statusBar().palette().window().color() == QColor(THEMES[name].panel)
    for part in (window, window.tabs, late, question):
        assert part.palette().window().color() == QColor(THEMES[name].window)
    assert late.copy_button.palette().buttonText().color() == QColor(THEMES[name].text)  # by the sheet
    question.close()
    window.set_theme("dark")
