"""Sweeps, plans and past runs by real clicks and keys on the simulated bench."""

from __future__ import annotations

import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtWidgets import QApplication, QMessageBox, QWidget
from pytestqt.qtbot import QtBot

from calibration_routines.psf.sweep_procedure import SweepProcedure
from drivers.errors import DeviceError
from gui.main_window import MainWindow
from gui.panels.runs import RunsPanel
from gui.panels.sweeps import ILLUMINATION, SweepsPanel
from gui.panels.tasks import TasksPanel
from gui.procedure_run import Ended, Situation
from gui.widgets.tab_order import stops_of
from instrument.bench.safety import MOTION_DOUBT
from instrument.runs.run import Run, RunCondition

LEFT = Qt.MouseButton.LeftButton
WAIT_MS = 60_000


@pytest.fixture
def bench_text() -> str:
    """A bench whose sweeps take a second or two: long enough to be paused and stopped."""
    return """
[bench]
name = "test bench"
data_folder = "runs"
[camera]
driver = "simulated"
exposure_ms = 2.0
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
leds = 89
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0.1
"""


@pytest.fixture
def panel(qtbot: QtBot, window: MainWindow) -> SweepsPanel:
    panel = window.show_panel("sweeps")
    assert isinstance(panel, SweepsPanel)
    # Of a form that is made late what was found is checked once more.
    checked = panel.run_bar.start_button.isEnabled
    qtbot.waitUntil(lambda: panel.outlook is not None and checked(), timeout=WAIT_MS)
    return panel


def enter(qtbot: QtBot, panel: SweepsPanel, **numbers: str) -> None:
    """Type numbers into fields, as a person does, and wait until the form was checked."""
    for name, text in numbers.items():
        field: Any = panel.view.widgets[name]
        if not field.isVisible():
            qtbot.mouseClick(panel.view.more, LEFT)
        qtbot.mouseClick(field, LEFT)
        field.selectAll()
        qtbot.keyClicks(field, text)
    wait_for_check(qtbot, panel)


def wait_for_check(qtbot: QtBot, panel: SweepsPanel) -> None:
    qtbot.wait(1)
    qtbot.waitUntil(lambda: panel.is_settled, timeout=WAIT_MS)


def press(qtbot: QtBot, button: Any) -> None:
    assert button.isEnabled(), button.toolTip()
    qtbot.mouseClick(button, LEFT)


def run_of(folder: Path) -> Run:
    (path,) = folder.glob("*_axial-sweep")
    return Run.open(path)


def test_a_form_begins_with_depths_that_the_stage_reaches_and_draws_them(
    qtbot: QtBot, panel: SweepsPanel
) -> None:
    def counted() -> None:  # a busy bench is asked again, and what was found stands for a moment only
        assert panel.run_bar.start_button.isEnabled()
        assert panel.outlook is not None
        assert panel.outlook.cost is not None
        words = panel.verdict.toPlainText()
        assert f"{panel.outlook.cost.frames} frames" in words
        assert "homed first" in words

    def drawn() -> None:
        assert {place["z_um"] for place in panel.path.places} >= {60e3, 150e3}

    qtbot.waitUntil(counted, timeout=WAIT_MS)
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="4")
    qtbot.waitUntil(drawn, timeout=WAIT_MS)
    (view,) = panel.path.views
    assert view.axes == ("z_um", "x_um")


WRONG = [
    ("z_min_um", "abc", "no number", "60"),
    ("z_min_um", "", "needed", "60"),
    ("z_max_um", "900", "outside the stage's limits", "150"),
    ("z_max_um", "20", "nearest first", "150"),
    ("average", "1.5", "whole number", "1"),
    ("average", "0", "1 or more", "1"),
    ("target", "3", "0.05 or more", "0.7"),
    ("binning", "999", "choose 15 at most", "1"),
]


def test_wrong_entries_are_refused_at_the_field_with_the_reason(qtbot: QtBot, panel: SweepsPanel) -> None:
    for name, text, reason, right in WRONG:
        field: Any = panel.view.widgets[name]
        if not text:
            field.setFocus()
            field.selectAll()
            qtbot.keyClick(field, Qt.Key.Key_Delete)
            wait_for_check(qtbot, panel)
        else:
            enter(qtbot, panel, **{name: text})
        assert reason in panel.view.reason(name)
        assert panel.view._reasons[name].isVisible()
        assert field.property("refused")
        assert not panel.run_bar.start_button.isEnabled()
        told = panel.verdict.toPlainText()
        assert "frames" not in told.partition(", ")[0], f"the plan of other values stays: {told}"
        enter(qtbot, panel, **{name: right})
        assert not panel.view.reason(name)


