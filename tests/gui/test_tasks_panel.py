"""What is done with files: every task has its form, its progress and its results in the window."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PySide6.QtCore import Qt
from PySide6.QtGui import QImage, QPixmap
from PySide6.QtWidgets import QTableWidget, QWidget
from pytestqt.qtbot import QtBot

from gui.jobs import JobCancelledError
from gui.panel import whole
from gui.panels.tasks import TasksPanel
from gui.session import BenchSession
from gui.session_news import OwnFiles
from gui.widgets.picture import LargePicture
from gui.widgets.tab_order import stops_of
from instrument.files.calibration_file import save_calibration
from instrument.files.images import write_image
from instrument.files.results import free_result
from instrument.reconstruction.video_files import VideoPictures, create_output
from instrument.tasks import TASKS
from instrument.tasks.task import Desk, Done
from recon.types import Calibration, Geometry
from tests.gui.conftest import BENCH, WAIT_MS
from tests.gui.looks import SIZES, cut_off


@pytest.fixture
def panel(qtbot: QtBot, make_session: Callable[[], BenchSession]) -> TasksPanel:
    """The panel without a bench that is open."""
    panel = whole(TasksPanel(make_session()))
    qtbot.addWidget(panel)
    return panel


def shown(qtbot: QtBot, panel: TasksPanel, name: str, **values: object) -> None:
    """Choose a task and wait for its form."""
    panel.choose(name, **values)
    start = panel.run_bar.start_button  # once Tab knows the form, too
    qtbot.waitUntil(lambda: name in panel._pages and not panel._given and start.isEnabled(), timeout=WAIT_MS)


def calibration(folder: Path, seed: int) -> Path:
    """Save a calibration of one PSF; another seed is another diffuser's."""
    psf = np.random.default_rng(seed).random((1, 1, 48, 48), np.float32) ** 8
    geometry = Geometry(pixel_pitch_um=10.0, diffuser_distance_mm=5.0)
    return save_calibration(Calibration(psf, np.array([(0.0, 0.0, 2e4)]), geometry=geometry), folder)


