"""The mask's alignment by mouse on a small simulated display."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from PySide6.QtCore import Qt
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels.alignment import AlignmentPanel
from instrument.alignment_file import load_alignment
from instrument.config_file import display_text

LEFT = Qt.MouseButton.LeftButton
WAIT_MS = 120_000
SMALL = {
    "shape": "[200, 280]",
    "shift_um": "[31.0, -42.0]",
    "z_um": "60.0",
    "roll_mrad": "1.0",
    "pitch_mrad": "0.0",
    "yaw_mrad": "0.0",
    "magnification": "0.001",
    "relay_distortion_um": "0.0",
}


@pytest.fixture
def bench_text() -> str:
    text = display_text()
    for key, value in SMALL.items():
        text = re.sub(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
    return text


@pytest.fixture
def panel(qtbot: QtBot, window: MainWindow) -> AlignmentPanel:
    panel = window.show_panel("alignment")
    assert isinstance(panel, AlignmentPanel)
    qtbot.waitUntil(lambda: panel.outlook is not None, timeout=WAIT_MS)
    return panel


def begin(qtbot: QtBot, panel: AlignmentPanel, **numbers: str) -> None:
    for name, text in numbers.items():
        field: Any = panel.view.widgets[name]
        qtbot.mouseClick(field, LEFT)
        field.selectAll()
        qtbot.keyClicks(field, text)
    qtbot.wait(1)
    qtbot.waitUntil(lambda: not panel._rest.isActive() and panel._check_job is None, timeout=WAIT_MS)
    qtbot.mouseClick(panel.run_bar.start_button, LEFT)
    assert panel.run.is_running


@pytest.mark.slow
def test_an_alignment_shows_spots_scores_displacement_and_pose(qtbot: QtBot, panel: AlignmentPanel) -> None:
    begin(qtbot, panel, reach="8", depth_um="100", moves="0", rows="2", columns="3")
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        pass
    assert "Aligned with" in panel.verdict.toPlainText(), panel.verdict.toPlainText()
    report = panel.pose.report
    assert report is not None
    (file,) = panel.session.runs_folder.glob("*_alignment.json")
    kept = load_alignment(file)
    assert panel.pose.table.item(0, 1).text() == f"{kept.pose.shift_x:+.4g}"
    assert "rms" in panel.before.title
    assert "rms" in panel.after.title
    assert panel.spots.image is not None
    after = panel.spots.image
    qtbot.mouseClick(panel.before_button, LEFT)
    assert not np.array_equal(panel.spots.image, after)
    assert len(panel._brightest) > 10
    assert panel._brightest[-1] > panel._brightest[0]


def test_an_alignment_can_be_aborted(qtbot: QtBot, panel: AlignmentPanel) -> None:
    begin(qtbot, panel, reach="24", depth_um="300")
    qtbot.waitUntil(lambda: len(panel._brightest) >= 1, timeout=WAIT_MS)
    qtbot.mouseClick(panel.run_bar.abort_button, LEFT)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        pass
    assert "aborted" in panel.verdict.toPlainText()
    assert not panel.session.bench.scene_lit
    assert not list(panel.session.runs_folder.glob("*.json"))
