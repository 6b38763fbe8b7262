"""The live reconstruction beside the live view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels.live_reconstruction import LiveReconstructionPanel
from gui.session import BenchSession
from instrument.calibration_file import save_calibration
from recon.types import Calibration

WAIT_MS = 40_000


def measure_psf(session: BenchSession, folder: Path) -> Path:
    """Photograph the point source and save it as a calibration, with the live view held."""
    bench = session.bench
    with session.live.paused():
        bench.scene_off()
        bench.source_off()
        dark = bench.snap(4).image.astype(np.float32)
        bench.source_on()
        psf = np.clip(bench.snap(4).image - dark.mean() - 3, 0, None)
        bench.source_off()
        bench.scene_on()
    calibration = Calibration(psf[None, None].astype(np.float32), np.array([[0.0, 0.0, 1e5]]), dark[None])
    return save_calibration(calibration, folder)


@pytest.fixture
def panel(qtbot: QtBot, window: MainWindow, tmp_path: Path) -> LiveReconstructionPanel:
    session = window.session
    qtbot.waitUntil(lambda: not session.jobs.device_jobs, timeout=WAIT_MS)
    folder = measure_psf(session, tmp_path / "calibration")
    panel = window.show_panel("live_reconstruction")
    assert isinstance(panel, LiveReconstructionPanel)
    panel.file.setText(str(folder))
    qtbot.keyClick(panel.file, Qt.Key.Key_Return)
    return panel


def test_the_newest_frame_is_reconstructed_and_the_camera_is_not_held_up(
    qtbot: QtBot, window: MainWindow, panel: LiveReconstructionPanel
) -> None:
    qtbot.waitUntil(lambda: "latency" in panel.status.text(), timeout=WAIT_MS)
    first = panel._shown
    qtbot.waitUntil(lambda: panel._shown is not first, timeout=WAIT_MS)
    assert panel.view.image is not None
    assert float(panel.view.image.std()) > 0
    assert window.session.live.status().dropped == 0


def test_it_follows_a_stream_that_was_interrupted(
    qtbot: QtBot, window: MainWindow, panel: LiveReconstructionPanel
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    shown = panel._shown
    job = window.session.exclusive_job("A run", lambda _: window.session.bench.snap())
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    stream = panel.follower._stream
    qtbot.waitUntil(lambda: panel.follower._stream is not stream, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: panel._shown is not shown, timeout=WAIT_MS)


def test_frames_that_do_not_fit_the_calibration_are_told(
    qtbot: QtBot, window: MainWindow, panel: LiveReconstructionPanel
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    window.session.camera_job("bin", lambda camera: camera.set_binning(2), idle=True)
    qtbot.waitUntil(lambda: "120" in panel.status.text(), timeout=WAIT_MS)
    window.session.camera_job("bin", lambda camera: camera.set_binning(1), idle=True)
    qtbot.waitUntil(lambda: "latency" in panel.status.text(), timeout=WAIT_MS)


def test_refining_holds_its_picture_until_the_preview_is_wanted_again(
    qtbot: QtBot, panel: LiveReconstructionPanel
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    qtbot.mouseClick(panel.refine_button, Qt.MouseButton.LeftButton)
    assert "End" in panel.refine_button.text()
    qtbot.wait(300)
    qtbot.mouseClick(panel.refine_button, Qt.MouseButton.LeftButton)  # enough: what there is is shown
    qtbot.waitUntil(lambda: "Refined" in panel.status.text(), timeout=WAIT_MS)
    held = panel.view.image
    qtbot.wait(200)
    assert panel.view.image is held
    qtbot.mouseClick(panel.refine_button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "latency" in panel.status.text(), timeout=WAIT_MS)


def test_a_folder_without_a_calibration_is_refused_at_the_field(
    qtbot: QtBot, panel: LiveReconstructionPanel, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    panel.file.setText(str(tmp_path / "empty"))
    qtbot.keyClick(panel.file, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: "no calibration" in panel.file.toolTip(), timeout=WAIT_MS)
