"""The window on a small screen: everything of the live view within reach, STOP in sight."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from PySide6.QtCore import QPoint, QRect, QSettings, QSize, Qt
from PySide6.QtWidgets import QLabel, QLineEdit, QPushButton, QScrollArea, QWidget
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels import PANELS
from gui.panels.live import LivePanel
from gui.panels.sweeps import SweepsPanel
from gui.panels.tasks import TasksPanel
from gui.session import BenchSession
from gui.widgets.building import fill, label, scrolled
from instrument.tasks import TASKS
from tests.gui.conftest import WAIT_MS
from tests.gui.looks import SIZES, faults, nameless

ROOM = QSize(1280, 720)


@pytest.fixture
def small(qtbot: QtBot, session: BenchSession, settings: QSettings) -> Iterator[MainWindow]:
    window = MainWindow(session, settings, ROOM)
    window.show()
    with qtbot.waitExposed(window):
        pass
    yield window
    for panel in window._panels.values():
        panel.shutdown()
    session.close()
    window._may_close = True
    window.close()


def test_the_live_view_is_whole_on_a_small_screen(qtbot: QtBot, small: MainWindow) -> None:
    assert small.size() == ROOM
    live = small.show_panel("live")
    assert isinstance(live, LivePanel)
    qtbot.wait(100)
    inside = QRect(QPoint(0, 0), ROOM)
    shown: tuple[QWidget, ...] = (
        small.stop_button,
        live.live_button,
        live.light_buttons.buttons()[-1],
        live.form.widgets["exposure_ms"],
        live.picture.view,
        live.record_bar.button,
        live.record_bar.gauge,
    )
    scroll = _scroll_of(live)
    assert scroll.horizontalScrollBar().maximum() == scroll.verticalScrollBar().maximum() == 0
    for widget in shown:
        place = QRect(widget.mapTo(small, QPoint(0, 0)), widget.size())
        assert inside.contains(place), widget
    assert live.picture.view.width() > 400
    assert live.picture.view.height() > 250
    for name in ("live_reconstruction", "stage", "led_array", "slm", "log"):
        panel = small.show_panel(name)
        assert panel.isVisible(), name


def test_nothing_is_cut_off_scrolled_twice_or_nameless_on_a_small_screen(
    qtbot: QtBot, small: MainWindow
) -> None:
    small.resize(SIZES["1366x768"])
    for name in PANELS:
        small.show_panel(name)
        qtbot.wait(50)
        assert not faults(small), name
        if name in ("runs", "films", "reconstructions"):  # there is nothing yet
            seen = [b for b in small.panel(name).findChildren(QPushButton) if b.isVisible()]
            assert not [b.text() for b in seen if not b.isEnabled()], name


def test_every_control_has_a_name_also_those_that_are_made_or_seen_later(
    qtbot: QtBot, small: MainWindow
) -> None:
    for name in PANELS:
        panel = small.show_panel(name)
        if isinstance(panel, SweepsPanel):
            stack, names = panel.views, [routine.name for routine in panel.routines]
        elif isinstance(panel, TasksPanel):
            stack, names = panel.stack, list(TASKS)
        else:
            stack, names = None, []
        for number, each in enumerate(names):
            panel.choice.setCurrentIndex(number)  # type: ignore[attr-defined]
            assert stack is not None
            qtbot.waitUntil(lambda stack=stack, each=each: stack.is_whole(each), timeout=WAIT_MS)  # type: ignore[misc]
        found = sorted(set(nameless(small, hidden=True)))
        assert not found, "\n".join(found)


def test_faults_of_looks_are_found(qtbot: QtBot) -> None:
    page = QWidget()
    qtbot.addWidget(page)
    inside = scrolled(fill(QWidget(), QPushButton("A button with many words"), QLineEdit(), 900))
    said = QLineEdit()
    said.setPlaceholderText("a default in many words " * 3)
    fill(page, scrolled(fill(QWidget(), inside, 900)), label("words " * 40, wraps=True), said)
    inside.setFixedSize(80, 120)
    inside.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAsNeeded)
    page.resize(300, 200)
    page.show()
    found = "\n".join(faults(page))
    for words in (
        "many words'",
        "default in many words",
        "has no name",
        "scrolls up and down within",
        "sideways",
    ):
        assert words in found


def _scroll_of(panel: QWidget) -> QScrollArea:
    around = panel.parent()
    while not isinstance(around, QScrollArea):
        assert around is not None
        around = around.parent()
    return around


def test_a_line_that_is_too_long_says_that_it_goes_on(qtbot: QtBot) -> None:
    words = "Last frame: 14:05:13, 4.715 ms, light: scene, SIMULATED"
    line = label(words, yields=True)
    qtbot.addWidget(line)
    line.resize(120, 20)
    line.show()
    assert QLabel.text(line).endswith("…")
    assert line.text() == line.toolTip() == words, "all of it, for who asks or points at it"
    line.resize(900, 20)
    assert QLabel.text(line) == words
