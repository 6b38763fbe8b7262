"""Results that are opened: their views, levels, export."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
from PySide6.QtCore import Qt
from PySide6.QtGui import QTextTable
from PySide6.QtWidgets import QApplication, QFileDialog
from pytestqt.qtbot import QtBot

from gui import making
from gui.forms.reconstruct import SoFar
from gui.panels.reconstructions import ReconstructionsPanel
from gui.theme import TURN, apply_theme, change_theme
from gui.widgets.dialogues import Question
from gui.widgets.entry import Refusing
from gui.widgets.result_views import FactsView
from instrument.files.images import read_image, write_image
from instrument.reconstruction.stored_result import open_result
from instrument.volumes.source import VolumeSource

WAIT_MS = 60_000


def test_export_writes_values_and_views(qtbot: QtBot, panel: ReconstructionsPanel, tmp_path) -> None:
    picture = np.random.default_rng(0).random((20, 30), np.float32)
    write_image(tmp_path / "p.tif", picture)
    voxels = np.random.default_rng(0).random((4, 20, 30), np.float32)
    np.save(tmp_path / "v.npy", voxels)

    def export(name: str) -> None:
        job = panel.export.to(tmp_path / name)
        with qtbot.waitSignal(job.succeeded, timeout=WAIT_MS):
            pass

    panel.open(tmp_path / "p.tif")
    qtbot.waitUntil(lambda: panel.result is not None, timeout=WAIT_MS)
    turns = {action.text(): action for action in panel.picture.turn.menu().actions()}
    turns["As on the sensor"].trigger()
    turns["Turn left"].trigger()
    turns["Mirror left and right"].trigger()
    export("out.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.rot90(picture)[:, ::-1])
    export("out.png")
    assert read_image(tmp_path / "out.png").pixels.shape == (30, 20, 3)
    panel.open(tmp_path / "v.npy")
    qtbot.waitUntil(lambda: panel.volume.projections is not None, timeout=WAIT_MS)
    export("out.tif")
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "out.tif"), voxels)
    export("out.ome.zarr")
    copy = open_result(tmp_path / "out.ome.zarr")
    np.testing.assert_array_equal(copy.volume.plane(2), voxels[2])
    export("view.png")
    names = sorted(p.name for p in tmp_path.glob("view-*.png"))
    assert names == ["view-depth.png", "view-front.png", "view-side.png", "view-top.png"]
    job = panel.export.to(tmp_path / "out.tif")
    with qtbot.waitSignal(job.failed, timeout=WAIT_MS):
        pass
    assert "exists already" in panel._note.toolTip()


@pytest.mark.parametrize("opened_during", ["the name", "the question"])
def test_another_result_is_not_exported_under_the_name_of_the_first(
    qtbot: QtBot, panel: ReconstructionsPanel, tmp_path, opened_during: str
) -> None:
    for name in ("first", "second"):
        write_image(tmp_path / f"{name}.tif", np.random.default_rng(0).random((20, 30), np.float32))
    target = tmp_path / "target.tif"
    target.write_bytes(b"kept")

    def show(name: str) -> None:
        panel.open(tmp_path / f"{name}.tif")
        qtbot.waitUntil(lambda: panel.result is not None and panel.result.path.stem == name, timeout=WAIT_MS)

    show("first")
    qtbot.mouseClick(panel.export_button, Qt.MouseButton.LeftButton)
    (dialogue,) = panel.findChildren(QFileDialog)
    if opened_during == "the name":
        show("second")
    dialogue.fileSelected.emit(str(target))
    dialogue.close()
    if opened_during == "the question":
        qtbot.waitUntil(lambda: bool(panel.findChildren(Question)), timeout=WAIT_MS)
        (question,) = panel.findChildren(Question)
        show("second")
        (replace,) = (button for button in question.buttons() if button.text() == "Replace")
        qtbot.mouseClick(replace, Qt.MouseButton.LeftButton)
    assert not panel.findChildren(Question) or opened_during == "the question"
    assert "first.tif is not open any more" in panel._note.toolTip()
    assert not any(job.title.startswith("Exporting") for job in panel.session.jobs.jobs)
    assert target.read_bytes() == b"kept"


def test_the_views_exported_are_those_that_were_asked_about(
    qtbot: QtBot, panel: ReconstructionsPanel, tmp_path
) -> None:
    np.save(tmp_path / "v.npy", np.random.default_rng(0).random((4, 20, 30), np.float32))
    panel.open(tmp_path / "v.npy")
    qtbot.waitUntil(lambda: panel.volume.projections is not None, timeout=WAIT_MS)
    (tmp_path / "view-front.png").write_bytes(b"old")
    qtbot.mouseClick(panel.export_button, Qt.MouseButton.LeftButton)
    (dialogue,) = panel.findChildren(QFileDialog)
    dialogue.fileSelected.emit(str(tmp_path / "view.png"))
    dialogue.close()
    qtbot.waitUntil(lambda: bool(panel.findChildren(Question)), timeout=WAIT_MS)
    (question,) = panel.findChildren(Question)
    panel.volume.set_mode("slices")  # by a key, behind the question
    (replace,) = (button for button in question.buttons() if button.text() == "Replace")
    qtbot.mouseClick(replace, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: len(list(tmp_path.glob("view-*.png"))) == 4, timeout=WAIT_MS)
    names = sorted(p.name for p in tmp_path.glob("view-*.png"))
    assert names == ["view-depth.png", "view-front.png", "view-side.png", "view-top.png"]
    qtbot.waitUntil(lambda: not panel.session.jobs.jobs, timeout=WAIT_MS)
    assert read_image(tmp_path / "view-front.png").pixels.shape == (20, 30, 3)


def test_a_picture_in_the_making_does_not_cover_a_result_that_was_opened_meanwhile(
    qtbot: QtBot, panel: ReconstructionsPanel, tmp_path
) -> None:
    write_image(tmp_path / "first.tif", np.random.default_rng(0).random((20, 30), np.float32))
    prepared = SimpleNamespace(notes={"Model": "convolution"}, warnings=(), simulated=False)
    so_far = SoFar(0.5, "half", prepared, np.ones((9, 9), np.float32), ())
    panel._progressed(so_far, volume=False)
    assert panel.picture.shown.shape == (9, 9)
    panel.open(tmp_path / "first.tif")
    panel._progressed(so_far, volume=False)  # also while it is being opened
    qtbot.waitUntil(lambda: panel.result is not None, timeout=WAIT_MS)
    panel._progressed(so_far, volume=False)
    assert panel.picture.shown.shape == (20, 30)
    assert "first.tif" in panel.heading.text()


def test_what_is_known_of_a_picture_in_the_making_is_said_in_the_forms_words(
    panel: ReconstructionsPanel,
) -> None:
    notes = {"Dark": "31.9 counts (estimated; a frame or counts may be given by --dark)"}
    prepared = SimpleNamespace(notes=notes, warnings=("Try --erasures none.",), simulated=False)
    panel._show_nothing("photo.tif is being read …", busy=True)
    panel._progressed(SoFar(0.0, "Solving …", prepared), volume=False)
    assert "--" not in panel.facts.toPlainText()
    assert "may be given by “Dark”" in panel.facts.toPlainText()
    assert "Try “Erasures” none." in panel.facts.toPlainText()
    assert "being read" not in panel.empty.words.text()


def test_levels_by_typing_and_automatic(qtbot: QtBot, panel: ReconstructionsPanel, tmp_path) -> None:
    write_image(tmp_path / "p.tif", np.linspace(0, 10, 400, dtype=np.float32).reshape(20, 20))
    panel.open(tmp_path / "p.tif")
    qtbot.waitUntil(lambda: panel.result is not None, timeout=WAIT_MS)
    bar = panel.picture.levels
    assert bar.levels == (0.0, pytest.approx(10, rel=0.01))
    bar.high.selectAll()
    qtbot.keyClicks(bar.high, "5")
    qtbot.keyClick(bar.high, Qt.Key.Key_Return)
    assert bar.levels == (0.0, 5.0)
    bar.low.selectAll()
    qtbot.keyClicks(bar.low, "7")
    qtbot.keyClick(bar.low, Qt.Key.Key_Return)
    assert bar.levels == (0.0, 5.0)
    assert bar.low.property("refused")
    qtbot.mouseClick(bar.auto, Qt.MouseButton.LeftButton)
    assert bar.levels[1] == pytest.approx(10, rel=0.01)


def test_no_voxel_is_read_in_the_windows_thread(
    qtbot: QtBot, panel: ReconstructionsPanel, tmp_path, monkeypatch
) -> None:
    voxels = np.random.default_rng(0).random((6, 64, 48), np.float32)
    np.save(tmp_path / "v.npy", voxels)
    threads: set[str] = set()
    for name in ("plane", "across_y", "across_x"):
        read = getattr(VolumeSource, name)

        def watched(self, index, read=read):
            threads.add(threading.current_thread().name)
            return read(self, index)

        monkeypatch.setattr(VolumeSource, name, watched)
    panel.open(tmp_path / "v.npy")
    view = panel.volume
    qtbot.waitUntil(lambda: view.projections is not None, timeout=WAIT_MS)
    qtbot.mouseClick(view.tools.modes["slices"], Qt.MouseButton.LeftButton)
    view.go_to(5, 9, 8)
    at = {"z": 5, "y": 9, "x": 8}
    qtbot.waitUntil(lambda: {a: s.index for a, s in view.slices.items()} == at, timeout=WAIT_MS)
    assert threads
    assert threading.main_thread().name not in threads


def test_another_volume_ends_the_reading_of_the_first(
    qtbot: QtBot, panel: ReconstructionsPanel, tmp_path
) -> None:
    first, second = (np.full((4, 8, 8), value, np.float32) for value in (1, 2))
    np.save(tmp_path / "a.npy", first)
    np.save(tmp_path / "b.npy", second)
    panel.open(tmp_path / "a.npy")
    panel.open(tmp_path / "b.npy")
    qtbot.waitUntil(lambda: panel.volume.projections is not None, timeout=WAIT_MS)
    assert panel.result.path.name == "b.npy"
    assert panel.volume.projections.front.max() == 2
    panel.shutdown()
    qtbot.waitUntil(lambda: not panel.jobs.jobs, timeout=WAIT_MS)


def test_the_red_theme_shows_nothing_but_red(
    qtbot: QtBot, panel: ReconstructionsPanel, tmp_path, qapp: QApplication
) -> None:
    np.save(tmp_path / "v.npy", np.random.default_rng(0).random((4, 40, 40), np.float32))
    panel.open(tmp_path / "v.npy")
    qtbot.waitUntil(lambda: panel.volume.coloured.image is not None, timeout=WAIT_MS)
    before = panel.volume.coloured.image
    try:
        list(change_theme("red", panel, [panel]))
        # One that was begun in the colours before may come in between.
        qtbot.waitUntil(lambda: not panel.volume.coloured.image[..., 1:].any(), timeout=WAIT_MS)
        shown = panel.volume.coloured.image
        assert shown is not before
        assert shown[..., 0].max() > 0.5
        image = panel.volume.front.grab().toImage()
        middle = image.pixelColor(image.width() // 2, image.height() // 2)
        assert middle.red() >= middle.green() == middle.blue() == 0
    finally:
        apply_theme(qapp, "dark")


def test_what_is_empty_says_what_will_stand_there(qtbot: QtBot, panel: ReconstructionsPanel) -> None:
    qtbot.waitUntil(panel.results.none.isVisible, timeout=WAIT_MS)
    assert not panel.convergence.plot.isVisible()  # an empty plot's numbers would mean nothing
    assert panel.convergence.legend.text() == "How it was solved is drawn here."
    assert not panel.facts.toPlainText()
    assert panel.facts.placeholderText()


def test_a_field_that_marked_itself_is_unmarked_by_the_panel(panel: ReconstructionsPanel) -> None:
    entry = panel.form.options.widgets["image"]
    assert isinstance(entry, Refusing)
    tip = entry.toolTip()
    entry.refuse("There is no such file.")
    panel.refused(entry, "There is no such file.")
    panel.accepted(entry)
    assert not entry.property("refused")
    assert entry.toolTip() == tip


def test_a_slice_ends_where_a_part_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(making, "_SLICE_S", 1e6)  # no time ends it before
    parts = iter((None, TURN, None))
    making.take_slice(parts)
    assert list(parts) == [None]


def test_facts_stand_below_their_names_where_these_leave_no_room(qtbot: QtBot) -> None:
    view = FactsView()
    qtbot.addWidget(view)
    view.resize(600, 200)
    view.show()
    view.show_facts([("Seen (computed) at 40 mm", "PSNR 21.3 dB"), ("Light", "12 % reaches the field")])

    def columns() -> int:
        (table,) = view.document().rootFrame().childFrames()
        assert isinstance(table, QTextTable)
        return table.columns()

    assert columns() == 2
    view.resize(260, 200)
    qtbot.waitUntil(lambda: columns() == 1)
    assert "Seen (computed) at 40 mm\nPSNR 21.3 dB" in view.toPlainText()
    view.resize(600, 200)
    qtbot.waitUntil(lambda: columns() == 2)
