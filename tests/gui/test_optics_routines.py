"""Diffuser surface and bead slides, carried out from the window on the benches that they are for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PySide6.QtCore import Qt
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels.sweeps import SweepsPanel
from instrument.bench.config_file import template
from instrument.files.calibration_file import load_calibration

LEFT = Qt.MouseButton.LeftButton
WAIT_MS = 120_000
"""Against a hang, not a slow machine."""
MICROSCOPE = template("led_microscope").replace("pixels = 384", "pixels = 96")
SLIDES = """
[bench]
data_folder = "runs"
[camera]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "microscope"
scene = "beads"
beads = 4
aperture_mm = [0.3, 0.3]
lenslet_um = 100
time_scale = 0
"""


@pytest.fixture
def bench_text(request: pytest.FixtureRequest) -> str:
    """The bench that the test names."""
    return str(request.param)


def carry_out(qtbot: QtBot, window: MainWindow, name: str, **numbers: str) -> SweepsPanel:
    """Choose a routine, fill in its form, start it, and wait for its end."""
    panel = window.show_panel("sweeps")
    assert isinstance(panel, SweepsPanel)
    panel.choice.setCurrentIndex([routine.name for routine in panel.routines].index(name))
    for field_name, text in numbers.items():
        field: Any = panel.view.widgets[field_name]
        if not field.isVisible():
            qtbot.mouseClick(panel.view.more, LEFT)
        qtbot.mouseClick(field, LEFT)
        field.selectAll()
        qtbot.keyClicks(field, text)
    qtbot.wait(1)
    qtbot.waitUntil(lambda: panel.is_settled, timeout=WAIT_MS)
    assert panel.run_bar.start_button.isEnabled(), panel.verdict.toPlainText()
    with qtbot.waitSignal(panel.run.over, timeout=WAIT_MS):
        qtbot.mouseClick(panel.run_bar.start_button, LEFT)
    return panel


@pytest.mark.parametrize("bench_text", [MICROSCOPE], indirect=True, ids=["microscope"])
def test_the_diffusers_surface(qtbot: QtBot, window: MainWindow) -> None:
    panel = carry_out(qtbot, window, "dpc", average="1", dark_frames="1")
    assert "µm rms" in panel.verdict.toPlainText()
    (picture,) = window.session.runs_folder.glob("*/*.png")
    assert picture.stat().st_size > 1000
    assert window.session.bench.led_array is not None
    assert window.session.bench.led_array.pattern.is_dark


@pytest.mark.parametrize("bench_text", [SLIDES], indirect=True, ids=["slides"])
def test_bead_slides(qtbot: QtBot, window: MainWindow) -> None:
    panel = carry_out(
        qtbot, window, "beads",
        images="2", average="1", binning="16", grid="1x1", rank="1", iterations="3",
    )  # fmt: skip
    assert "Misfit by rank" in panel.verdict.toPlainText()
    (folder,) = (path.parent for path in window.session.runs_folder.glob("*/calibration.json"))
    made = load_calibration(folder)
    assert len(made.psfs) == 1
    assert panel.use_button.isVisible()
    assert not window.session.bench.scene_lit


@pytest.mark.parametrize("bench_text", [SLIDES], indirect=True, ids=["no-screen"])
def test_pairs_of_files_need_no_screen_and_hide_what_is_for_the_bench(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    for number in range(2):
        for kind in ("raw", "truth"):
            np.save(tmp_path / f"{kind}_{number}.npy", rng.random((16, 20), np.float32))
    panel = carry_out(qtbot, window, "screen", pairs=str(tmp_path), gamma="1")
    assert not panel.view.widgets["pictures"].isVisible()
    assert "unexplained" in panel.verdict.toPlainText()
    (folder,) = (path.parent for path in window.session.runs_folder.glob("*/calibration.json"))
    assert load_calibration(folder).psfs.shape == (1, 1, 16, 20)
    assert panel.use_button.isVisible()
    assert "OfFiles(" in panel.as_python()