def test_a_sweep_with_pause_quality_as_it_arrives_and_its_run_in_the_list(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="4", average="2")
    press(qtbot, panel.run_bar.start_button)
    qtbot.waitUntil(lambda: len(panel.psfs.qualities) >= 1, timeout=WAIT_MS)
    press(qtbot, panel.run_bar.pause_button)
    qtbot.waitUntil(lambda: "PAUSED" in panel.run_bar.words.text(), timeout=WAIT_MS)
    led_array = window.session.bench.led_array
    assert led_array is not None
    assert led_array.pattern.is_dark
    assert panel.frame.image is not None
    press(qtbot, panel.run_bar.pause_button)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        pass
    assert panel.run_bar.words.text() == "Done"
    assert [q is not None and not q.findings for q in panel.psfs.qualities] == [True] * 4
    assert "all 4 PSFs good" in panel.verdict.toPlainText()
    assert panel.use_button.isVisible()
    panel.take("lateral")
    assert not panel.use_button.isVisible(), "that was the axial sweep's"
    assert not panel.run_bar.words.text()
    assert panel.frame.isHidden(), "its picture, too"
    assert not panel.psfs.qualities
    runs = window.show_panel("runs")
    assert isinstance(runs, RunsPanel)
    qtbot.waitUntil(lambda: runs.table.rowCount() == 1, timeout=WAIT_MS)
    click_row(qtbot, runs, 0)
    qtbot.waitUntil(lambda: runs.opened is not None, timeout=WAIT_MS)
    assert runs.opened is not None
    assert "4 PSFs, good" in runs.about.toPlainText()
    assert not runs.bar.start_button.isEnabled()
    runs.slider.setFocus()
    qtbot.keyClick(runs.slider, Qt.Key.Key_End)
    last = f"Frame {runs.opened.run.n_frames - 1} of"
    qtbot.waitUntil(lambda: last in runs.frame_words.text(), timeout=WAIT_MS)


def click_row(qtbot: QtBot, runs: RunsPanel, row: int) -> None:
    place = runs.table.visualItemRect(runs.table.item(row, 0)).center()
    qtbot.mouseClick(runs.table.viewport(), LEFT, pos=QPoint(place.x(), place.y()))


def test_escape_stops_a_sweep_at_once_and_resume_completes_it(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    bench = window.session.bench
    assert bench.led_array is not None
    assert bench.stage is not None
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="4", average="2")
    press(qtbot, panel.run_bar.start_button)
    qtbot.waitUntil(lambda: len(panel.psfs.qualities) >= 1, timeout=WAIT_MS)
    with qtbot.waitSignal(window.session.stopped, timeout=WAIT_MS):
        qtbot.keyClick(window, Qt.Key.Key_Escape)
    assert bench.led_array.pattern.is_dark
    assert not bench.stage.is_moving
    qtbot.waitUntil(lambda: not panel.run.is_running, timeout=WAIT_MS)
    run = run_of(window.session.runs_folder)
    assert run.condition is RunCondition.STOPPED
    assert 0 < len(run.records) < run.n_frames
    runs = window.show_panel("runs")
    assert isinstance(runs, RunsPanel)
    qtbot.waitUntil(lambda: runs.table.rowCount() == 1, timeout=WAIT_MS)
    click_row(qtbot, runs, 0)
    qtbot.waitUntil(lambda: runs.opened is not None, timeout=WAIT_MS)
    compile(runs.as_python(), "resume", "exec")
    assert "ResumeProcedure" in runs.as_python()
    press(qtbot, runs.bar.start_button)
    with qtbot.waitSignal(runs.run.over, timeout=WAIT_MS):
        pass
    run = run_of(window.session.runs_folder)
    assert run.condition is RunCondition.COMPLETED
    assert (run.path / "calibration" / "calibration.json").is_file()


