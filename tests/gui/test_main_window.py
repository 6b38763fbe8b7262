"""The shell: devices, STOP, the log, closing."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from PySide6.QtCore import QSettings, Qt
from PySide6.QtWidgets import QApplication, QMessageBox
from pytestqt.qtbot import QtBot

from benchmarks.gui_stalls import opened
from calibration_routines.procedure import Outlook, Procedure
from gui.jobs import JobContext, JobState
from gui.main_window import MainWindow
from gui.panels import PANELS, PanelEntry
from gui.panels.live import LivePanel
from gui.procedure_panel import ProcedurePanel
from gui.session import BenchSession
from gui.widgets.building import every
from gui.widgets.dialogues import TextWindow, choose_path
from instrument.bench.bench import Bench
from instrument.bench.lit import LightState
from instrument.files.errors import BenchError
from tests.gui.looks import faults

WAIT_MS = 60_000


def test_a_simulated_bench_says_so(window: MainWindow) -> None:
    assert window.simulated.isVisible()
    assert window.simulated.text() == "SIMULATED"
    assert all(window.session.is_open(kind) for kind in ("camera", "stage", "led_array", "slm"))


def test_every_panel_opens_and_copies_python(qtbot: QtBot, window: MainWindow) -> None:
    for name, entry in PANELS.items():
        window.bring(name)
        qtbot.waitUntil(lambda name=name: name in window.maker.panels, timeout=WAIT_MS)
        panel = window.panel(name)
        assert panel.title == entry.title
        qtbot.waitUntil(panel.isVisible, timeout=WAIT_MS)
        panel.copy_button.click()
        code = QApplication.clipboard().text()
        compile(code, name, "exec")
        assert not faults(window), name
    shortcuts = [entry.shortcut for entry in PANELS.values()]
    assert len(set(shortcuts)) == len(shortcuts)


def test_panels_at_the_side_come_after_the_first_picture(
    qtbot: QtBot,
    make_session: Callable[[], BenchSession],
    settings: QSettings,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gui.making.PICTURE_MS", WAIT_MS)  # a busy machine takes longer than they wait
    window = MainWindow(make_session(), settings)
    qtbot.addWidget(window)
    window.show()
    qtbot.waitUntil(lambda: "live" in window.maker.panels, timeout=WAIT_MS)
    assert set(window.maker.panels) == {"log", "live"}
    assert not {"stage", "live_reconstruction"} & set(window.maker._then)
    with qtbot.waitSignal(window.session.pictured, timeout=WAIT_MS):
        window.session.open()
    qtbot.waitUntil(lambda: {"stage", "live_reconstruction"} <= set(window.maker.panels), timeout=WAIT_MS)


def test_stop_is_heard_while_a_panel_is_made_and_breaks_off_no_check_for_good(
    qtbot: QtBot, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gui.making._SLICE_S", -1.0)  # each part is a slice
    turns: list[bool] = []
    timer = every(window, 0, lambda: turns.append("sweeps" in window.maker.panels))
    qtbot.waitUntil(lambda: len(turns) > 3, timeout=WAIT_MS)
    turns.clear()
    with qtbot.waitSignal(window.maker.made, timeout=WAIT_MS):
        window.bring("sweeps")
        qtbot.waitUntil(lambda: "sweeps" in window.maker._slices, timeout=WAIT_MS)
        with qtbot.waitSignal(window.session.stop_pressed, timeout=WAIT_MS):
            qtbot.mouseClick(window.stop_button, Qt.MouseButton.LeftButton)
        assert "sweeps" not in window.maker.panels
    timer.stop()
    assert turns.count(False) > 1
    panel = window.panel("sweeps")
    assert isinstance(panel, ProcedurePanel)
    qtbot.waitUntil(lambda: panel.outlook is not None, timeout=WAIT_MS)
    began, go_on = threading.Event(), threading.Event()
    outlook = type(panel.procedure()).outlook

    def slow(procedure: Procedure, bench: Bench, folder: Path | None = None) -> Outlook:
        began.set()
        go_on.wait(WAIT_MS / 1e3)
        return outlook(procedure, bench, folder)

    monkeypatch.setattr(type(panel.procedure()), "outlook", slow)
    panel.check()
    qtbot.waitUntil(began.is_set, timeout=WAIT_MS)
    window.session.stop()
    assert not panel.run_bar.start_button.isEnabled()
    go_on.set()
    qtbot.waitUntil(panel.run_bar.start_button.isEnabled, timeout=WAIT_MS)


def test_escape_stops_a_move_and_turns_the_light_off(qtbot: QtBot, window: MainWindow) -> None:
    session = window.session
    bench = session.bench
    assert bench.stage is not None
    assert bench.led_array is not None
    stage = bench.stage
    homed = session.jobs.device("home", lambda _: stage.home(), {"stage"})
    qtbot.waitUntil(lambda: homed.is_over, timeout=WAIT_MS)
    bench.source_on()
    far = stage.limits["x_um"][1]
    move = session.jobs.device("move", lambda _: stage.move_to({"x_um": far}), {"stage"})
    qtbot.waitUntil(lambda: stage.is_moving, timeout=WAIT_MS)
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        qtbot.keyClick(window, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: move.is_over, timeout=WAIT_MS)
    assert move.state is JobState.CANCELLED
    assert not stage.is_moving
    assert stage.position()["x_um"] < far - 1000
    assert bench.led_array.pattern.is_dark


def test_the_stop_button_ends_an_exclusive_job_and_the_live_view_goes_on(
    qtbot: QtBot, window: MainWindow
) -> None:
    session = window.session

    def work(context: JobContext) -> None:
        while True:
            session.bench.snap()
            context.report(1)

    job = session.exclusive_job("A run", work)
    with qtbot.waitSignal(job.progressed, timeout=WAIT_MS):
        pass
    with qtbot.waitSignals([job.ended, session.stopped], timeout=WAIT_MS):
        qtbot.mouseClick(window.stop_button, Qt.MouseButton.LeftButton)
    assert job.state is JobState.CANCELLED
    qtbot.waitUntil(lambda: session.live.is_running, timeout=WAIT_MS)


def test_an_unplugged_camera_is_named_and_comes_back(qtbot: QtBot, window: MainWindow) -> None:
    session = window.session
    world = session.bench.shared["simulated"]
    live = window.show_panel("live")
    assert isinstance(live, LivePanel)
    qtbot.waitUntil(lambda: live.picture.frame is not None, timeout=WAIT_MS)
    world.unplug("camera")  # type: ignore[attr-defined]
    qtbot.waitUntil(lambda: session.state("camera").condition == "failed", timeout=WAIT_MS)
    assert "unplugged" in session.state("camera").text
    live.count()
    assert "unplugged" in live.status.text(), "below the old picture, not its figures"
    live.refused(None, session.state("camera").text)
    button = window.chips.reconnect_buttons["camera"]
    assert button.isVisible()
    assert session.is_open("stage")
    assert "camera (simulated)" in window.panel("log").view.toPlainText()  # type: ignore[attr-defined]
    qtbot.mouseClick(button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: not session.jobs.jobs, timeout=WAIT_MS)
    assert session.state("camera").condition == "failed"
    assert "unplugged" in window.status.words.text(), "not that connecting is done"
    world.plug_in("camera")  # type: ignore[attr-defined]
    qtbot.mouseClick(button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: session.live.newest() is not None, timeout=WAIT_MS)
    assert session.is_open("camera")
    assert not button.isVisible()
    assert not live._note.text(), "its cause is gone"


def test_one_device_that_cannot_be_opened_leaves_the_others_at_work(
    qtbot: QtBot, make_session: Callable[[], BenchSession]
) -> None:
    session = make_session()
    session.bench.shared["simulated"].unplug("led_array")  # type: ignore[attr-defined]
    with qtbot.waitSignal(session.opened, timeout=WAIT_MS):
        session.open()
    assert session.state("led_array").condition == "failed"
    assert session.is_open("slm")
    qtbot.waitUntil(lambda: session.live.newest() is not None, timeout=WAIT_MS)


def test_closing_while_something_runs_asks_and_then_ends_safely(qtbot: QtBot, window: MainWindow) -> None:
    session = window.session

    def work(context: JobContext) -> None:
        session.bench.source_on()
        while True:
            session.bench.snap()
            context.report(1)

    job = session.exclusive_job("A sweep", work)
    with qtbot.waitSignal(job.progressed, timeout=WAIT_MS):
        pass
    window.close()
    box = window.question
    assert isinstance(box, QMessageBox)
    assert "A sweep" in box.text()
    go_on = next(b for b in box.buttons() if b.text() == "Go on")
    qtbot.mouseClick(go_on, Qt.MouseButton.LeftButton)
    assert not job.is_over
    assert window.isVisible()
    window.close()
    first = window.question
    assert first is not None
    assert not first.isModal()
    window.close()  # not asked twice
    assert window.question is first
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        qtbot.mouseClick(window.stop_button, Qt.MouseButton.LeftButton)
    assert job.is_over
    assert first.isVisible()
    stop = next(b for b in first.buttons() if b.text() == "Stop and close")
    with qtbot.waitSignal(session.closed, timeout=WAIT_MS):
        qtbot.mouseClick(stop, Qt.MouseButton.LeftButton)
    assert job.is_over
    assert not window.isVisible()
    assert not any(device.is_open for device in session.bench.devices.values())


def test_the_layout_is_kept(
    qtbot: QtBot, window: MainWindow, settings: QSettings, make_session: Callable[[], BenchSession]
) -> None:
    qtbot.mouseClick(window._titles["log"].away, Qt.MouseButton.LeftButton)
    with qtbot.waitSignal(window.session.closed, timeout=WAIT_MS):
        window.close()
    again = MainWindow(make_session(), settings)
    qtbot.addWidget(again, before_close_func=lambda w: setattr(w, "_may_close", True))
    assert again._docks["log"].isHidden()


def test_the_log_filters_by_level_and_words(window: MainWindow) -> None:
    panel = window.panel("log")
    session = window.session
    session.log("debug", "a detail")
    session.log("warning", "a warning of the stage")
    view = panel.view  # type: ignore[attr-defined]
    assert "a detail" not in view.toPlainText()
    panel.level.setCurrentIndex(0)  # type: ignore[attr-defined]
    assert "a detail" in view.toPlainText()
    panel.words.setText("STAGE")  # type: ignore[attr-defined]
    assert "a warning of the stage" in view.toPlainText()
    assert "a detail" not in view.toPlainText()


def test_stop_withdraws_what_the_operator_is_asked(qtbot: QtBot, window: MainWindow) -> None:
    session = window.session
    job = session.exclusive_job("By hand", lambda _: session._ask("Please light the scene."))
    qtbot.waitUntil(lambda: window.question is not None, timeout=WAIT_MS)
    assert window.question is not None
    assert "light the scene" in window.question.text()
    with qtbot.waitSignal(session.stopped, timeout=WAIT_MS):
        session.stop()
    qtbot.waitUntil(lambda: job.is_over and window.question is None, timeout=WAIT_MS)
    assert job.state is JobState.CANCELLED


def test_what_a_device_refuses_is_no_failure_of_it(qtbot: QtBot, window: MainWindow) -> None:
    session = window.session
    job = session.camera_job("trigger", lambda camera: camera.trigger())  # it runs free: refused
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    assert job.state is JobState.FAILED
    assert session.is_open("camera")


def test_stop_takes_clicks_while_a_text_is_open_and_the_text_goes_when_closed(
    qtbot: QtBot, window: MainWindow
) -> None:
    qtbot.mouseClick(window.chips.chips["stage"], Qt.MouseButton.LeftButton)
    (text,) = window.findChildren(TextWindow)
    assert text.isVisible()
    assert not text.isModal()
    with qtbot.waitSignal(window.session.stopped, timeout=WAIT_MS):
        qtbot.mouseClick(window.stop_button, Qt.MouseButton.LeftButton)
    with qtbot.waitSignal(text.destroyed, timeout=WAIT_MS):
        text.reject()


def test_what_a_panel_warned_of_leaves_the_last_line_with_it_and_the_failure_of_a_device_does_not(
    qtbot: QtBot, window: MainWindow
) -> None:
    session, words = window.session, window.status.words

    def fail(_: JobContext) -> None:
        raise BenchError("a.npy and b.npy have different sizes.")

    session.log("warning", "The result fails in 3 of 10 pictures like it.")
    window.bring("tasks")
    assert words.text() == "Ready"
    job = session.jobs.compute("Compare", fail)
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    assert "different sizes" in words.text()
    window.bring("live")
    assert words.text() == "Ready"
    job = session.jobs.device("Homing the stage", fail, {"stage"})
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    window.bring("tasks")
    assert "different sizes" in words.text()
    gate = threading.Event()
    job = session.jobs.compute("Analyze", lambda _: gate.wait(WAIT_MS / 1000))
    qtbot.waitUntil(lambda: job.state is JobState.RUNNING, timeout=WAIT_MS)
    session.log("warning", "Two of the planes are the same.")
    window.bring("live")
    assert words.text() == "Analyze …", "what runs is named again"
    gate.set()


def test_closing_asks_before_a_short_job_is_broken_off_and_not_before_a_listing(
    qtbot: QtBot, window: MainWindow
) -> None:
    session = window.session
    gate = threading.Event()
    session.jobs.watch("Listing", lambda _: gate.wait(WAIT_MS / 1000))
    job = session.jobs.device("Homing the stage", lambda _: gate.wait(WAIT_MS / 1000), {"stage"})
    qtbot.waitUntil(lambda: job.state is JobState.RUNNING, timeout=WAIT_MS)
    window.close()
    assert window.question is not None
    assert "Homing the stage is running" in window.question.text()
    assert window.status.words.text() == "Homing the stage …"
    window.question.reject()
    gate.set()
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)


def test_stop_takes_clicks_while_a_file_is_chosen(qtbot: QtBot, window: MainWindow, tmp_path: Path) -> None:
    panel = window.show_panel("reconstructions")
    chosen: list[Path] = []
    start = tmp_path / "sub" / "name.tif"
    start.parent.mkdir()
    start.touch()
    dialogue = choose_path(panel, "open", "A file", str(start), chosen.append)
    assert choose_path(panel, "open", "A file", str(start), chosen.append) is dialogue
    assert dialogue.isVisible()
    assert not dialogue.isModal()
    with qtbot.waitSignal(window.session.stopped, timeout=WAIT_MS):
        qtbot.mouseClick(window.stop_button, Qt.MouseButton.LeftButton)
    qtbot.keyClick(dialogue, Qt.Key.Key_Return)
    assert chosen == [start]


def test_nobody_is_asked_to_close_what_was_only_just_opened(
    qtbot: QtBot, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = window.session
    qtbot.waitUntil(lambda: not session.jobs.is_busy("light"), timeout=WAIT_MS)
    gate = threading.Event()
    monkeypatch.setattr("gui.session.switch_light", lambda *_: gate.wait(WAIT_MS / 1000))
    live = window.panel("live")
    monkeypatch.setattr(type(live), "light", LightState.DARK)
    live._light_the_scene()  # type: ignore[attr-defined]
    qtbot.waitUntil(lambda: session.jobs.is_busy("light"), timeout=WAIT_MS)
    window.close()
    assert window.question is None
    gate.set()
    qtbot.waitUntil(lambda: session.is_closed, timeout=WAIT_MS)


def test_lists_are_read_without_a_word(window: MainWindow) -> None:
    window.panel("runs").read_folder()  # type: ignore[attr-defined]
    window.panel("reconstructions").results.refresh()  # type: ignore[attr-defined]
    listings = [job for job in window.session.jobs.jobs if not job.lanes]
    assert listings
    assert all(job.quiet for job in listings)


def test_what_drivers_and_instrument_tell_is_in_the_log(qtbot: QtBot, session: BenchSession) -> None:
    lines: list[tuple[str, str]] = []
    session.logged.connect(lambda level, text: lines.append((level, text)))
    for room in ("drivers.stage", "instrument.bench.bench", "calibration_routines.psf.sweep"):
        logging.getLogger(room).info("told by %s", room)
    qtbot.waitUntil(lambda: sum("told by" in text for _, text in lines) == 3, timeout=WAIT_MS)


def test_panels_are_prepared_before_they_are_asked_for(
    qtbot: QtBot, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[str] = []

    def load(entry: PanelEntry) -> None:
        loaded.append(entry.title)
        if entry.title == "Films":
            raise ImportError("it lacks something")

    monkeypatch.setattr(PanelEntry, "load", load)
    window.maker.prepare()
    qtbot.waitUntil(lambda: len(loaded) == len(PANELS), timeout=WAIT_MS)
    assert "lacks" not in window.status.words.text(), "it is told where the panel is opened"


def test_an_import_that_is_broken_off_leaves_no_panel_opening_for_ever(
    qtbot: QtBot, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(_: PanelEntry) -> None:
        raise KeyboardInterrupt

    opening = window.maker
    with monkeypatch.context() as broken:
        broken.setattr(PanelEntry, "load", load)
        window.bring("holograms")
        assert opening.waits_for("holograms") == "the job that imports it"
        qtbot.waitUntil(lambda: "nothing" in opening.waits_for("holograms"), timeout=WAIT_MS)
    window.bring("holograms")
    qtbot.waitUntil(lambda: not opening.waits_for("holograms"), timeout=WAIT_MS)
    assert "holograms" in opening.panels


def test_the_benchmark_of_stalls_tells_of_a_panel_that_is_not_made(
    window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PanelEntry, "load", lambda _: threading.Event().wait(1.0))
    with pytest.raises(TimeoutError, match=r"Holograms does not stand.*the job that imports it.*Opening"):
        opened(window, "holograms", 0.2)
