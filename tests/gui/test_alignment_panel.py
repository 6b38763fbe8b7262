"""The mask's alignment by mouse on a small simulated display."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor
from pytestqt.qtbot import QtBot

from calibration_routines.display.mask_alignment import AlignmentReport
from calibration_routines.procedure import Outcome
from gui.main_window import MainWindow
from gui.panels.alignment import AlignmentPanel, DisplacementPlot
from gui.procedure_run import ProcedureRun, RunBar, Situation
from gui.session import BenchSession
from gui.theme import RED
from instrument.bench.config_file import template
from recon.holography.pose import NODES, Pose

LEFT = Qt.MouseButton.LeftButton
WAIT_MS = 160_000
QUICK = {"spots": "25", "refinements": "2", "section_pictures": "2"}
SMALL = {
    "shape": "[120, 160]",
    "shift_um": "[6.0, -4.0]",
    "z_um": "60.0",
    "roll_mrad": "0.5",
    "pitch_mrad": "0.0",
    "yaw_mrad": "0.0",
    "magnification": "0.0005",
    "relay_distortion_um": "0.0",
}


@pytest.fixture
def bench_text() -> str:
    text = template("display")
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
    qtbot.mouseClick(panel.view.more, LEFT)
    for name, text in numbers.items():
        field: Any = panel.view.widgets[name]
        qtbot.mouseClick(field, LEFT)
        field.selectAll()
        qtbot.keyClicks(field, text)
    qtbot.wait(1)
    qtbot.waitUntil(lambda: panel.is_settled, timeout=WAIT_MS)
    qtbot.mouseClick(panel.run_bar.start_button, LEFT)
    assert panel.run.is_running


def test_an_alignment_shows_spots_and_scores_and_can_be_aborted(qtbot: QtBot, panel: AlignmentPanel) -> None:
    begin(qtbot, panel, reach="8", depth_um="100", **QUICK)
    qtbot.waitUntil(lambda: len(panel._brightest) >= 2 or not panel.run.is_running, timeout=WAIT_MS)
    assert panel.run.is_running, panel.verdict.toPlainText()
    qtbot.mouseClick(panel.run_bar.abort_button, LEFT)
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        pass
    assert "aborted" in panel.verdict.toPlainText()
    assert not panel.session.bench.scene_lit
    assert not list(panel.session.runs_folder.glob("*.json"))
    assert panel._tried
    assert panel.spots.image is not None
    newest = panel.spots.image
    qtbot.mouseClick(panel.before_button, LEFT)
    assert not np.array_equal(panel.spots.image, newest)
    compile(panel.as_python(), "alignment", "exec")


def test_frames_and_time_that_are_bounds_are_shown_as_bounds(
    qtbot: QtBot, make_session: Callable[[], BenchSession]
) -> None:
    bar = RunBar(ProcedureRun(make_session()), "Start")
    qtbot.addWidget(bar)
    assert "Ctrl+Enter" in bar.start_button.toolTip()
    bar.show_situation(Situation("aligning the mask", 20, 100, at_most=True, seconds_left=80))
    assert "20 of at most 100" in bar.words.text()
    assert "at most" in bar.words.text().split(", ")[-1]
    bar.show_situation(Situation("sweep", 20, 100, seconds_left=80))
    assert "at most" not in bar.words.text()


def test_a_report_shows_displacement_and_pose_with_errors(qtbot: QtBot, panel: AlignmentPanel) -> None:
    error = np.array([0.02, 0.02, 0.1, 1e-4, 0.0, 12.0, 4.0, 4.0])
    report = AlignmentReport(
        pose=Pose(shift_x=0.01, shift_y=-0.02, roll_mrad=0.1, z_um=-9.0),
        error=error,
        rest=np.zeros((*NODES, 2)),
        efficiency=0.87,
        psnr_lost_db=0.5,
        repeatability_db=float("nan"),
        found_at=Pose(shift_x=8.0, shift_y=-6.0, roll_mrad=3.0),
        directions={},
        frames=40,
        mask_shape=(240, 320),
        camera=None,  # type: ignore[arg-type]  # not shown
        brightness_per_ms=1.0,
    )
    panel.finished(Outcome(("Aligned",), good=True, result=report))
    assert panel.pose.table.item(0, 0).text() == "+8"
    assert panel.pose.table.item(0, 1).text() == "+0.01"
    assert panel.pose.table.item(5, 2).text() == "12"
    assert "10.0" in panel.before.title
    assert "0.03" in panel.after.title
    qtbot.mouseClick(panel.tabs.tabBar(), LEFT, pos=panel.tabs.tabBar().tabRect(2).center())
    assert panel.pose.isVisible()


def test_arrows_that_were_drawn_take_over_the_theme(qtbot: QtBot, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = DisplacementPlot("Before")
    qtbot.addWidget(drawn.plot)
    drawn.show_field(np.ones((3, 4, 2)), (30, 40))
    monkeypatch.setattr("gui.theme._now", [RED])
    drawn.restyle()
    assert drawn._arrows.curve.opts["pen"].color() == QColor(RED.accent)
    brushes = [spot.brush().color() for spot in drawn._tails.scatter.points()]
    assert brushes == [QColor(RED.text)] * 12