def test_abort_keeps_what_was_taken(qtbot: QtBot, window: MainWindow, panel: SweepsPanel) -> None:
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="4", average="2")
    press(qtbot, panel.run_bar.start_button)
    qtbot.waitUntil(lambda: len(panel.psfs.qualities) >= 1, timeout=WAIT_MS)
    press(qtbot, panel.run_bar.abort_button)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        pass
    run = run_of(window.session.runs_folder)
    assert run.condition is RunCondition.ABORTED
    words = panel.verdict.toPlainText()
    assert str(run.path) in words
    assert "diffuserbench resume" not in words, "the operator has no terminal"
    qtbot.waitUntil(lambda: window.status.words.text() != "Axial sweep …", timeout=WAIT_MS)
    assert window.status.words.text() == "Axial sweep: ended early"
    assert not panel.verdict.property("refused"), "what was asked for is no error"
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    press(qtbot, panel.way_on.go_on_button)
    assert panel.run_bar.pause_button.hasFocus(), "it went on to a tab"
    assert panel.no_frame.isVisible(), "nothing of the run before"
    assert not panel.frame_words.text()
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        pass
    assert run_of(window.session.runs_folder).condition is RunCondition.COMPLETED
    assert not panel.way_on.go_on_button.isVisible()
    window.session.handed_on.emit("runs", run.path)
    runs = window.show_panel("runs")
    assert isinstance(runs, RunsPanel)
    qtbot.waitUntil(lambda: runs.opened is not None and runs.opened.path == run.path, timeout=WAIT_MS)
    assert runs.table.currentRow() == 0
    qtbot.waitUntil(lambda: "µm" in runs.frame_words.text(), timeout=WAIT_MS)
    assert "_um" not in runs.frame_words.text()


def test_after_a_fault_the_way_on_is_a_button_where_it_happened(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    session = window.session
    world: Any = session.bench.shared["simulated"]
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="4", average="2")
    press(qtbot, panel.run_bar.start_button)
    qtbot.waitUntil(lambda: len(panel.psfs.qualities) >= 1, timeout=WAIT_MS)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        world.unplug("camera")
    assert "camera" in panel.verdict.toPlainText()
    assert panel.verdict.property("refused")
    assert "left" not in panel.run_bar.words.text()
    qtbot.waitUntil(lambda: not panel.run_bar.start_button.isEnabled(), timeout=WAIT_MS)
    again = panel.way_on.reconnect
    qtbot.waitUntil(again.isVisible, timeout=WAIT_MS)
    offered = panel.way_on.run
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        press(qtbot, panel.way_on.go_on_button)
    assert panel.way_on.run == offered is not None, "it is refused, and offered on"
    world.plug_in("camera")
    press(qtbot, again)
    qtbot.waitUntil(lambda: session.is_open("camera") and not again.isVisible(), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: not session.jobs.is_busy("camera"), timeout=WAIT_MS)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        press(qtbot, panel.way_on.go_on_button)
    run = run_of(session.runs_folder)
    assert run.condition is RunCondition.COMPLETED
    assert (run.path / "calibration" / "calibration.json").is_file()
    panel._failed(Ended("The stage was lost."))
    assert "nothing moves" in panel.run_bar.words.text()
    camera, light = session.bench.camera.name, session.bench.led_array.name
    for doubted, settled in ((camera, True), (f"{camera}, {light}", False)):  # the light only refused
        panel._failed(Ended(f"{MOTION_DOUBT}: {doubted} did not answer."))
        assert "may not be safe" in panel.run_bar.words.text()
        session.note_failure(DeviceError(camera, "was lost."), surely=True, was_used=True)
        assert "may not be safe" in panel.run_bar.words.text()
        qtbot.waitUntil(again.isVisible, timeout=WAIT_MS)
        press(qtbot, again)
        qtbot.waitUntil(lambda: session.is_open("camera"), timeout=WAIT_MS)
        assert ("Failed; connected again" in panel.run_bar.words.text()) is settled
        assert panel.verdict.property("refused") is not settled
        assert ("did not answer" in panel.verdict.toPlainText()) is not settled, "its cause is gone"


def answer(question: QMessageBox | None, words: str) -> Any:
    assert question is not None
    (button,) = [button for button in question.buttons() if button.text() == words]
    return button


def test_closing_during_a_run_asks_and_ends_it_safely(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    session = window.session
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="4", average="2")
    press(qtbot, panel.run_bar.start_button)
    qtbot.waitUntil(lambda: len(panel.psfs.qualities) >= 1, timeout=WAIT_MS)
    window.close()
    assert window.isVisible()
    assert window.question is not None
    (stay,) = [
        b
        for b in window.question.buttons()
        if window.question.buttonRole(b) is QMessageBox.ButtonRole.RejectRole
    ]
    qtbot.mouseClick(stay, LEFT)
    assert panel.run.is_running
    window.close()
    with qtbot.waitSignal(session.closed, timeout=WAIT_MS):
        qtbot.mouseClick(answer(window.question, "Stop and close"), LEFT)
    run = run_of(session.runs_folder)
    assert run.condition in (RunCondition.STOPPED, RunCondition.ABORTED)
    assert not any(device.is_open for device in session.bench.devices.values())


