"""The theme for the dark room: no light but red, anywhere, and what is written before keeps its meaning."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QImage
from PySide6.QtWidgets import QWidget
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels import PANELS
from gui.panels.log import LogPanel
from gui.theme import DARK, RED, as_shown, change_theme, colours
from gui.widgets.building import fill
from gui.widgets.image_view import ImageView
from gui.widgets.plots import plot_widget

WAIT_MS = 60_000
_MOST_OTHER = 130
"""Levels of green and blue that antialiased, pale red marks may have: the mark of saturation has 120."""


def _not_red(window: MainWindow) -> float:
    """Return the share of the window's pixels that shine in green or blue."""
    picture = window.grab().toImage().convertToFormat(QImage.Format.Format_RGB888)
    width, height = picture.width(), picture.height()
    rows = np.frombuffer(picture.constBits(), np.uint8).reshape(height, picture.bytesPerLine())
    pixels = rows[:, : 3 * width].reshape(height, width, 3)
    return float((pixels[..., 1:].max(axis=2) > _MOST_OTHER).mean())


@pytest.fixture
def red_window(qtbot: QtBot, window: MainWindow) -> Iterator[MainWindow]:
    window.resize(1280, 900)
    qtbot.waitUntil(lambda: window.session.live.newest() is not None, timeout=WAIT_MS)
    for name in PANELS:
        window.show_panel(name)
        qtbot.wait(30)
    for n, view in enumerate(window.findChildren(ImageView)):  # white pictures, made under the other theme
        view.show_image(np.full((40, 60) if n % 2 else (40, 60, 3), 200, np.uint8), 0, 200)
    qtbot.keyClick(
        window, Qt.Key.Key_2, Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
    )
    assert colours() is RED
    qtbot.waitUntil(lambda: not window.is_restyling, timeout=WAIT_MS)
    yield window
    window.set_theme("dark")


def test_every_panel_is_red_also_what_was_there_before(qtbot: QtBot, red_window: MainWindow) -> None:
    views = red_window.findChildren(ImageView)
    assert len(views) >= 8
    assert {view.colour_map for view in views} == {"red"}
    for name in PANELS:
        red_window.show_panel(name)
        qtbot.wait(30)
        assert _not_red(red_window) < 2e-3, name


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_a_coloured_picture_is_shown_by_its_brightness_in_the_red_map(qtbot: QtBot, dtype: type) -> None:
    picture = np.zeros((40, 60, 3), dtype)
    picture[:, :20, 1] = 120
    picture[:, 20:40] = 120
    picture[0, 0, 2] = 255  # one channel of one pixel is saturated
    view = ImageView("grey")
    qtbot.addWidget(view)
    view.show_image(picture, 0, 200, 255)
    assert view.item.image.shape == (40, 60, 3)
    view.set_colour_map("red")
    places = view.item.image
    assert places.ndim == 2
    assert int(places[20, 30]) == pytest.approx(3 * int(places[20, 10]), abs=2)
    assert places[20, 50] == 0
    assert places[0, 0] == 255
    red = as_shown(picture, 0, 200, "red")
    assert red.shape == (40, 60, 3)
    assert red[20, 30, 0] > red[20, 10, 0] > 0
    assert not red[..., 1:].any()
    assert (as_shown(picture, 0, 120, "grey")[20, 10] == (0, 255, 0)).all()
    view.set_colour_map("grey")
    assert view.item.image.shape == (40, 60, 3)


def test_a_theme_chosen_twice_in_haste_reaches_every_plot(qtbot: QtBot) -> None:
    part, plot = QWidget(), plot_widget()
    window = fill(QWidget(), fill(part, plot))
    qtbot.addWidget(window)
    window.show()
    try:
        hasty = change_theme("red", window, [part])
        while not part.styleSheet():
            next(hasty)
        hasty.close()  # as when the key repeats itself
        list(change_theme("red", window, [part]))
        assert plot.backgroundBrush().color() == QColor(RED.panel)
    finally:
        list(change_theme("dark", window, [part]))


def test_a_line_of_the_log_keeps_what_its_colour_says(qtbot: QtBot, window: MainWindow) -> None:
    window.panel("live")
    log = window.panel("log")
    assert isinstance(log, LogPanel)
    window.session.log("info", "a line of before")
    window.session.log("error", "a mistake of before")
    window.set_theme("red")
    qtbot.waitUntil(lambda: not window.is_restyling, timeout=WAIT_MS)

    def colour(text: str) -> QColor:
        block = log.view.document().begin()
        while block.isValid():
            if text in block.text():
                fragments = [f.fragment() for f in block]
                return fragments[-1].charFormat().foreground().color()
            block = block.next()
        raise AssertionError(text)

    assert colour("a line of before") == QColor(RED.text)
    assert colour("a mistake of before") == QColor(RED.error)
    window.set_theme("dark")
    qtbot.waitUntil(lambda: not window.is_restyling, timeout=WAIT_MS)
    assert colour("a line of before") == QColor(DARK.text)
    assert {view.colour_map for view in window.findChildren(ImageView)} == {"grey"}


def test_the_red_theme_emits_no_green_or_blue_to_speak_of() -> None:
    theme = RED
    for field in theme.__slots__:
        value = getattr(theme, field)
        if isinstance(value, bool):
            continue
        for colour in (value,) if isinstance(value, str) else value:
            if colour.startswith("#"):
                red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
                assert max(green, blue) <= 0.55 * red, (field, colour)
