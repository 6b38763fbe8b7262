"""A volume in the window: from any side, plane by plane by keys, regions of it measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PySide6.QtCore import QPointF, Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from gui.jobs import JobRunner
from gui.widgets.volume_view import VolumeView
from instrument.files.volumes import volume_in_memory
from tests.gui.conftest import WAIT_MS


def test_a_volume_is_turned_stepped_through_and_measured(qtbot: QtBot) -> None:
    voxels = np.zeros((8, 30, 40), np.float32)
    voxels[5, 10:20, 10:30] = 3.0
    jobs = JobRunner()
    view = VolumeView(jobs)
    qtbot.addWidget(view)
    view.resize(600, 500)
    view.show()
    planes_um = np.linspace(1e4, 2e4, 8), np.full(8, 25.0)
    view.open(volume_in_memory(voxels, Path("volume.npy")), planes_um)
    qtbot.waitUntil(lambda: view.projections is not None, timeout=WAIT_MS)
    view.set_mode("turning")
    canvas = view.turning.canvas
    qtbot.waitUntil(lambda: canvas.pixels is not None and canvas.pixels.max() > 0, timeout=WAIT_MS)
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
    view.measure_button.setChecked(True)
    view.measure._dragged(QPointF(12, 12), QPointF(21, 16))
    assert "10 x 5 at 12, 12 pixels (250 µm x 125 µm): mean 3" in view.measured.text()
    assert "most along depth at plane 6" in view.measured.text()
    view.measure_button.setChecked(False)
    assert not view.measure.regions
    view.release()
    qtbot.waitUntil(lambda: not jobs.jobs, timeout=WAIT_MS)