def test_a_long_form_is_made_in_many_turns(
    qtbot: QtBot, panel: TasksPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gui.making._SLICE_S", 0.0)
    turns: list[None] = []
    panel._making.timeout.connect(lambda: turns.append(None))
    shown(qtbot, panel, "video")
    assert len(turns) > len(panel._pages["video"].form.fields)


def test_a_task_that_is_started_at_once_waits_for_a_name_that_no_file_has(
    qtbot: QtBot, panel: TasksPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = panel.session.runs_folder / "results"
    results.mkdir(parents=True)
    (results / "analysis.png").write_bytes(b"of before")
    looked, started = threading.Event(), list[object]()

    def slow(*asked: Any) -> Path:
        looked.wait(30)
        return free_result(*asked)

    monkeypatch.setattr("gui.forms.options_form.free_result", slow)
    monkeypatch.setattr(panel.run, "start", lambda *_: started.append(panel._out))
    shown(qtbot, panel, "analyze", calibration=calibration(results.parent / "mine", 0))
    panel.start()
    assert not started
    looked.set()
    qtbot.waitUntil(lambda: bool(started), timeout=WAIT_MS)
    assert started == [results / "analysis-2.png"]


def test_every_task_has_a_form_of_its_own_declarations(qtbot: QtBot, panel: TasksPanel) -> None:
    panel.resize(SIZES["1366x768"].width() - 480, 600)  # beside the live reconstruction
    panel.show()
    for name in TASKS:
        shown(qtbot, panel, name)
        panel._pages[name].form.set_values({"bench": None})
        form = panel._pages[name].form
        offered = {o.name for _, options in panel._pages[name].task.parts.values() for o in options}
        assert {n for n in offered if n in form.fields} == set(form.fields)
        assert all(field.tip for field in form.fields.values())
        qtbot.waitUntil(lambda form=form: not list(cut_off(form)), timeout=WAIT_MS)  # a layout settles
        told = [
            form.widgets[n].toolTip() + getattr(form.widgets[n], "placeholderText", str)()
            for n in form.fields
        ]
        assert not [words for words in told if "--" in words], "fields are called by their labels"
        needed = panel._pages[name].task.needed
        required = [
            n
            for n, field in form.fields.items()
            if (field.option.is_required or n in needed) and not field.option.words and field.read()[1]
        ]
        assert panel.objects() is None if required else panel.objects() is not None
        assert panel.as_python().startswith("#") == bool(required)

    def inside_form() -> list[QWidget]:
        return [stop for stop in stops_of(panel) if form.isAncestorOf(stop)]

    qtbot.waitUntil(lambda: len(inside_form()) > 1, timeout=WAIT_MS)  # Qt shows new parts a turn later
    stops, inside = list(stops_of(panel)), inside_form()
    begins = stops.index(panel.choice) + 1
    assert stops[begins : begins + len(inside)] == inside, "Tab goes from the choice into the form"


def test_what_is_exported_is_turned_as_it_is_seen(qtbot: QtBot, panel: TasksPanel, tmp_path: Path) -> None:
    picture = np.arange(12, dtype=np.float32).reshape(3, 4)
    write_image(tmp_path / "result.tif", picture)
    create_output(tmp_path / "film.ome.zarr", 1, (32, 32), period_s=0.1, grid=None, attributes={})
    bright = np.zeros((32, 32), np.float32)
    bright[:4] = 1
    VideoPictures(tmp_path / "film.ome.zarr", write=True).write(0, bright)
    for what, target in (("result.tif", "copy.npy"), ("film.ome.zarr", "copy.gif")):
        shown(qtbot, panel, "export", run=tmp_path / what)
        panel._pages["export"].form.set_values({"out": tmp_path / target})
        with qtbot.waitSignal(panel.run.succeeded, timeout=WAIT_MS):
            panel.run_bar.start_button.click()
        qtbot.waitUntil(lambda: not panel.run.is_running, timeout=WAIT_MS)
    np.testing.assert_array_equal(np.load(tmp_path / "copy.npy"), picture[::-1, ::-1])
    with Image.open(tmp_path / "copy.gif") as gif:
        rows = np.asarray(gif.convert("L")).mean(axis=1)
    assert rows[-4:].min() > rows[:-4].max()


def test_what_was_found_comes_to_the_front_and_a_picture_when_there_is_one(
    qtbot: QtBot, panel: TasksPanel, tmp_path: Path
) -> None:
    old, new = calibration(tmp_path / "old", 0), calibration(tmp_path / "new", 1)
    shown(qtbot, panel, "compare", old=old, new=new, figure=tmp_path / "page.png")
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        panel.start()
    qtbot.waitUntil(lambda: panel.found.results.currentWidget() is panel.found.picture, timeout=WAIT_MS)
    go = threading.Event()
    late = QImage(str(tmp_path / "page.png"))
    panel.found._reader.ask(lambda: late if go.wait(WAIT_MS / 1000) else None, panel.found._show_picture)
    shown(qtbot, panel, "etendue")
    go.set()
    qtbot.waitUntil(lambda: not panel.found._reader.is_reading, timeout=WAIT_MS)
    assert panel.found.picture.pixmap.isNull(), "a picture of the task before"
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        panel.start()
    assert panel.found.results.currentIndex() == 0, "its table, and no place for a picture that there is not"
    assert panel.found._tables.count()


def test_forms_begin_with_the_newest_calibration_and_a_place_for_the_result(
    qtbot: QtBot, panel: TasksPanel
) -> None:
    runs = panel.session.runs_folder
    newest = calibration(runs / "2026-11-25_21-38-03_axial-sweep" / "calibration", 0)
    shown(qtbot, panel, "refocus")
    form = panel._pages["refocus"].form
    qtbot.waitUntil(lambda: form.fields["calibration"].raw() == str(newest), timeout=WAIT_MS)
    assert "axial-sweep, the newest of this bench" in panel.run_bar.words.text()
    assert form.value("out") == runs / "results" / "refocus"
    shown(qtbot, panel, "analyze", calibration=runs.parent / "mine")
    qtbot.waitUntil(lambda: panel._newest._job is None, timeout=WAIT_MS)
    assert panel._pages["analyze"].form.fields["calibration"].raw() == str(runs.parent / "mine")
    shown(qtbot, panel, "video", run=runs / "2026-11-25_21-40-00_recording")  # by a PSF or a calibration
    video = panel._pages["video"].form.fields["calibration"]
    qtbot.waitUntil(lambda: video.raw() == str(newest), timeout=WAIT_MS)
    shown(qtbot, panel, "activity", video=runs / "results" / "video.ome.zarr")  # reconstructed already
    activity = panel._pages["activity"].form.fields["calibration"]
    qtbot.waitUntil(lambda: panel._newest._job is None, timeout=WAIT_MS)
    assert not activity.raw()
    panel.choose("activity", video=runs / "2026-11-25_21-40-00_recording")
    qtbot.waitUntil(lambda: activity.raw() == str(newest), timeout=WAIT_MS)
    form = panel._pages["activity"].form
    form.set_values({"calibration": None, "video": None})
    qtbot.waitUntil(lambda: panel._newest._job is None, timeout=WAIT_MS)
    form.set_values({"video": runs / "2026-11-25_21-40-00_recording"})  # typed in the form
    qtbot.waitUntil(lambda: activity.raw() == str(newest), timeout=10_000)


def test_a_hologram_of_spots_is_previewed_and_goes_on_to_the_slm(qtbot: QtBot, panel: TasksPanel) -> None:
    assert panel.session.config.path is not None
    panel.session.config.path.write_text(BENCH)
    shown(qtbot, panel, "spots", spots="2x2", iterations=2)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        panel.start()
    pattern = panel.session.runs_folder / "results" / "slm.png"
    assert panel.found.files[0] == pattern, panel.found.words.toPlainText()
    handed: list[object] = []
    panel.session.handed_on.connect(lambda *what: handed.extend(what))
    qtbot.mouseClick(panel.found.use_button, Qt.MouseButton.LeftButton)
    assert handed == ["slm", pattern]
    panel.found.list.itemActivated.emit(panel.found.list.item(0))
    assert handed == ["slm", pattern] * 2


def test_a_film_that_is_imported_goes_on_to_films(qtbot: QtBot, panel: TasksPanel, tmp_path: Path) -> None:
    np.save(tmp_path / "film.npy", np.ones((3, 8, 9), np.uint16))
    told = {"frames_per_s": 10.0, "pixel_um": 5.0}
    shown(qtbot, panel, "import", film=tmp_path / "film.npy", out=tmp_path / "mine", **told)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        panel.start()
    (made,) = (tmp_path / "mine").iterdir()
    assert panel.found.files == (made,), panel.found.words.toPlainText()
    handed: list[object] = []
    panel.session.handed_on.connect(lambda *what: handed.extend(what))
    qtbot.mouseClick(panel.found.use_button, Qt.MouseButton.LeftButton)
    assert handed == ["films", made]


def test_two_calibrations_are_compared_with_table_and_python_beside_the_form(
    qtbot: QtBot, panel: TasksPanel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = calibration(tmp_path / "old", 0), calibration(tmp_path / "new", 1)
    shown(qtbot, panel, "compare", old=old, new=new, out=tmp_path / "found.json")
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        panel.start()
    assert "RECALIBRATE" in panel.found.words.toPlainText()
    assert panel.found.words.property("refused")  # seen without being read
    assert panel.found._tables.count() == 1
    assert panel.found.files == (tmp_path / "found.json",)
    exec(panel.as_python().replace("found.json", "again.json"), {})
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "found.json").read_bytes()
    assert "RECALIBRATE" in capsys.readouterr().out
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        panel.start()  # the file is there now
    assert "exists" in panel.found.words.toPlainText()
    assert not panel.found.files
    assert panel.run_bar.words.text()
    shown(qtbot, panel, "refocus")
    qtbot.waitUntil(lambda: not panel.run_bar.words.text(), timeout=WAIT_MS)  # it was another task's
    assert not panel.found.words.toPlainText()  # and so was what it found
    assert not panel.found._tables.count()


@pytest.mark.parametrize("name", ["video", "patterned", "activity"])
def test_what_reconstructs_recordings_can_be_asked_for(
    qtbot: QtBot, panel: TasksPanel, tmp_path: Path, name: str
) -> None:
    given = dict.fromkeys(("run", "patterned", "video"), tmp_path)
    given["calibration"] = calibration(tmp_path / "c", 0)
    shown(qtbot, panel, name)
    fields = panel._pages[name].form.fields
    panel._pages[name].form.set_values(
        {**{n: value for n, value in given.items() if n in fields}, "out": tmp_path / "out.ome.zarr"}
    )
    assert panel.objects() is not None, panel._note.text()
    assert "carry_out" in panel.as_python()


def test_a_picture_in_patterned_light_is_opened_as_a_result(
    qtbot: QtBot, panel: TasksPanel, tmp_path: Path
) -> None:
    shown(qtbot, panel, "patterned")
    panel._out = tmp_path / "patterned.tif"
    panel._succeeded(Done((panel._out, tmp_path / "patterned.json")))
    handed: list[object] = []
    panel.session.handed_on.connect(lambda *what: handed.extend(what))
    qtbot.mouseClick(panel.found.use_button, Qt.MouseButton.LeftButton)
    assert handed == ["reconstructions", OwnFiles(result=panel._out)]


def test_a_task_waits_ends_and_keeps_what_it_can(qtbot: QtBot, panel: TasksPanel) -> None:
    counted, go = [0], threading.Event()

    def counts(desk: Desk) -> Done:
        with desk.interruptible() as cancel, desk.step("counting", 10) as advance:
            go.wait(WAIT_MS / 1e3)
            while not cancel.is_set():
                counted[0] += 1
                advance(counted[0])
        return Done(kept="ended: kept")

    run = panel.run
    run.start("Counting", counts)
    run.pause()  # before its job has begun
    go.set()
    qtbot.waitUntil(lambda: counted[0] == 1, timeout=WAIT_MS)
    with qtbot.waitSignal(run.looked, check_params_cb=lambda now: now.paused, timeout=WAIT_MS):
        pass
    assert counted[0] == 1
    with qtbot.waitSignal(run.succeeded, timeout=WAIT_MS) as ended:
        run.abort()  # which lets it go on, to its end
    assert ended.args[0].kept

    def hard(desk: Desk) -> Done:
        while True:
            desk.say("counting")
            time.sleep(0.01)

    run.start("Counting", hard)
    panel.run_bar.set_running(True)
    qtbot.waitUntil(lambda: run._desk is not None, timeout=WAIT_MS)
    with qtbot.waitSignal(run.ended_early, timeout=WAIT_MS):
        panel.run_bar.abort_button.click()
        assert not panel.run_bar.abort_button.isEnabled()
        panel.run_bar.show_situation(run._desk.situation)  # type: ignore[union-attr]
        assert "ENDING" in panel.run_bar.words.text()
        run.abort()
        run.pause()  # of what is ended: it does not wait
    assert not panel.found.words.property("refused"), "a deliberate end is no error"
    assert issubclass(JobCancelledError, KeyboardInterrupt)  # what a task in the terminal sees


def test_the_field_of_view_is_told_in_a_table_that_fits_a_small_screen(
    qtbot: QtBot, panel: TasksPanel
) -> None:
    panel.resize(SIZES["1366x768"].width() - 480, 600)  # beside the live reconstruction
    panel.show()
    shown(qtbot, panel, "etendue")
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        panel.start()
    (table,) = panel.found.tables.findChildren(QTableWidget)
    assert table.columnCount() == 6
    form_px = panel.stack.width()
    qtbot.waitUntil(lambda: table.isVisible() and not table.horizontalScrollBar().maximum(), timeout=WAIT_MS)
    assert panel.stack.width() < form_px
    shown(qtbot, panel, "spots")
    assert panel.stack.width() == form_px, "it was lent until something else is shown"


def test_a_border_that_was_moved_stays_where_it_was_put(qtbot: QtBot, panel: TasksPanel) -> None:
    panel.resize(SIZES["1366x768"].width() - 480, 600)
    panel.show()
    shown(qtbot, panel, "etendue")
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        panel.start()
    form_px = panel.stack.width()
    qtbot.waitUntil(lambda: panel.stack.width() < form_px, timeout=WAIT_MS)
    across = panel._across
    across.moveSplitter(across.sizes()[0] + 20, 1)  # as the mouse does
    put = across.sizes()
    shown(qtbot, panel, "spots")
    assert across.sizes() == put


def test_an_error_goes_when_a_field_is_mended_and_moves_no_button(qtbot: QtBot, panel: TasksPanel) -> None:
    panel.resize(860, 600)
    panel.show()
    shown(qtbot, panel, "stability", names=("lihgt",))
    start = panel.run_bar.start_button
    place = start.mapTo(panel, start.rect().topLeft())
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        qtbot.mouseClick(start, Qt.MouseButton.LeftButton)
    assert "Did you mean 'light'?" in panel.found.words.toPlainText()
    assert panel.found.words.property("refused")
    assert panel.run_bar.words.text() == "There is no map 'lihgt'.", "all of it stands beside the form"
    qtbot.wait(20)
    assert start.mapTo(panel, start.rect().topLeft()) == place, "who presses it again must not miss it"
    field: Any = panel._pages["stability"].form.widgets["names"]
    field.setFocus()
    field.selectAll()
    qtbot.keyClicks(field, "light")
    qtbot.keyClick(field, Qt.Key.Key_Tab)
    assert not panel.found.words.property("refused")
    assert not panel.found.words.toPlainText()
    assert not panel.run_bar.words.text()


def test_the_keyboard_stays_where_the_work_is(qtbot: QtBot, panel: TasksPanel) -> None:
    panel.show()
    panel.activateWindow()
    shown(qtbot, panel, "verify")
    bar = panel.run_bar
    bar.start_button.setFocus()
    qtbot.waitUntil(bar.start_button.hasFocus, timeout=WAIT_MS)
    bar.set_running(True)
    assert bar.pause_button.hasFocus()
    bar.abort_button.setFocus()
    bar.set_running(False)
    assert bar.start_button.hasFocus(), "it went to wherever Tab goes on from a button that is off"


def test_a_picture_takes_of_the_forms_width_and_is_shown_larger(
    qtbot: QtBot, panel: TasksPanel, tmp_path: Path
) -> None:
    panel.resize(SIZES["1366x768"].width() - 480, 600)
    panel.show()
    shown(qtbot, panel, "optics")
    form_px, chart = panel.stack.width(), tmp_path / "optics.png"
    write_image(chart, np.full((600, 700, 3), 200, np.uint8))
    panel._succeeded(Done((chart,)))
    picture = panel.found.picture
    qtbot.waitUntil(lambda: not picture.pixmap.isNull() and panel.stack.width() < form_px, timeout=WAIT_MS)
    shown(qtbot, panel, "refocus")
    assert panel.stack.width() == form_px
    assert picture.show_larger() is None, "there is none"
    shown(qtbot, panel, "analyze")
    panel._succeeded(Done((chart,)))
    qtbot.waitUntil(lambda: panel.found.results.currentWidget() is picture, timeout=WAIT_MS)
    qtbot.wait(20)
    assert not list(cut_off(panel._pages["analyze"].form)), "its words need the width"
    panel.found.clear()

    picture.show_pixmap(QPixmap(1400, 1300))
    panel.found.results.setCurrentWidget(picture)
    for opens in (
        lambda: qtbot.mouseClick(picture, Qt.MouseButton.LeftButton),
        lambda: qtbot.keyClick(picture, Qt.Key.Key_Return),
    ):
        opens()
        opens()  # as by a double click, or as it is forgotten behind this window
        (window,) = picture.findChildren(LargePicture)
        assert not window.isModal(), "STOP takes clicks beside it"
        assert window.picture.width() > picture.width()
        assert window.picture.show_larger() is None
        window.reject()
        qtbot.waitUntil(lambda: not picture.findChildren(LargePicture), timeout=WAIT_MS)
