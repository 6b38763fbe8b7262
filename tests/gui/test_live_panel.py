"""The live view: frames, saturation, settings, region, photographs, recordings."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor
from PySide6.QtWidgets import QComboBox, QLineEdit
from pytestqt.qtbot import QtBot

from drivers.camera import Roi
from drivers.device import OwnSetting
from drivers.errors import DeviceError, LimitError
from gui.main_window import MainWindow
from gui.panel import whole
from gui.panels.live import LivePanel
from gui.panels.runs import RunsPanel
from gui.session import BenchSession
from gui.widgets.device_settings import DeviceSettings
from gui.widgets.image_view import ImageView
from instrument.bench.lit import LightState
from instrument.files.errors import BenchError
from instrument.files.images import read_image
from instrument.live.frame_view import FrameFigures, not_stretched
from instrument.plan.led_shapes import BrightField
from instrument.runs.recorder import RecordingStatus, record
from instrument.runs.run import Run, RunCondition

WAIT_MS = 60_000


@pytest.fixture
def live(qtbot: QtBot, window: MainWindow) -> LivePanel:
    panel = window.show_panel("live")
    assert isinstance(panel, LivePanel)
    qtbot.waitUntil(lambda: panel.picture.frame is not None and panel.form.state is not None, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: not window.session.jobs.jobs, timeout=WAIT_MS)
    return panel


def _type(qtbot: QtBot, field: object, text: str) -> None:
    field.setFocus()  # type: ignore[attr-defined]
    field.selectAll()  # type: ignore[attr-defined]
    qtbot.keyClicks(field, text)
    qtbot.keyClick(field, Qt.Key.Key_Return)


def test_the_scene_is_lit_before_the_first_frame(
    qtbot: QtBot, make_session: Callable[[], BenchSession], monkeypatch: pytest.MonkeyPatch
) -> None:
    session = make_session()
    monkeypatch.setattr(session.live, "newest", lambda: None)  # a sensor of megapixels
    panel = whole(LivePanel(session))
    qtbot.addWidget(panel, before_close_func=lambda p: p.shutdown())
    panel.show()
    with qtbot.waitSignal(session.opened, timeout=WAIT_MS):
        session.open()
    qtbot.waitUntil(lambda: session.bench.scene_lit, timeout=WAIT_MS)
    session.viewing.hold()
    session.switch_light(LightState.DARK)
    qtbot.waitUntil(lambda: not session.bench.scene_lit, timeout=WAIT_MS)
    qtbot.wait(100)
    assert not session.bench.scene_lit, "to begin with, and never again by itself"


def test_no_dark_frame_is_the_picture_that_others_wait_for_and_a_busy_light_is_asked_for_again(
    qtbot: QtBot, make_session: Callable[[], BenchSession]
) -> None:
    session = make_session()
    held = threading.Event()
    pictured: list[bool] = []
    session.pictured.connect(lambda: pictured.append(session.bench.scene_lit))
    session.opened.connect(
        lambda: session.jobs.device("Light held", lambda _: held.wait(WAIT_MS / 1e3), {"light"}, endless=True)
    )
    panel = whole(LivePanel(session))
    qtbot.addWidget(panel, before_close_func=lambda p: p.shutdown())
    panel.show()
    with qtbot.waitSignal(session.opened, timeout=WAIT_MS):
        session.open()
    qtbot.waitUntil(lambda: len(panel._shown_at) > 1, timeout=WAIT_MS)
    assert not pictured
    assert not panel._note.text(), "nobody asked for the light: nothing is refused"
    held.set()
    qtbot.waitUntil(lambda: bool(pictured), timeout=WAIT_MS)
    assert pictured == [True]


def test_after_stop_nothing_is_lit_to_begin_with(
    qtbot: QtBot, make_session: Callable[[], BenchSession]
) -> None:
    session = make_session()
    panel = whole(LivePanel(session))
    qtbot.addWidget(panel, before_close_func=lambda p: p.shutdown())
    with qtbot.waitSignal(session.opened, timeout=WAIT_MS):
        session.open()
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        session.stop()
    with qtbot.waitSignal(session.pictured, timeout=WAIT_MS):
        panel.show()
    assert not session.bench.scene_lit


def test_it_opens_running_with_the_scene_lit(qtbot: QtBot, live: LivePanel) -> None:
    qtbot.waitUntil(lambda: live.session.bench.scene_lit, timeout=WAIT_MS)
    shown = live.picture.frame
    qtbot.waitUntil(lambda: live.picture.frame is not shown, timeout=WAIT_MS)
    qtbot.waitUntil(
        lambda: "camera" in live.status.text() and "dropped 0" in live.status.text(), timeout=WAIT_MS
    )
    qtbot.waitUntil(lambda: float(live.picture.frame.image.mean()) > 50, timeout=WAIT_MS)  # type: ignore[union-attr]


def test_the_picture_says_when_it_was_taken_in_what_light_and_when_it_is_old(
    qtbot: QtBot, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = live.picture.view
    qtbot.waitUntil(lambda: "light: scene" in view.caption, timeout=WAIT_MS)
    assert view.caption.endswith("SIMULATED")
    assert re.match(r"\d\d:\d\d:\d\d, 10 ms", view.caption)
    live.switch_light(LightState.SOURCE)
    qtbot.waitUntil(lambda: view.caption.endswith("light: point source, SIMULATED"), timeout=WAIT_MS)
    monkeypatch.setattr("gui.panels.live._PATIENCE_S", 0.0)
    live.toggle_live()
    qtbot.waitUntil(lambda: view.caution.startswith("Held for"), timeout=WAIT_MS)
    live.session.viewing.wanted = True  # as while the camera is lost
    live.count()
    assert view.caution.startswith("Old picture")
    assert view.item.opacity() < 0.5
    live.session.viewing.start()
    qtbot.waitUntil(lambda: not view.caution and view.item.opacity() == 1.0, timeout=WAIT_MS)


def test_a_view_that_did_not_start_says_why_and_is_tried_again(
    qtbot: QtBot, window: MainWindow, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, camera = live.session, live.session.bench.camera
    monkeypatch.setattr("gui.live_upkeep._AGAIN_S", 0.02)  # which holding it begins anew with
    with qtbot.waitSignal(session.jobs.job_ended, timeout=WAIT_MS):
        session.viewing.hold()

    tries: list[int] = []

    def busy(frames: int = 8) -> None:
        tries.append(frames)
        raise LimitError(camera.name, "is busy.", "Wait for its other user.")

    logged: list[str] = []
    session.logged.connect(lambda _, text: logged.append(text))
    start = camera.start_sequence
    monkeypatch.setattr(camera, "start_sequence", busy)
    session.viewing.start()
    qtbot.waitUntil(lambda: len(tries) >= 3 and not session.jobs.is_busy("camera"), timeout=WAIT_MS)
    qtbot.waitUntil(live.again_button.isVisible, timeout=WAIT_MS)
    assert "is busy" in live.status.text()
    assert sum("is busy" in text for text in logged) == 1, "told once"
    window.strip.look()
    assert "is busy" in window.strip.words.text()
    assert window.strip.button.text() == "Try again now"
    session.viewing._again.stop()
    monkeypatch.setattr(camera, "start_sequence", start)
    qtbot.mouseClick(window.strip.button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: session.live.is_running, timeout=WAIT_MS)
    qtbot.waitUntil(live.again_button.isHidden, timeout=WAIT_MS)
    assert not session.viewing.failure


def test_a_reason_goes_with_the_camera(
    qtbot: QtBot, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera that was lost is connected again, not tried again."""
    session, camera = live.session, live.session.bench.camera
    with qtbot.waitSignal(session.jobs.job_ended, timeout=WAIT_MS):
        session.viewing.hold()

    def busy(_: int = 8) -> None:
        raise LimitError(camera.name, "is busy.", "Wait for its other user.")

    monkeypatch.setattr(camera, "start_sequence", busy)
    session.viewing.start()
    qtbot.waitUntil(live.again_button.isVisible, timeout=WAIT_MS)
    session.note_failure(DeviceError(camera.name, "was unplugged."), surely=True, was_used=True)
    assert session.state("camera").condition == "failed"
    live.count()
    assert live.again_button.isHidden()
    assert not session.viewing.failure
    assert not session.viewing._again.isActive()


