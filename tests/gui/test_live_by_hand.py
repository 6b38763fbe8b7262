"""What an operator's hands do to the live view: entries that were not submitted, drags, strange disks."""

from __future__ import annotations

import shutil
import threading
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QSplitter
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels.live import LivePanel
from gui.widgets import record_bar
from instrument.files.atomic import free_bytes
from instrument.files.errors import FileError
from instrument.runs.run import Run

WAIT_MS = 60_000
CTRL = Qt.KeyboardModifier.ControlModifier
LEFT = Qt.MouseButton.LeftButton


@pytest.fixture
def live(qtbot: QtBot, window: MainWindow) -> LivePanel:
    panel = window.show_panel("live")
    assert isinstance(panel, LivePanel)
    qtbot.waitUntil(lambda: panel.picture.frame is not None and panel.form.state is not None, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: not window.session.jobs.jobs, timeout=WAIT_MS)
    window.activateWindow()
    return panel


def _type_only(qtbot: QtBot, field: Any, text: str) -> None:
    """Type without Enter, the keyboard left in the field."""
    field.setFocus()
    field.selectAll()
    qtbot.keyClicks(field, text)


def test_a_recording_takes_the_length_that_is_still_being_typed(qtbot: QtBot, live: LivePanel) -> None:
    finished: list[Path] = []
    live.session.run_finished.connect(finished.append)
    _type_only(qtbot, live.record_bar.seconds, "0.2")
    qtbot.keyClick(live.record_bar.seconds, Qt.Key.Key_R, CTRL)
    qtbot.waitUntil(lambda: bool(finished), timeout=WAIT_MS)
    assert live.record_bar.seconds.value == 0.2
    run = Run.open(finished[0])
    first, last = run.metadata(min(run.records)), run.metadata(max(run.records))
    seconds = (last.device_time_ns - first.device_time_ns) / 1e9
    assert seconds < 2, "the ten seconds of before"


@pytest.mark.parametrize("by_mouse", [False, True])
def test_a_wrong_length_is_refused_and_nothing_is_recorded(
    qtbot: QtBot, live: LivePanel, by_mouse: bool
) -> None:
    _type_only(qtbot, live.record_bar.seconds, "-1")
    if by_mouse:
        qtbot.mouseClick(live.record_bar.button, LEFT)
    else:
        qtbot.keyClick(live.record_bar.seconds, Qt.Key.Key_R, CTRL)
    assert live.record_bar.job is None
    assert live.record_bar.seconds.property("refused")
    assert "-1" in live._note.text()
    qtbot.mouseClick(live.record_bar.button, LEFT)  # again: it is still wrong
    assert live.record_bar.job is None


def test_a_recording_is_ended_by_its_key_whatever_number_is_wrong(qtbot: QtBot, live: LivePanel) -> None:
    finished: list[Path] = []
    live.session.run_finished.connect(finished.append)
    _type_only(qtbot, live.record_bar.seconds, "600")
    qtbot.keyClick(live.record_bar.seconds, Qt.Key.Key_R, CTRL)
    qtbot.waitUntil(lambda: "frames" in live.record_bar.note.text(), timeout=WAIT_MS)
    _type_only(qtbot, live.average, "0")
    qtbot.keyClick(live.average, Qt.Key.Key_R, CTRL)
    qtbot.waitUntil(lambda: bool(finished), timeout=WAIT_MS)
    assert live.average.text() == "0"


