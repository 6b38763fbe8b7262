"""LED array and holograms in an operator's hands: brightness of what is lit, wrong entries."""

from __future__ import annotations

import pytest
from PySide6.QtCore import Qt
from pytestqt.qtbot import QtBot

from drivers.led_array import LedPattern
from gui.main_window import MainWindow
from gui.panels.holograms import HologramsPanel
from gui.panels.led_array import LedPanel
from gui.panels.live_reconstruction import LiveReconstructionPanel

WAIT_MS = 60_000
LEFT = Qt.MouseButton.LeftButton


@pytest.fixture
def leds(qtbot: QtBot, window: MainWindow) -> LedPanel:
    panel = window.show_panel("led_array")
    assert isinstance(panel, LedPanel)
    qtbot.waitUntil(lambda: panel._drawn is not None, timeout=WAIT_MS)
    return panel


def test_the_slider_dims_what_is_lit_each_led_in_its_colour_and_lights_nothing(
    qtbot: QtBot, window: MainWindow, leds: LedPanel
) -> None:
    array = window.session.bench.led_array
    assert array is not None
    leds.brightness.setFocus()
    qtbot.keyClick(leds.brightness, Qt.Key.Key_PageDown)
    qtbot.waitUntil(lambda: not leds._rest.isActive(), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: not window.session.jobs.device_jobs, timeout=WAIT_MS)
    assert array.pattern.is_dark
    for led, colour in (("3", "red"), ("7", "blue")):
        leds.colour.setCurrentText(colour)
        leds.index.setFocus()
        leds.index.selectAll()
        qtbot.keyClicks(leds.index, led)
        qtbot.keyClick(leds.index, Qt.Key.Key_Return)
        qtbot.waitUntil(lambda led=led: int(led) in dict(array.pattern.levels), timeout=WAIT_MS)
    leds.brightness.setFocus()
    qtbot.keyClick(leds.brightness, Qt.Key.Key_Home)  # the faintest
    qtbot.waitUntil(lambda: dict(array.pattern.levels) == {3: (1, 0, 0), 7: (0, 0, 1)}, timeout=WAIT_MS)
    qtbot.keyClick(leds.brightness, Qt.Key.Key_End)
    qtbot.waitUntil(lambda: dict(array.pattern.levels) == {3: (255, 0, 0), 7: (0, 0, 255)}, timeout=WAIT_MS)
    assert array.pattern.description == "LED 3, 7 at 255 of 255"


def test_a_hue_that_was_dimmed_to_the_faintest_comes_back(
    qtbot: QtBot, window: MainWindow, leds: LedPanel
) -> None:
    array = window.session.bench.led_array
    assert array is not None
    window.session.jobs.device(
        "orange", lambda _: array.set_pattern(LedPattern("LED 3", ((3, (250, 120, 10)),))), {"led_array"}
    )
    qtbot.waitUntil(lambda: dict(array.pattern.levels) == {3: (250, 120, 10)}, timeout=WAIT_MS)
    leds.brightness.setFocus()
    qtbot.keyClick(leds.brightness, Qt.Key.Key_Home)
    qtbot.waitUntil(lambda: max(dict(array.pattern.levels)[3]) == 1, timeout=WAIT_MS)
    leds.brightness.setValue(250)
    qtbot.waitUntil(lambda: dict(array.pattern.levels) == {3: (250, 120, 10)}, timeout=WAIT_MS)


def test_a_pattern_is_not_lit_with_an_aperture_that_makes_no_sense(
    qtbot: QtBot, window: MainWindow, leds: LedPanel
) -> None:
    leds.na.setFocus()
    leds.na.selectAll()
    qtbot.keyClicks(leds.na, "7")
    qtbot.mouseClick(leds.pattern_buttons["Bright field"], LEFT)
    assert leds.na.property("refused")
    array = window.session.bench.led_array
    assert array is not None
    qtbot.waitUntil(lambda: not window.session.jobs.is_busy("led_array"), timeout=WAIT_MS)
    assert array.pattern.is_dark


def test_the_light_goes_off_whatever_stands_in_the_field_of_the_aperture(
    qtbot: QtBot, window: MainWindow, leds: LedPanel
) -> None:
    array = window.session.bench.led_array
    assert array is not None
    qtbot.mouseClick(leds.pattern_buttons["Bright field"], LEFT)
    qtbot.waitUntil(lambda: not array.pattern.is_dark, timeout=WAIT_MS)
    leds.na.setFocus()
    leds.na.selectAll()
    qtbot.keyClicks(leds.na, "7")
    qtbot.mouseClick(leds.pattern_buttons["Off"], LEFT)
    qtbot.waitUntil(lambda: array.pattern.is_dark, timeout=WAIT_MS)


def test_brightness_that_was_pulled_before_stop_is_not_sent_after_it(
    qtbot: QtBot, window: MainWindow, leds: LedPanel
) -> None:
    leds._rest.setInterval(WAIT_MS)
    leds.brightness.setValue(100)
    assert leds._rest.isActive()
    with qtbot.waitSignal(window.session.stopped, timeout=WAIT_MS):
        qtbot.mouseClick(window.stop_button, LEFT)
    assert not leds._rest.isActive()


def test_an_expansion_that_is_no_square_is_refused_at_its_field(qtbot: QtBot, window: MainWindow) -> None:
    panel = window.show_panel("holograms")
    assert isinstance(panel, HologramsPanel)
    expansion = panel.form.widgets["expansion"]
    expansion.setFocus()
    qtbot.keyClicks(expansion, "7")
    qtbot.keyClick(expansion, Qt.Key.Key_Tab)
    expansion.submit()
    assert expansion.property("refused")
    assert "must be a square" in expansion.toolTip()


def test_a_calibration_that_cannot_be_loaded_leaves_words_for_what_to_do(
    qtbot: QtBot, window: MainWindow
) -> None:
    panel = window.show_panel("live_reconstruction")
    assert isinstance(panel, LiveReconstructionPanel)
    before = panel.status.text()
    assert "Sweeps panel" in before
    panel.file.setFocus()
    qtbot.keyClicks(panel.file, "/nowhere")
    qtbot.keyClick(panel.file, Qt.Key.Key_Return)
    assert panel.status.text() == "Loading /nowhere …"
    qtbot.waitUntil(lambda: bool(panel.file.property("refused")), timeout=WAIT_MS)
    assert panel.status.text() == before
