"""A full round by mouse alone: calibrate, photograph, reconstruct, on the simulated bench."""

from __future__ import annotations

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from drivers.simulated.world import SimulatedWorld
from gui.main_window import MainWindow
from gui.panels.reconstructions import ReconstructionsPanel
from gui.panels.runs import RunsPanel
from gui.panels.sweeps import SweepsPanel
from instrument.files.images import read_image

LEFT = Qt.MouseButton.LeftButton
WAIT_MS = 120_000


@pytest.fixture
def bench_text() -> str:
    return """
[bench]
name = "test bench"
data_folder = "runs"
[camera]
driver = "simulated"
exposure_ms = 20.0
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
time_scale = 0
scene = "picture"
scene_distance_mm = 100
"""


def click_tab(qtbot: QtBot, window: MainWindow, name: str) -> None:
    bar = window.tabs.tabBar()
    index = window.tabs.indexOf(window._places[name])
    qtbot.mouseClick(bar, LEFT, pos=bar.tabRect(index).center())


def choose(qtbot: QtBot, panel: SweepsPanel, name: str) -> None:
    """Choose a routine in the drop-down list by two clicks.

    The list is asked for anew after every wait: it is Qt's own, and PySide takes what it holds of it for
    deleted when another part of the window goes, as "Opening ..." does where a panel takes its place.
    """
    qtbot.mouseClick(panel.choice, LEFT)
    qtbot.waitUntil(lambda: panel.choice.view().isVisible())
    qtbot.wait(QApplication.doubleClickInterval() + 50)  # a list takes no click sooner
    row = [routine.name for routine in panel.routines].index(name)
    popup = panel.choice.view()
    place = popup.visualRect(panel.choice.model().index(row, 0)).center()
    qtbot.mouseMove(popup.viewport(), place)
    qtbot.mouseClick(popup.viewport(), LEFT, pos=place)
    qtbot.waitUntil(lambda: panel.routine.name == name)


@pytest.mark.slow
def test_calibrate_photograph_and_reconstruct_by_mouse_alone(qtbot: QtBot, window: MainWindow) -> None:
    session = window.session
    # Calibrate: the form begins with depths that the stage reaches; nothing is typed.
    click_tab(qtbot, window, "sweeps")
    sweeps = window.panel("sweeps")
    assert isinstance(sweeps, SweepsPanel)
    qtbot.waitUntil(lambda: sweeps.run_bar.start_button.isEnabled(), timeout=WAIT_MS)
    qtbot.mouseClick(sweeps.run_bar.start_button, LEFT)
    with qtbot.waitSignal(sweeps.run.over, timeout=WAIT_MS):
        pass
    assert "1 PSF good" in sweeps.verdict.toPlainText(), sweeps.verdict.toPlainText()
    qtbot.mouseClick(sweeps.use_button, LEFT)
    reconstructions = window.panel("reconstructions")
    assert isinstance(reconstructions, ReconstructionsPanel)
    assert window.tabs.currentWidget() is window._places["reconstructions"]
    # Photograph the scene: another routine of the same panel.
    click_tab(qtbot, window, "sweeps")
    choose(qtbot, sweeps, "photograph")
    qtbot.waitUntil(lambda: sweeps.run_bar.start_button.isEnabled(), timeout=WAIT_MS)
    qtbot.mouseClick(sweeps.run_bar.start_button, LEFT)
    with qtbot.waitSignal(sweeps.run.over, timeout=WAIT_MS):
        pass
    (file,) = session.runs_folder.glob("*_photograph/photograph.tif")
    photograph = read_image(file).pixels
    qtbot.mouseClick(sweeps.use_button, LEFT)
    # Reconstruct it.
    qtbot.mouseClick(reconstructions.form.start, LEFT)
    assert reconstructions.job is not None, reconstructions._note.text()
    qtbot.waitUntil(lambda: reconstructions.result is not None, timeout=WAIT_MS)
    assert reconstructions.viewers.currentWidget() is reconstructions.picture
    assert reconstructions.result is not None
    found = read_image(reconstructions.result.path).pixels.astype(float)
    world, geometry = session.bench.shared["simulated"], session.bench.geometry
    assert isinstance(world, SimulatedWorld)
    assert geometry.pixel_pitch_um is not None
    truth = world.ground_truth(photograph.shape, geometry.pixel_pitch_um)
    assert found.shape == truth.shape
    assert np.corrcoef(found.ravel(), truth.ravel())[0, 1] > 0.7  # the photograph itself: about 0
    assert abs(np.corrcoef(photograph.ravel(), truth.ravel())[0, 1]) < 0.5
    # On the sensor's grid it is upside down, as in any camera; it is shown as people would see the scene.
    shown = reconstructions.picture.shown
    assert shown is not None
    assert np.corrcoef(shown.ravel(), truth[::-1, ::-1].ravel())[0, 1] > 0.7
    assert "light: scene, SIMULATED, turned 180°" in reconstructions.caption.text()
    # The photograph stands in Runs, says what its frames are, and goes to be reconstructed from there, too.
    click_tab(qtbot, window, "runs")
    runs = window.panel("runs")
    assert isinstance(runs, RunsPanel)
    qtbot.waitUntil(lambda: runs.table.rowCount() == 2, timeout=WAIT_MS)
    for row, name, words in ((1, "axial-sweep", "(psf)"), (0, "photograph", "(scene)")):
        place = runs.table.visualItemRect(runs.table.item(row, 0)).center()
        qtbot.mouseClick(runs.table.viewport(), LEFT, pos=place)
        qtbot.waitUntil(lambda words=words: words in runs.frame_words.text(), timeout=WAIT_MS)  # type: ignore[misc]
        assert runs.opened is not None
        assert runs.opened.path.name.endswith(name)
        assert not runs.bar.words.text(), "how another run ended"
        runs.bar.show_end("Done", complete=True)
    handed: list[object] = []
    session.handed_on.connect(lambda *what: handed.extend(what))
    qtbot.mouseClick(runs.use_button, LEFT)
    assert handed == ["reconstructions", file]
    # One bit of a frame flips: Verify finds it, and both the list and the run itself say so.
    assert runs.opened is not None
    assert runs.opened.run is not None
    chunk = runs.opened.run.array.chunk_path(0)
    image = bytearray(chunk.read_bytes())
    image[len(image) // 2] ^= 1
    chunk.write_bytes(image)
    assert runs.about.toPlainText().startswith("completed: ")
    qtbot.mouseClick(runs.verify_button, LEFT)
    qtbot.waitUntil(lambda: runs.table.item(0, 1).text() == "completed, DAMAGED", timeout=WAIT_MS)
    taken = len(runs.opened.run.records)
    assert runs.about.toPlainText().splitlines()[:2] == [
        f"completed, DAMAGED: {taken} of {taken} frames taken  SIMULATED",
        f"{taken - 1} of {taken} frames read back are as they were written",
    ], "as if all were damaged"