def test_a_photograph_waits_for_the_exposure_that_is_still_being_typed(qtbot: QtBot, live: LivePanel) -> None:
    _type_only(qtbot, live.form.widgets["exposure_ms"], "7.5")
    qtbot.keyClick(live.form.widgets["exposure_ms"], Qt.Key.Key_K, CTRL)
    qtbot.waitUntil(lambda: live.photograph is not None, timeout=WAIT_MS)
    assert live.session.bench.newest_frame is not None
    assert live.session.bench.newest_frame.metadata.exposure_ms == 7.5
    _type_only(qtbot, live.average, "0")
    live.photograph = None
    qtbot.keyClick(live.average, Qt.Key.Key_K, CTRL)
    qtbot.mouseClick(live.snap_button, LEFT)
    assert live.average.property("refused")
    assert "Photograph" not in [job.title for job in live.session.jobs.jobs]  # settings may be being read
    assert live.photograph is None
    assert "0 frames is outside" in live._note.toolTip()
    _type_only(qtbot, live.form.widgets["exposure_ms"], "8")  # another field is mended
    qtbot.keyClick(live.form.widgets["exposure_ms"], Qt.Key.Key_Return)
    assert live._note.text()
    _type_only(qtbot, live.average, "1")
    qtbot.keyClick(live.average, Qt.Key.Key_Return)
    assert not live._note.text(), "errors go when their cause goes"


def test_a_region_is_drawn_with_the_mouse(qtbot: QtBot, window: MainWindow, live: LivePanel) -> None:
    qtbot.mouseClick(live.picture.region_button, LEFT)
    qtbot.wait(100)  # a layout that settles moves it, too
    before = live.picture.view.box.viewRange()
    graphics = live.picture.view.graphics

    def at(column: float, row: float) -> QPoint:
        place = graphics.mapFromScene(live.picture.view.box.mapViewToScene(QPointF(column, row)))
        return graphics.viewport().mapTo(window, place)

    handle = window.windowHandle()
    start, end = (20.0, 30.0), (60.0, 50.0)  # begins outside of the box in the middle
    QTest.mousePress(handle, LEFT, Qt.KeyboardModifier.NoModifier, at(*start))
    for share in (0.3, 0.7, 1.0):
        QTest.mouseMove(handle, at(*(a + share * (b - a) for a, b in zip(start, end, strict=True))))
        qtbot.wait(30)
    QTest.mouseRelease(handle, LEFT, Qt.KeyboardModifier.NoModifier, at(*end))
    assert live.picture.view.box.viewRange() == before, "the picture was moved instead"
    rectangle = live.picture.region_box.rectangle
    assert rectangle is not None
    assert rectangle == pytest.approx((20, 30, 40, 20), abs=1.0)
    qtbot.mouseClick(live.picture.region_button, LEFT)
    assert live.picture.view.drag_taker is None


def test_a_long_line_of_figures_does_not_move_the_picture(qtbot: QtBot, live: LivePanel) -> None:
    (split,) = live.body.findChildren(QSplitter)
    before, narrowest = split.sizes(), live.minimumSizeHint().width()
    live.status.setText("figures " * 60)
    qtbot.wait(50)
    assert split.sizes() == before
    assert live.minimumSizeHint().width() == narrowest


def test_what_is_under_the_mouse_is_of_the_frame_that_is_shown(qtbot: QtBot, live: LivePanel) -> None:
    live.under_mouse.setText("x 319  y 239  value 4095")  # the mouse has gone since
    shown = live.picture.frame
    qtbot.waitUntil(lambda: live.picture.frame is not shown, timeout=WAIT_MS)
    assert live.under_mouse.text() == ""


def test_a_recording_does_not_begin_with_the_photograph_of_before(qtbot: QtBot, live: LivePanel) -> None:
    qtbot.mouseClick(live.snap_button, LEFT)
    qtbot.waitUntil(lambda: live.photograph is not None, timeout=WAIT_MS)
    photograph = live.session.bench.newest_frame
    assert photograph is not None
    seen: list[object] = []
    live.session.exclusive_job("a run", lambda _: seen.append(live.session.live.newest()))
    qtbot.waitUntil(lambda: bool(seen), timeout=WAIT_MS)
    assert seen == [None]


_Usage = namedtuple("_Usage", "total used free")