def test_a_plan_is_typed_checked_and_carried_out(qtbot: QtBot, panel: SweepsPanel) -> None:
    panel.choice.setCurrentText("Plan")
    text: Any = panel.view.widgets["text"]
    text.selectAll()
    for line in ('label = "two"', "[[parts]]", 'label = "psf"', 'light = "sauce"'):
        qtbot.keyClicks(text, line)
        qtbot.keyClick(text, Qt.Key.Key_Return)
    wait_for_check(qtbot, panel)
    assert "sauce" in panel.verdict.toPlainText()
    assert not panel.run_bar.start_button.isEnabled()
    text.setPlainText(
        'label = "two"\n[[parts]]\nlabel = "psf"\nlight = "source"\n'
        'positions = { kind = "points", points_um = [[0, 0, 8e4], [1e3, 0, 9e4]] }\n'
    )
    wait_for_check(qtbot, panel)
    assert len(panel.path.places) == 2
    press(qtbot, panel.run_bar.start_button)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        pass
    assert "completed: 2 of 2 frames" in panel.verdict.toPlainText()


def test_every_routine_can_be_reached_by_the_keyboard(qtbot: QtBot, panel: SweepsPanel) -> None:
    for number, routine in enumerate(panel.routines):
        panel.choice.setFocus()
        assert panel.choice.currentIndex() == number
        for widget in panel.view.widgets.values():
            assert widget.focusPolicy() & Qt.FocusPolicy.TabFocus, routine.name
            assert widget.accessibleName()
            assert widget.toolTip() or isinstance(widget, QWidget)
        wait_for_check(qtbot, panel)
        own = [stop for stop in stops_of(panel.window()) if panel.isAncestorOf(stop)]
        form = [panel.choice, *(stop for stop in own if panel.view.isAncestorOf(stop)), panel.verdict]
        down = [widget.mapTo(panel, widget.rect().center()).y() for widget in form]
        assert all(after > before - 5 for before, after in pairwise(down)), f"{routine.name}: Tab jumps up"
        begins = own.index(panel.choice)
        assert own[begins : begins + len(form)] == form, routine.name
        qtbot.keyClick(panel.choice, Qt.Key.Key_Down)


