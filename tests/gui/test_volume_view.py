"""A volume in the window: from any side, plane by plane by keys, regions of it measured."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QPointF, Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from gui.jobs import JobRunner
from gui.panel import whole
from gui.theme import THEMES, contrast
from gui.widgets.turning_view import _ink
from gui.widgets.volume_view import VolumeView
from instrument.reconstruction.rendering import Renderer
from instrument.volumes.source import volume_in_memory
from recon.camera.grid import Grid, metric_volume
from tests.gui.conftest import WAIT_MS


def test_a_volume_is_turned_stepped_through_and_measured(
    qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    voxels = np.zeros((8, 30, 40), np.float32)
    voxels[5, 10:20, 10:30] = 3.0
    jobs = JobRunner()
    view = whole(VolumeView(jobs))
    qtbot.addWidget(view)
    view.resize(600, 500)
    view.show()
    grid = Grid(voxels.shape, (15, 20), np.linspace(1e4, 2e4, 8), np.full(8, 25.0))
    view.open(volume_in_memory(voxels, Path("volume.npy")), grid)
    assert not view.tools.proportions.isEnabled()  # its voxels are of one size
    qtbot.waitUntil(lambda: view.projections is not None, timeout=WAIT_MS)
    reading = threading.Event()
    read = Renderer.of
    monkeypatch.setattr(Renderer, "of", lambda *given: reading.wait(30) and read(*given))
    view.set_mode("turning")
    canvas = view.turning.canvas
    qtbot.waitUntil(lambda: canvas._front is not None, timeout=WAIT_MS)
    assert canvas._front is not None
    assert canvas._front.shape == (30, 40, 3)
    assert canvas._front[15, 20].max() > 0, "the front is there until all planes are read"
    assert canvas.grab().toImage().pixelColor(canvas.rect().center()).value() > 100
    reading.set()
    qtbot.waitUntil(lambda: canvas.pixels is not None and canvas.pixels.max() > 0, timeout=WAIT_MS)
    assert canvas._front is None
    assert "red 20 mm" in view.turning.legend.text()
    assert canvas.pitch_um == 25.0
    before, azimuth = view.images["depth"].copy(), canvas.pose.azimuth_deg
    QTest.keyClick(canvas, Qt.Key.Key_Right)
    assert canvas.pose.azimuth_deg == azimuth + 5
    qtbot.waitUntil(lambda: not np.array_equal(view.images["depth"], before), timeout=WAIT_MS)
    QTest.keyClick(canvas, Qt.Key.Key_Space)
    assert view.turning.turn_button.isChecked()

    view.set_mode("slices")
    view.go_to(4, 15, 20)
    view.slider.setFocus()
    QTest.keyClick(view.slider, Qt.Key.Key_PageDown)
    assert view.point[0] == 5
    qtbot.waitUntil(lambda: view.slices["z"].index == 5, timeout=WAIT_MS)
    view.tools.measure.setChecked(True)
    view.measure._dragged(QPointF(12, 12), QPointF(21, 16))
    assert "10 x 5 at 12, 12 pixels (250 µm x 125 µm): mean 3" in view.measured.text()
    assert "most along depth at plane 6" in view.measured.text()
    view.go_to(3, 15, 20)  # nothing is there
    qtbot.waitUntil(lambda: "mean 0," in view.measured.text(), timeout=WAIT_MS)
    assert view.measured.text().startswith("plane 4,"), "the figures are those of the plane in front"
    assert view._titles[3].text() == "mean of the region along depth"
    view.set_mode("brightest")
    assert view.measured.text().startswith("brightest over depth, 10 x 5 at 12, 12")
    assert "mean 3" in view.measured.text()
    view.set_mode("slices")
    view.tools.measure.setChecked(False)
    assert not view.measure.regions
    assert view.measured.isHidden()
    assert "along depth at" in view._titles[3].text(), "no figures of a region that is gone"
    view.release()
    qtbot.waitUntil(lambda: not jobs.jobs, timeout=WAIT_MS)


def test_a_perspective_volume_is_shown_in_true_proportions(qtbot: QtBot) -> None:
    z_um = np.linspace(1e4, 2e4, 6)
    voxels = np.random.default_rng(0).random((6, 30, 40), np.float32)
    grid = Grid(voxels.shape, (15, 20), z_um, 2e-3 * z_um)
    metric, on = metric_volume(voxels, grid)
    jobs = JobRunner()
    view = whole(VolumeView(jobs))
    qtbot.addWidget(view)
    view.resize(700, 500)
    view.show()
    source = volume_in_memory(voxels, Path("volume.npy"))
    closed: list[bool] = []
    source.close = lambda: closed.append(True)  # type: ignore[method-assign]

    def shows(front: np.ndarray) -> bool:
        return view.projections is not None and np.allclose(view.projections.front, front, atol=1e-5)

    view.open(source, grid)
    assert view.tools.proportions.isChecked()
    qtbot.waitUntil(lambda: shows(metric.max(axis=0)), timeout=WAIT_MS)
    assert view.bar.bar.text.textItem.toPlainText() == "200 µm"  # a quarter is 400
    assert view.bar.bar.size * on.pitch_um[0] == pytest.approx(200)
    across, down = view.top.box.viewPixelSize()
    assert down / across == pytest.approx(on.pitch_um[0] / on.spacing_um[0], rel=0.02)
    view.set_mode("turning")
    qtbot.waitUntil(lambda: view.turning.renderer is not None, timeout=WAIT_MS)
    assert view.turning.canvas.pitch_um == on.pitch_um[0]
    assert view.turning.renderer.scale[0] == pytest.approx(on.spacing_um[0] / on.pitch_um[0])
    view.set_mode("slices")
    view.go_to(3, 10, 12)
    qtbot.waitUntil(lambda: "y" in view.slices and view.slices["y"].index == 10, timeout=WAIT_MS)
    np.testing.assert_allclose(view.slices["y"].pixels, metric[:, 10], atol=1e-5)
    view.set_mode("turning")
    view.tools.proportions.click()
    qtbot.waitUntil(lambda: shows(voxels.max(axis=0)), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: view.turning.renderer is not None, timeout=WAIT_MS)
    assert view.turning.renderer.shape == voxels.shape
    assert not closed
    view.release()
    qtbot.waitUntil(lambda: not jobs.jobs, timeout=WAIT_MS)
    assert closed == [True]
    assert not view.tools.proportions.isEnabled()


@pytest.mark.parametrize("theme", list(THEMES))
def test_scale_bar_and_axes_are_read_on_black_in_every_theme(
    theme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gui.widgets.turning_view.colours", lambda: THEMES[theme])
    assert contrast(_ink().name(), "#000000") > 4.5