def _ask_the_disk(qtbot: QtBot, live: LivePanel) -> None:
    bar = live.record_bar
    qtbot.waitUntil(lambda: not bar._reader.is_reading, timeout=WAIT_MS)
    bar._look_at_disk()
    qtbot.waitUntil(lambda: not bar._reader.is_reading, timeout=WAIT_MS)


@pytest.mark.parametrize("answer", [_Usage(0, 0, 0), OSError(5, "Input/output error")])
def test_a_disk_that_tells_no_size_takes_nothing_but_the_gauge(
    qtbot: QtBot, live: LivePanel, monkeypatch: pytest.MonkeyPatch, answer: Any
) -> None:
    def usage(_: Path) -> _Usage:
        if isinstance(answer, OSError):
            raise answer
        return answer

    monkeypatch.setattr(shutil, "disk_usage", usage)
    _ask_the_disk(qtbot, live)
    assert live.record_bar.gauge.format() == "disk not known"


def test_a_folder_whose_disk_was_taken_away_takes_nothing_but_the_gauge(
    qtbot: QtBot, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    def exists(_: Path) -> bool:
        raise OSError(107, "Transport endpoint is not connected")

    monkeypatch.setattr(Path, "exists", exists)
    _ask_the_disk(qtbot, live)
    assert live.record_bar.gauge.format() == "disk not known"


def test_a_server_that_is_silent_holds_up_nothing_but_the_gauge(
    qtbot: QtBot, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    bar = live.record_bar
    qtbot.waitUntil(lambda: not bar._reader.is_reading, timeout=WAIT_MS)
    answered = threading.Event()
    asked: list[Path] = []

    def usage(path: Path) -> _Usage:
        asked.append(path)
        answered.wait(WAIT_MS / 1000)
        return _Usage(100, 50, 50)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    monkeypatch.setattr(record_bar, "_SILENT_S", 0.0)
    bar._look_at_disk()
    qtbot.waitUntil(lambda: bool(asked), timeout=WAIT_MS)
    bar._look_at_disk()  # the timer's next turn: asks no second time
    assert bar.gauge.format() == "disk not known"
    assert "not answered" in bar.gauge.toolTip()
    assert len(asked) == 1
    answered.set()
    qtbot.waitUntil(lambda: bar.gauge.format() == "50 bytes free", timeout=WAIT_MS)


def test_a_path_of_which_nothing_is_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "exists", lambda _: False)  # a drive that is not connected
    with pytest.raises(FileError, match="not even its disk"):
        free_bytes(Path("somewhere/else"))


def test_what_auto_could_not_do_is_over_with_another_exposure(qtbot: QtBot, live: LivePanel) -> None:
    auto = live.form.auto_button
    tip = auto.toolTip()
    for _ in range(2):  # the tip that comes back is its own
        live.refused(auto, "It is too dark.")
    assert auto.property("refused")
    assert auto.toolTip() in live._note.text()
    _type_only(qtbot, live.form.widgets["exposure_ms"], "7")
    qtbot.keyClick(live.form.widgets["exposure_ms"], Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: not auto.property("refused"), timeout=WAIT_MS)
    assert live.session.bench.camera.exposure_ms == 7
    assert (auto.toolTip(), live._note.text()) == (tip, "")


def test_what_needs_a_device_that_was_lost_cannot_be_pressed_and_says_why(
    qtbot: QtBot, live: LivePanel
) -> None:
    session, bar = live.session, live.record_bar
    buttons = live.live_button, live.snap_button, bar.button
    tips = [each.toolTip() for each in buttons]
    session.bench.shared["simulated"].unplug("camera")  # type: ignore[attr-defined]
    qtbot.waitUntil(lambda: session.state("camera").condition == "failed", timeout=WAIT_MS)
    for each, tip in zip(buttons, tips, strict=True):
        assert not each.isEnabled()
        assert each.toolTip().startswith(tip)
        assert "unplugged" in each.toolTip()
    for key in (Qt.Key.Key_K, Qt.Key.Key_R, Qt.Key.Key_L):
        live.accepted()
        qtbot.keyClick(live, key, CTRL)
        assert "unplugged" in live._note.toolTip(), "by its key it is refused in words"
    assert session.viewing.wanted
    session.bench.shared["simulated"].plug_in("camera")  # type: ignore[attr-defined]
    session.reconnect("camera")
    qtbot.waitUntil(lambda: session.is_open("camera"), timeout=WAIT_MS)
    assert [each.toolTip() for each in buttons] == tips
    assert all(each.isEnabled() for each in buttons)
    assert not live._note.text()


def test_without_the_point_source_nothing_is_lit_but_the_scene_is_darkened(
    qtbot: QtBot, live: LivePanel
) -> None:
    session = live.session
    lights = {each.text(): each for each in live.light_buttons.buttons()}
    qtbot.waitUntil(lambda: session.bench.scene_lit, timeout=WAIT_MS)
    session.bench.shared["simulated"].unplug("led_array")  # type: ignore[attr-defined]
    qtbot.mouseClick(lights["Source"], LEFT)
    qtbot.waitUntil(lambda: session.state("led_array").condition == "failed", timeout=WAIT_MS)
    for words in ("Scene", "Source"):
        assert not lights[words].isEnabled()
        assert "unplugged" in lights[words].toolTip()
    assert session.bench.scene_lit
    qtbot.mouseClick(lights["Dark"], LEFT)
    qtbot.waitUntil(lambda: not session.bench.scene_lit, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: "LED array" in live._note.text(), timeout=WAIT_MS)
    session.bench.shared["simulated"].plug_in("led_array")  # type: ignore[attr-defined]
    session.reconnect("led_array")
    qtbot.waitUntil(lights["Source"].isEnabled, timeout=WAIT_MS)
    assert lights["Source"].toolTip() == "Light the point source"
    assert not live._note.text(), "its cause is gone"


def test_arrow_keys_leave_region_and_line_in_the_picture(qtbot: QtBot, live: LivePanel) -> None:
    assert live.picture.view.image is not None
    height, width = live.picture.view.image.shape[:2]
    box, line = live.picture.region_box, live.picture.profile_line
    qtbot.mouseClick(live.picture.region_button, LEFT)
    for _ in range(width // 10):
        box.step(-1, 1, size_only=False)
    assert box.rectangle == pytest.approx((0, height / 2, width / 2, height / 2))
    for _ in range(width // 10):
        box.step(1, 1, size_only=True)
    assert box.rectangle == pytest.approx((0, height / 2, width, height / 2))
    qtbot.mouseClick(live.picture.profile_button, LEFT)
    for _ in range(width // 10):
        line.step(1, -1, end_only=False)
    assert line.ends is not None
    (x0, y0), (x1, y1) = line.ends
    assert (x1, y0, y1) == pytest.approx((width, 0, 0))
    assert x0 == pytest.approx(0.2 * width)


def test_a_region_that_the_camera_rounds_is_told(qtbot: QtBot, live: LivePanel) -> None:
    said: list[str] = []
    live.session.logged.connect(lambda _, words: said.append(words))
    field = live.form.widgets["roi"]
    _type_only(qtbot, field, "10, 20, 100, 150")
    qtbot.keyClick(field, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: field.text() == "12, 20, 96, 148", timeout=WAIT_MS)
    assert "The camera reads region 12, 20, 96, 148; 10, 20, 100, 150 was asked for." in said


def test_slow_frames_have_their_time_told_and_no_rate_of_two_seconds(live: LivePanel) -> None:
    frame = live.picture.frame
    assert frame is not None
    assert "camera" in live._figures(frame)
    slow = replace(frame, metadata=replace(frame.metadata, exposure_ms=4000.0))
    assert "4.0 s a frame" in live._figures(slow)
    assert "/s" not in live._figures(slow)