def test_a_sweep_that_waits_says_for_what_and_can_be_aborted(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    wait_for_check(qtbot, panel)
    gate = threading.Event()
    job = window.session.jobs.device("Homing by hand", lambda _: gate.wait(WAIT_MS / 1000), {"stage"})
    press(qtbot, panel.run_bar.start_button)
    qtbot.waitUntil(lambda: "aiting for: Homing by hand" in panel.run_bar.words.text(), timeout=WAIT_MS)
    press(qtbot, panel.run_bar.abort_button)
    assert not panel.run.is_running
    assert not job.is_over
    gate.set()
    wait_for_check(qtbot, panel)
    assert panel.run_bar.start_button.isEnabled()


def test_tab_goes_through_all_of_the_window_beside_a_picture(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    panel._show_image(np.ones((8, 8), np.uint16))
    panel.choice.setFocus()
    stops = list(stops_of(window))
    assert panel.frame.graphics in stops
    for key in (Qt.Key.Key_Tab, Qt.Key.Key_Backtab):
        seen = set()
        for _ in stops:
            qtbot.keyClick(QApplication.focusWidget(), key)
            seen.add(QApplication.focusWidget())
        assert seen == set(stops)


def test_a_pause_that_is_not_yet_says_so(panel: SweepsPanel) -> None:
    bar = panel.run_bar
    bar.set_running(True)
    bar.pause_button.setChecked(True)
    bar.show_situation(Situation(step="finding exposures"))
    assert bar.words.text() == "Finding exposures, WILL PAUSE as soon as it can"
    bar.show_situation(Situation(step="sweeping", paused=True))
    assert "WILL" not in bar.words.text()
    bar.set_running(False)


def test_a_form_is_checked_again_after_somebody_elses_run(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    wait_for_check(qtbot, panel)
    gate = threading.Event()
    job = window.session.exclusive_job("Another's run", lambda _: gate.wait(WAIT_MS / 1000))
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="4")
    assert not panel.run_bar.start_button.isEnabled()
    gate.set()
    qtbot.waitUntil(lambda: job.is_over and panel.run_bar.start_button.isEnabled(), timeout=WAIT_MS)
    assert panel.outlook is not None


def test_a_run_is_read_outside_the_windows_thread_and_a_damaged_one_told(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = []

    def damaged(path: Path) -> None:
        threads.append(threading.current_thread())
        raise OSError(f"{path} is damaged")

    monkeypatch.setattr("gui.run_looks.Run.open", damaged)
    runs = window.show_panel("runs")
    assert isinstance(runs, RunsPanel)
    runs.open_run(tmp_path)
    qtbot.waitUntil(lambda: "is damaged" in runs.about.toPlainText(), timeout=WAIT_MS)
    assert threads[0] is not threading.main_thread()
    assert runs.opened is None


def test_what_was_said_of_other_values_does_not_stay_while_a_check_takes_its_time(
    qtbot: QtBot, panel: SweepsPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="1")
    assert "number of planes is 1" in panel.verdict.toPlainText()
    gate = threading.Event()
    real = SweepProcedure.outlook

    def slowly(*given: Any) -> Any:
        gate.wait(WAIT_MS / 1000)
        return real(*given)

    monkeypatch.setattr(SweepProcedure, "outlook", slowly)
    field: Any = panel.view.widgets["planes"]
    field.selectAll()
    qtbot.keyClicks(field, "4")
    qtbot.waitUntil(lambda: "being checked" in panel.verdict.toPlainText(), timeout=WAIT_MS)
    assert not panel.verdict.property("refused")
    gate.set()
    wait_for_check(qtbot, panel)
    assert panel.outlook is not None


def test_a_folder_in_which_nothing_can_be_kept_is_told_before_anything_moves(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    folder = window.session.runs_folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.write_text("a file where the runs' folder should be")
    enter(qtbot, panel, z_min_um="60", z_max_um="150", planes="4")
    assert "is a file, not a folder" in panel.verdict.toPlainText()
    assert not panel.run_bar.start_button.isEnabled()
    folder.unlink()
    enter(qtbot, panel, planes="3")
    assert panel.run_bar.start_button.isEnabled()


def test_another_routines_form_is_made_while_the_window_answers(
    qtbot: QtBot, panel: SweepsPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gui.making._SLICE_S", 0.0)  # a fast machine makes it in one slice
    panel.choice.setCurrentIndex(panel.choice.findText("Angular response"))
    assert not panel.views.is_whole("angular"), "made in one go"
    assert not panel.run_bar.start_button.isEnabled()
    qtbot.waitUntil(lambda: panel.views.is_whole("angular"), timeout=WAIT_MS)
    qtbot.waitUntil(panel.run_bar.start_button.isEnabled, timeout=WAIT_MS)
    panel.choice.setCurrentIndex(panel.choice.findText("Bead slides"))
    assert panel.view.values() is not None, "whole for who asks"


def test_frames_of_patterned_light_lead_to_their_picture_in_files(
    qtbot: QtBot, window: MainWindow, panel: SweepsPanel
) -> None:
    panel.choice.setCurrentIndex(list(panel.routines).index(ILLUMINATION))
    qtbot.waitUntil(lambda: panel.views.is_whole("illumination"), timeout=WAIT_MS)
    panel.view.set_values({"lattice": 1, "exposure_ms": 5.0})
    qtbot.waitUntil(panel.run_bar.start_button.isEnabled, timeout=WAIT_MS)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        press(qtbot, panel.run_bar.start_button)
    assert panel.use_button.isVisible()
    press(qtbot, panel.use_button)
    qtbot.waitUntil(lambda: "tasks" in window.maker.panels, timeout=WAIT_MS)
    tasks = window.maker.panels["tasks"]
    assert isinstance(tasks, TasksPanel)
    qtbot.waitUntil(lambda: "patterned" in tasks._pages and not tasks._given, timeout=WAIT_MS)
    (run,) = window.session.runs_folder.glob("*active-illumination")
    assert tasks._pages["patterned"].form.value("run") == run


def test_a_form_that_nothing_was_typed_into_asks_for_what_it_needs_and_is_not_red(
    qtbot: QtBot, panel: SweepsPanel
) -> None:
    panel.choice.setCurrentIndex(list(panel.routines).index(ILLUMINATION))
    qtbot.waitUntil(lambda: "Lattice" in panel.verdict.toPlainText(), timeout=WAIT_MS)
    assert not panel.verdict.property("refused")
    assert not any(map(panel.view.reason, panel.view.fields))
    assert not panel.run_bar.start_button.isEnabled()
    panel.view.set_values({"lattice": 2, "pattern": "half"})
    qtbot.waitUntil(lambda: bool(panel.view.reason("groups")), timeout=WAIT_MS)
    assert panel.verdict.property("refused")
    panel.view.set_values({"lattice": None, "pattern": None})
    qtbot.waitUntil(lambda: not panel.verdict.property("refused"), timeout=WAIT_MS)