def test_what_comes_is_shown_coarsely_first_and_says_so(
    qtbot: QtBot, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, camera = live.picture.view, live.session.live
    frame = live.picture.frame
    assert frame is not None
    monkeypatch.setattr(camera, "newest", lambda: frame)
    coarse = np.full((30, 40), 3000, np.uint16)
    monkeypatch.setattr(camera, "coarse", lambda: (coarse, 8))
    qtbot.waitUntil(lambda: live.picture.is_coarse, timeout=WAIT_MS)
    assert view.caution.startswith("Coarse for now: 8 × 8 pixels are one")
    assert view.image is coarse
    assert view.extent == (frame.image.shape[1], frame.image.shape[0])
    assert "value 3000" in view.describe(frame.image.shape[1] - 1, frame.image.shape[0] - 1)
    live.count()
    live.picture.stretch.setCurrentText("full range")
    assert live.picture.is_coarse  # and not the frame before under its words
    assert view.caution.startswith("Coarse for now")
    monkeypatch.undo()
    qtbot.waitUntil(lambda: not live.picture.is_coarse and not view.caution, timeout=WAIT_MS)
    assert view.caption.endswith("SIMULATED")


@pytest.mark.parametrize(
    ("mode", "words"), [("software", "program's trigger"), ("hardware", "pulse on Line1")]
)
def test_a_camera_that_waits_for_triggers_says_so_and_not_that_light_is_computed(
    live: LivePanel, monkeypatch: pytest.MonkeyPatch, mode: str, words: str
) -> None:
    state = live.form.state
    assert state is not None
    live.form.state = replace(state, trigger_mode=mode)
    monkeypatch.setattr(live, "_came_s", time.monotonic() - 10)
    assert live._waits()
    assert f"each {words} takes one" in live.status.text()
    assert "computed" not in live.status.text()


def test_exposure_typed_reaches_the_camera_and_is_read_back(qtbot: QtBot, live: LivePanel) -> None:
    _type(qtbot, live.form.widgets["exposure_ms"], "3.21 ms")
    qtbot.waitUntil(lambda: live.session.bench.camera.exposure_ms == 3.21, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: live.form.widgets["exposure_ms"].text() == "3.21 ms", timeout=WAIT_MS)
    assert live.session.live.is_running


def test_auto_finds_the_exposure_and_the_figures_beside_the_histogram_say_what_is_there(
    qtbot: QtBot, live: LivePanel
) -> None:
    live.switch_light(LightState.SCENE)
    qtbot.waitUntil(lambda: "light: scene" in live.picture.view.caption, timeout=WAIT_MS)
    before = live.session.bench.camera.exposure_ms
    qtbot.mouseClick(live.form.auto_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(live.form.auto_button.isEnabled, timeout=WAIT_MS)
    exposure_ms = live.session.bench.camera.exposure_ms
    assert exposure_ms != before
    assert live.form.widgets["exposure_ms"].text().startswith(f"{exposure_ms:.4g}")
    qtbot.waitUntil(lambda: live.picture.frame.metadata.exposure_ms == exposure_ms, timeout=WAIT_MS)  # type: ignore[union-attr]
    live.count()
    figures = live.picture.histogram.range.figures
    assert figures is not None
    assert 0.6 < figures.share < 1
    assert f"max {figures.largest}" in live.picture.histogram.range.words.text()
    live.picture.frame = live.picture._measured = None
    counts = np.zeros(65536, np.float32)
    counts[[100, 1600]] = 5, 1
    figures = FrameFigures.of(counts, 65535)
    assert (figures.largest, figures.mean, figures.span) == (1600, 350.0, (0, 2047))
    assert not_stretched((100.0, 120.0), 65535)[1] > 4000, "noise in the dark looks dark"
    counts[65535] = 2
    live.picture.histogram.show_counts(counts, FrameFigures.of(counts, 65535), 0, 1)
    assert "SATURATED 25 % of pixels" in live.picture.histogram.range.words.text()
    assert live.picture.histogram.range.words.property("warns") == "error"


def test_a_wrong_exposure_is_refused_at_the_field(qtbot: QtBot, live: LivePanel) -> None:
    before = live.session.bench.camera.exposure_ms
    _type(qtbot, live.form.widgets["exposure_ms"], "1e9")
    assert live.form.widgets["exposure_ms"].property("refused")
    assert "outside" in live.form.widgets["exposure_ms"].toolTip()
    assert "outside" in live._note.text()
    assert live.form.widgets["exposure_ms"].text() == "1e9"
    assert live.session.bench.camera.exposure_ms == before
    _type(qtbot, live.form.widgets["exposure_ms"], "2.5")
    qtbot.waitUntil(lambda: live.session.bench.camera.exposure_ms == 2.5, timeout=WAIT_MS)
    assert not live.form.widgets["exposure_ms"].property("refused")


def test_trigger_line_and_edge_are_chosen_from_what_the_camera_has(qtbot: QtBot, live: LivePanel) -> None:
    widgets = live.form.widgets
    shown = [widgets["trigger_mode"].itemText(n) for n in range(3)]
    assert shown == ["none (free_run)", "program (software)", "pulse (hardware)"]
    assert not widgets["trigger_edge"].isVisibleTo(live)
    widgets["trigger_mode"].setCurrentIndex(2)
    qtbot.waitUntil(lambda: live.form.state.trigger_mode == "hardware", timeout=WAIT_MS)
    assert widgets["trigger_edge"].isVisibleTo(live)
    widgets["trigger_edge"].setCurrentIndex(1)
    qtbot.waitUntil(lambda: live.form.state.trigger_edge == "falling", timeout=WAIT_MS)
    assert live.session.bench.camera.trigger_edge == "falling"


def test_binning_pauses_the_stream_and_goes_on(qtbot: QtBot, live: LivePanel) -> None:
    live.form.widgets["binning"].setCurrentIndex(1)
    qtbot.waitUntil(
        lambda: live.picture.frame is not None and live.picture.frame.image.shape == (120, 160),
        timeout=WAIT_MS,
    )


def test_a_region_dragged_is_sent_to_the_camera(qtbot: QtBot, live: LivePanel) -> None:
    qtbot.mouseClick(live.picture.region_button, Qt.MouseButton.LeftButton)
    live.picture.region_box.item.setPos((40, 60))
    live.picture.region_box.item.setSize((80, 100))
    qtbot.waitUntil(lambda: "region 60, 40, 100, 80" in live.status.text(), timeout=WAIT_MS)
    qtbot.mouseClick(live.picture.apply_region, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: live.session.bench.camera.roi.as_tuple() == (60, 40, 100, 80), timeout=WAIT_MS)
    qtbot.waitUntil(
        lambda: live.picture.frame is not None and live.picture.frame.image.shape == (100, 80),
        timeout=WAIT_MS,
    )
    qtbot.waitUntil(lambda: not live.session.jobs.jobs, timeout=WAIT_MS)
    qtbot.mouseClick(live.whole_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: live.session.bench.camera.roi.height == 240, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: not live.session.jobs.jobs, timeout=WAIT_MS)
    _type(qtbot, live.form.widgets["roi"], "8, 16, 100, 200")
    qtbot.waitUntil(lambda: live.session.bench.camera.roi.as_tuple() == (8, 16, 100, 200), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: not live.session.jobs.jobs, timeout=WAIT_MS)
    _type(qtbot, live.form.widgets["roi"], "8, 16, many")
    assert "four whole numbers" in live.form.widgets["roi"].toolTip()
    _type(qtbot, live.form.widgets["roi"], "0, 0, 9999, 9999")
    qtbot.waitUntil(lambda: "cannot read the region" in live.form.widgets["roi"].toolTip(), timeout=WAIT_MS)
    assert live.session.is_open("camera")


def test_a_region_a_line_and_the_cross_hair_by_keys_alone(qtbot: QtBot, live: LivePanel) -> None:
    picture, box = live.picture.view.graphics, live.picture.region_box
    alt, shift = Qt.KeyboardModifier.AltModifier, Qt.KeyboardModifier.ShiftModifier
    qtbot.keyClick(live.picture.region_button, Qt.Key.Key_Space)
    assert picture.hasFocus()
    before = box.rectangle
    assert before is not None
    qtbot.keyClick(picture, Qt.Key.Key_Left)
    qtbot.keyClick(picture, Qt.Key.Key_Down)
    qtbot.keyClick(picture, Qt.Key.Key_Right, alt)
    left, top, width, height = before
    assert box.rectangle == pytest.approx((left - 10, top + 10, width + 10, height))
    qtbot.keyClick(picture, Qt.Key.Key_Return)
    camera = live.session.bench.camera
    qtbot.waitUntil(lambda: camera.roi.width < 320, timeout=WAIT_MS)
    sent = (camera.roi.left, camera.roi.top, camera.roi.width, camera.roi.height)
    assert sent == pytest.approx((left - 10, top + 10, width + 10, height), abs=8)  # the sensor's steps
    qtbot.waitUntil(lambda: not live.session.jobs.jobs, timeout=WAIT_MS)
    qtbot.keyClick(live.picture.profile_button, Qt.Key.Key_Space)
    first = live.picture.profile_line.ends
    assert first is not None
    qtbot.keyClick(picture, Qt.Key.Key_Down)
    qtbot.keyClick(picture, Qt.Key.Key_Left, alt)
    moved = live.picture.profile_line.ends
    assert moved is not None
    assert np.subtract(moved, first) == pytest.approx(np.array([(0, 10), (-10, 10)]), abs=1e-6)
    qtbot.keyClick(live.picture.profile_button, Qt.Key.Key_Space)
    qtbot.keyClick(live.picture.cross_button, Qt.Key.Key_Space)
    assert live.picture.cross_hair.pixel is not None
    column, row = live.picture.cross_hair.pixel
    qtbot.keyClick(picture, Qt.Key.Key_Up)
    qtbot.keyClick(picture, Qt.Key.Key_Right, shift)
    assert live.picture.cross_hair.pixel == (column + 10, row - 1)
    qtbot.waitUntil(lambda: not live.session.jobs.jobs, timeout=WAIT_MS)  # the region


def test_zoom_and_pan_by_keys(qtbot: QtBot, live: LivePanel) -> None:
    picture, box = live.picture.view.graphics, live.picture.view.box
    whole = box.viewRange()
    qtbot.keyClick(picture, Qt.Key.Key_Plus)
    zoomed = box.viewRange()
    assert np.ptp(zoomed[0]) == pytest.approx(np.ptp(whole[0]) / 1.25)
    qtbot.keyClick(picture, Qt.Key.Key_Right)
    assert box.viewRange()[0][0] > zoomed[0][0]
    qtbot.keyClick(picture, Qt.Key.Key_0)
    np.testing.assert_allclose(box.viewRange(), whole)


def test_a_photograph_by_its_key(qtbot: QtBot, window: MainWindow, live: LivePanel) -> None:
    folder = live.session.runs_folder / "photographs"
    qtbot.keyClick(window, Qt.Key.Key_K, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: folder.is_dir() and any(folder.glob("*.tif")), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: not live.session.jobs.jobs, timeout=WAIT_MS)
    (file,) = folder.glob("*.tif")
    photo = read_image(file)
    assert photo.pixels.shape == (240, 320)
    assert photo.is_simulated
    assert photo.metadata["light"] == "scene"
    assert live.session.live.is_running


def test_the_live_key_holds_and_goes_on(qtbot: QtBot, window: MainWindow, live: LivePanel) -> None:
    qtbot.keyClick(window, Qt.Key.Key_L, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: not live.session.live.is_running, timeout=WAIT_MS)
    assert not live.live_button.isChecked()
    qtbot.keyClick(window, Qt.Key.Key_L, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: live.session.live.is_running, timeout=WAIT_MS)


def test_a_recording_by_its_key_shows_what_it_records(
    qtbot: QtBot, window: MainWindow, live: LivePanel
) -> None:
    finished: list[Path] = []
    live.session.run_finished.connect(finished.append)
    qtbot.keyClick(window, Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: "frames" in live.record_bar.note.text(), timeout=WAIT_MS)
    shown = live.picture.frame
    qtbot.waitUntil(lambda: live.picture.frame is not shown, timeout=WAIT_MS)
    assert "GB free" in live.record_bar.gauge.format()
    qtbot.keyClick(window, Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: bool(finished), timeout=WAIT_MS)
    run = Run.open(finished[0])
    assert run.records  # how many, the machine decides
    qtbot.waitUntil(lambda: live.session.live.is_running, timeout=WAIT_MS)
    assert live.session.bench.scene_lit


def test_a_recording_that_is_ended_before_it_began_does_not_begin(qtbot: QtBot, live: LivePanel) -> None:
    release = threading.Event()
    live.session.jobs.device("another", lambda _: release.wait(30), {"camera"})
    live.record()
    live.record()
    release.set()
    qtbot.waitUntil(lambda: live.record_bar.job is None, timeout=WAIT_MS)
    assert not list(live.session.runs_folder.glob("*recording*"))


@pytest.mark.parametrize("scene", [False, True])
def test_a_recording_ends_under_the_light_that_it_began_with(
    qtbot: QtBot, live: LivePanel, scene: bool
) -> None:
    bench = live.session.bench
    assert bench.led_array is not None
    bench.scene_on() if scene else bench.scene_off()
    pattern = bench.led_array.set_pattern(BrightField(0.25).on(bench.led_array, (9, 9, 9)))
    live.record_bar.seconds.set_value(0.1)
    live.record()
    qtbot.waitUntil(lambda: live.record_bar.job is None, timeout=WAIT_MS)
    assert bench.led_array.pattern == pattern
    assert bench.scene_lit is scene


def test_dark_is_not_said_where_the_operators_own_lamp_may_shine(
    live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    live.session.bench.scene_off()
    live._show_light()
    assert [b.text() for b in live.light_buttons.buttons() if b.isChecked()] == ["Dark"]
    monkeypatch.setattr(type(live.session.bench), "knows_scene", property(lambda _: False))
    live._show_light()
    assert not any(button.isChecked() for button in live.light_buttons.buttons())


def test_leds_that_are_not_the_source_are_not_called_so(qtbot: QtBot, live: LivePanel) -> None:
    bench = live.session.bench
    assert bench.led_array is not None
    bench.source_on()
    bench.scene_off()
    assert live.light is LightState.SOURCE
    bench.led_array.set_pattern(BrightField(0.25).on(bench.led_array))
    assert not bench.source_lit
    assert live.light is LightState.AS_IS
    live._show_light()
    assert not any(button.isChecked() for button in live.light_buttons.buttons())
    live.snap()
    qtbot.waitUntil(lambda: live.photograph is not None, timeout=WAIT_MS)
    assert live.photograph is not None
    taken = read_image(live.photograph).metadata
    assert taken["light"] == "as-is"
    assert "bright field" in taken["led_pattern"]
    code = live.as_python()
    assert "bench.led_array.set_pattern(LedPattern(" in code
    assert all(str(level) in code for level in bench.led_array.pattern.levels)
    compile(code, "copied", "exec")


def test_a_photograph_stands_in_the_runs_and_goes_to_be_reconstructed(
    qtbot: QtBot, window: MainWindow, live: LivePanel
) -> None:
    live.snap()
    qtbot.waitUntil(lambda: live.photograph is not None, timeout=WAIT_MS)
    runs = window.show_panel("runs")
    assert isinstance(runs, RunsPanel)
    qtbot.waitUntil(lambda: runs.table.rowCount() == 1, timeout=WAIT_MS)
    assert [runs.table.item(0, place).text() for place in (3, 4)] == ["photograph", "SIMULATED"]
    assert "1 photograph" in runs.where.text()
    runs.table.setCurrentCell(0, 0)
    qtbot.waitUntil(lambda: "Photograph" in runs.frame_words.text(), timeout=WAIT_MS)
    assert "Light: scene" in runs.about.toPlainText()
    assert not runs.verify_button.isEnabled()
    compile(runs.as_python(), "copied", "exec")
    handed: list[object] = []
    live.session.handed_on.connect(lambda *what: handed.extend(what))
    qtbot.mouseClick(runs.use_button, Qt.MouseButton.LeftButton)
    assert handed == ["reconstructions", live.photograph]


def _disk_full(*_: object, **__: object) -> None:
    raise BenchError("The disk is full.")


def test_a_recording_that_was_stopped_is_kept_in_the_dark_and_goes_on_in_its_light_to_its_end(
    qtbot: QtBot, window: MainWindow, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    bar = live.record_bar
    qtbot.waitUntil(lambda: live.session.bench.scene_lit, timeout=WAIT_MS)
    bar.seconds.set_value(60.0)
    live.record()
    qtbot.waitUntil(lambda: "frames" in bar.note.text(), timeout=WAIT_MS)
    with qtbot.waitSignal(live.session.stopped, timeout=WAIT_MS):
        qtbot.keyClick(window, Qt.Key.Key_Escape)
    qtbot.waitUntil(bar.rest_button.isVisible, timeout=WAIT_MS)
    assert bar.rest is not None
    assert bar.rest.seconds is not None
    assert 0 < bar.rest.seconds < 60
    assert bar.job is None
    assert not live.session.bench.scene_lit
    (folder,) = live.session.runs_folder.glob("*recording*")
    assert len(Run.open(folder).records) > 0
    assert folder.name in bar.note.text()
    qtbot.mouseClick(bar.look_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "runs" in window.maker.panels, timeout=WAIT_MS)
    runs = window.maker.panels["runs"]
    assert isinstance(runs, RunsPanel)
    qtbot.waitUntil(lambda: runs.opened is not None and runs.opened.path == folder, timeout=WAIT_MS)
    window.show_panel("live")
    bar.rest = replace(bar.rest, seconds=0.2)  # a minute is long
    camera = live.session.bench.camera
    exposure_ms = camera.exposure_ms
    camera.set_exposure_ms(2 * exposure_ms)  # as a camera that was connected again
    qtbot.waitUntil(lambda: not live.session.jobs.is_busy("camera"), timeout=WAIT_MS)
    said = bar.note.text()
    assert " is kept in " in said
    with monkeypatch.context() as full:
        full.setattr("instrument.runs.recorder.prepare_recording", _disk_full)
        qtbot.mouseClick(bar.rest_button, Qt.MouseButton.LeftButton)
        qtbot.waitUntil(lambda: bar.job is None and bar.rest_button.isVisible(), timeout=WAIT_MS)
    assert not live.session.bench.scene_lit, "as dark as it was before"
    assert camera.exposure_ms == pytest.approx(2 * exposure_ms)
    assert bar.note.text() == said, "there is no other film"
    assert bar.look_button.isVisible()
    qtbot.mouseClick(bar.rest_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: bar.job is None and " in " in bar.note.text(), timeout=WAIT_MS)
    assert live.session.bench.scene_lit
    assert bar.rest_button.isHidden()
    assert camera.exposure_ms == pytest.approx(exposure_ms)
    assert len(list(live.session.runs_folder.glob("*recording*"))) == 2
    bar._look_for_rest()
    qtbot.waitUntil(lambda: not bar._rests.is_reading, timeout=WAIT_MS)
    assert bar.rest_button.isHidden(), "it has been gone on with"


def _cut(session: BenchSession) -> Path:
    """Record a film that a kill cuts; return its folder."""
    bench = session.bench
    bench.scene_on()

    def fail(_: RecordingStatus) -> None:
        raise KeyboardInterrupt

    with session.live.paused(), pytest.raises(KeyboardInterrupt):
        record(bench, session.runs_folder, seconds=60.0, label="cells", on_progress=fail)
    (cut,) = session.runs_folder.glob("*cells*")
    state = cut / "state.json"
    state.write_text(state.read_text().replace('"finished"', '"running"'))
    assert Run.open(cut).condition is RunCondition.CRASHED
    return cut


def _shown_live(qtbot: QtBot, session: BenchSession) -> LivePanel:
    live = whole(LivePanel(session))
    qtbot.addWidget(live, before_close_func=lambda p: p.shutdown())
    live.show()
    return live


def test_the_rest_of_a_recording_may_be_left_and_is_offered_no_more(
    qtbot: QtBot, session: BenchSession
) -> None:
    cut = _cut(session)
    bar = _shown_live(qtbot, session).record_bar
    qtbot.waitUntil(bar.leave_button.isVisible, timeout=WAIT_MS)
    qtbot.mouseClick(bar.leave_button, Qt.MouseButton.LeftButton)
    assert bar.leave_button.isHidden()
    assert bar.rest_button.isHidden()
    assert bar.look_button.isVisible()
    assert bar.note.text().startswith(f"{cut.name}: ")
    kept = session.runs_folder / "kept-with-bench.json"
    qtbot.waitUntil(lambda: kept.exists() and cut.name in kept.read_text(), timeout=WAIT_MS)
    again = _shown_live(qtbot, session).record_bar
    qtbot.waitUntil(lambda: not again._rests.is_reading, timeout=WAIT_MS)
    assert again.rest_button.isHidden()
    assert Run.open(cut).condition is RunCondition.CRASHED, "as it was"


def test_a_recording_that_a_kill_cut_is_offered_when_the_program_starts_anew(
    qtbot: QtBot, session: BenchSession
) -> None:
    cut, bench = _cut(session), session.bench
    bar = _shown_live(qtbot, session).record_bar
    qtbot.waitUntil(bar.rest_button.isVisible, timeout=WAIT_MS)
    assert bar.note.text().startswith(f"{cut.name} did not end: ")
    assert bar.look_button.isVisible()
    assert bar.rest is not None
    bar.rest = replace(bar.rest, seconds=0.2)  # a minute is long
    qtbot.mouseClick(bar.rest_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: bar.job is None and " in " in bar.note.text(), timeout=WAIT_MS)
    assert bench.scene_lit
    assert bar.rest_button.isHidden()
    assert len(list(session.runs_folder.glob("*cells*"))) == 2


def test_profile_and_cross_hair_follow_the_frame(qtbot: QtBot, live: LivePanel) -> None:
    qtbot.mouseClick(live.picture.profile_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: live.picture._profile_curve.getData()[0] is not None, timeout=WAIT_MS)
    assert len(live.picture._profile_curve.getData()[0]) > 200
    qtbot.mouseClick(live.picture.cross_button, Qt.MouseButton.LeftButton)
    live.picture.view.clicked.emit(7, 9)
    qtbot.waitUntil(lambda: "x 7  y 9" in live.status.text(), timeout=WAIT_MS)


def test_line_and_cross_hair_keep_their_place_on_the_sensor_in_another_region(
    qtbot: QtBot, live: LivePanel
) -> None:
    picture = live.picture
    for switch in (picture.profile_button, picture.cross_button):
        qtbot.mouseClick(switch, Qt.MouseButton.LeftButton)
    picture.view.clicked.emit(100, 90)
    for roi, place, ends in (
        (Roi(60, 20, 120, 300), (80, 30), [(12, 60), (268, 60)]),  # both are inside
        (Roi(60, 80, 20, 40), (20, 10), [(4, 10), (36, 10)]),  # neither: the line begins anew, in the middle
    ):
        live.form.set_region(roi)
        qtbot.waitUntil(
            lambda roi=roi: picture.frame is not None and picture.frame.metadata.roi == roi.as_tuple(),
            timeout=WAIT_MS,
        )
        assert picture.cross_hair.pixel == place
        assert picture.profile_line.ends == pytest.approx(np.array(ends), abs=0.6)


def test_levels_follow_percentiles_of_the_raw_data(qtbot: QtBot, live: LivePanel) -> None:
    qtbot.waitUntil(lambda: live.session.bench.scene_lit, timeout=WAIT_MS)
    live.picture.stretch.setCurrentText("1 – 99 %")
    qtbot.waitUntil(lambda: live.picture.levels[1] < 4000, timeout=WAIT_MS)
    frame = live.picture.frame
    assert frame is not None
    live.picture.histogram.region.setRegion((10.0, 200.0))
    assert live.picture.stretch.currentText() == "by hand"
    assert live.picture.levels == (10.0, 200.0)


def test_a_frame_that_is_much_brighter_is_not_left_with_the_levels_of_the_one_before(
    qtbot: QtBot, live: LivePanel
) -> None:
    live.toggle_live()
    qtbot.waitUntil(lambda: not live.session.live.is_running, timeout=WAIT_MS)
    picture = live.picture
    picture.stretch.setCurrentText("full range")
    picture.stretch.setCurrentText("0.1 – 99.9 %")
    assert picture.frame is not None
    like = picture.frame.image
    for counts in (40, 3000):  # a slow camera: none comes between
        image = np.linspace(0, counts, like.size).reshape(like.shape).astype(like.dtype)
        picture.show_frame(replace(picture.frame, image=image))
        assert picture.view._levels[:2] == picture.levels
        assert picture.levels[1] > counts / 2, "not for a third of a second with another light's either"
        picture.measure()
        assert picture.view._levels[:2] == picture.levels
    assert picture.levels[1] > 2500


def test_a_frame_that_is_held_is_stretched_as_well(
    qtbot: QtBot, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    live.toggle_live()
    qtbot.waitUntil(lambda: not live.session.live.is_running, timeout=WAIT_MS)
    live.look()
    live.count()
    frame, drawn = live.picture.frame, []
    assert frame is not None
    real = live.picture.view.show_image
    monkeypatch.setattr(live.picture.view, "show_image", lambda *given: (drawn.append(given), real(*given)))
    live.picture.stretch.setCurrentText("full range")
    assert live.picture.levels == (0.0, frame.full_scale)
    live.picture.histogram.region.setRegion((10.0, 200.0))
    assert live.picture.frame is frame
    levels = [given[1:3] for given in drawn]
    assert levels[0] == (0.0, frame.full_scale)
    assert levels[-1] == (10.0, 200.0)
    assert all(given[0] is frame.image for given in drawn)


@pytest.mark.parametrize("size", [(200, 300), (1500, 1700)])
def test_saturated_pixels_keep_their_colour_however_small_they_are_shown(
    qtbot: QtBot, size: tuple[int, int]
) -> None:
    """At 12 bits in a 16-bit frame: 4095 is saturated, 4094 is not; one pixel is enough."""
    view = ImageView("grey")
    qtbot.addWidget(view)
    view.resize(400, 400)
    view.show()
    image = np.full(size, 4094, np.uint16)
    view.show_image(image, 0, 4095, 4095)
    view.show_image(image, 0, 4095, 4095)
    assert 255 not in view._indices
    image[101, 57] = 4095
    view.show_image(image, 0, 4095, 4095)
    assert (view._indices == 255).sum() == 1
    if size[0] > 1000:
        assert view._indices.shape[0] < size[0]
    picture = view.grab().toImage()
    reds = sum(
        QColor(picture.pixel(x, y)).red() > QColor(picture.pixel(x, y)).green() + 100
        for y in range(picture.height())
        for x in range(picture.width())
    )
    assert reds > 0


def test_a_cameras_own_settings_are_set_where_all_are_shown(
    qtbot: QtBot, live: LivePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = {"Fan": "Off", "Trim": "3"}

    def set_own(name: str, value: str) -> str:
        if value == "9":
            raise LimitError("camera", "takes no Trim '9'.", "It takes 0 to 5.")
        now.update({name: value, "Trim": "1"})  # which goes with the fan
        return value

    def own() -> dict[str, OwnSetting]:
        return {
            "Fan": OwnSetting(now["Fan"], "Off, On", ("Off", "On")),
            "Trim": OwnSetting(now["Trim"], "0 to 5"),
        }

    monkeypatch.setattr(live.session.bench.camera, "own_settings", own)
    monkeypatch.setattr(live.session.bench.camera, "set_own", set_own)
    qtbot.waitUntil(live.form.isEnabled, timeout=WAIT_MS)
    qtbot.mouseClick(live.form.all_button, Qt.MouseButton.LeftButton)
    (shown,) = live.findChildren(DeviceSettings)
    qtbot.waitUntil(lambda: set(shown.fields) == {"Fan", "Trim"}, timeout=WAIT_MS)
    assert "exposure" in shown.view.toPlainText()
    fan, trim = shown.fields["Fan"], shown.fields["Trim"]
    assert isinstance(fan, QComboBox)
    assert isinstance(trim, QLineEdit)
    qtbot.keyClick(fan, Qt.Key.Key_Down)
    qtbot.waitUntil(lambda: now["Fan"] == "On" and "On now" in shown.note.text(), timeout=WAIT_MS)
    assert "Trim is 1" in shown.note.text()
    assert trim.text() == "1"
    trim.setText("9")
    qtbot.keyClick(trim, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: "0 to 5" in shown.note.text(), timeout=WAIT_MS)
    assert trim.property("refused")
    assert now["Trim"] == "1"
    shown.close()
