"""The live reconstruction beside the live view."""

from __future__ import annotations

import re
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PySide6.QtCore import Qt
from pytestqt.qtbot import QtBot

import gui.panels.live_reconstruction as live_reconstruction
from gui.main_window import MainWindow
from gui.panels.live import LivePanel
from gui.panels.live_reconstruction import LiveReconstructionPanel
from gui.session import BenchSession
from instrument.files.calibration_file import load_calibration, save_calibration
from recon.camera.transformed import Transformation, transformed
from recon.errors import InputError
from recon.streams import fit
from recon.streams.fit import NOT_JUDGED
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
    # With its first frame the live view lights the scene where it is dark: not after a test has put it out.
    live = window.show_panel("live")
    assert isinstance(live, LivePanel)
    qtbot.waitUntil(lambda: live.picture.frame is not None and not session.jobs.device_jobs, timeout=WAIT_MS)
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
    shown, stream = panel._shown, panel.follower._stream
    job = window.session.exclusive_job("A run", lambda _: window.session.bench.snap())
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: panel.follower._stream is not stream, timeout=WAIT_MS)
    qtbot.waitUntil(lambda: panel._shown is not shown, timeout=WAIT_MS)


def test_a_picture_of_a_saturated_frame_says_so(
    qtbot: QtBot, window: MainWindow, panel: LiveReconstructionPanel
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    window.session.bench.camera.set_exposure_ms(300.0)
    qtbot.waitUntil(lambda: "of its frame's pixels are saturated" in panel.view.caution, timeout=WAIT_MS)
    window.session.bench.camera.set_exposure_ms(10.0)
    qtbot.waitUntil(lambda: "saturated" not in panel.view.caution, timeout=WAIT_MS)


def test_a_picture_of_noise_is_called_so_by_its_own_frame_and_an_old_one_old(
    qtbot: QtBot, window: MainWindow, panel: LiveReconstructionPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged, check = threading.Event(), fit.check_calibration
    monkeypatch.setattr(
        fit, "check_calibration", lambda *a, **b: judged.wait(WAIT_MS / 1000) and check(*a, **b)
    )
    panel.run_button.setChecked(False)
    panel.run_button.setChecked(True)
    qtbot.waitUntil(lambda: panel.view.caution.startswith(NOT_JUDGED), timeout=WAIT_MS)
    judged.set()
    qtbot.waitUntil(lambda: not panel.view.caution, timeout=WAIT_MS)
    session = window.session
    session.bench.scene_off()
    qtbot.waitUntil(lambda: panel.view.caution.startswith("Dark"), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: panel.status.text().endswith("passed over"), timeout=WAIT_MS)  # said once
    assert panel.view.image is not None
    assert not panel.view.image.any(), "noise that is stretched looks like a picture"
    session.bench.scene_on()
    qtbot.waitUntil(lambda: not panel.view.caution, timeout=WAIT_MS)
    held = threading.Event()
    job = session.exclusive_job("A run", lambda _: held.wait(WAIT_MS / 1000))
    qtbot.waitUntil(lambda: panel.view.caution.startswith("Old picture"), timeout=WAIT_MS)
    held.set()
    qtbot.waitUntil(lambda: job.is_over and not panel.view.caution, timeout=WAIT_MS)
    monkeypatch.setattr("gui.live_doubts._PATIENCE_S", 0.3)
    session.camera_job("Trigger", lambda camera: camera.set_trigger_mode("software"), idle=True)
    qtbot.waitUntil(
        lambda: session.live.stream is not None and panel.view.caution.startswith("Old picture: no frame"),
        timeout=WAIT_MS,
    )
    panel.run_button.setChecked(False)
    assert panel.view.caution == "Old picture: the preview is off"


def test_in_the_dark_nothing_is_painted_that_did_not_change(
    qtbot: QtBot, window: MainWindow, panel: LiveReconstructionPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    window.session.bench.scene_off()
    qtbot.waitUntil(lambda: panel.view.caution.startswith("Dark"), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: panel.status.text().endswith("passed over"), timeout=WAIT_MS)
    monkeypatch.setattr(live_reconstruction, "_TELL_S", WAIT_MS)
    painted: list[object] = []
    show, tell, see = panel.view.item.setImage, panel.status.setText, panel._show_picture
    seen: list[object] = []
    monkeypatch.setattr(panel, "_show_picture", lambda image: (seen.append(image), see(image)))
    monkeypatch.setattr(panel.view.item, "setImage", lambda *a, **k: (painted.append(a), show(*a, **k)))
    monkeypatch.setattr(panel.status, "setText", lambda words: (painted.append(words), tell(words)))
    qtbot.waitUntil(lambda: len(seen) > 3, timeout=WAIT_MS)
    assert not painted
    monkeypatch.setattr(live_reconstruction, "_TELL_S", 0.0)
    qtbot.waitUntil(lambda: bool(painted), timeout=WAIT_MS)
    window.session.bench.scene_on()
    qtbot.waitUntil(lambda: not panel.view.caution and len(painted) > 4, timeout=WAIT_MS)
    assert panel.view.item.image.any(), "what is lit is painted"


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


def test_refining_tells_how_long_it_takes_at_most(
    qtbot: QtBot, panel: LiveReconstructionPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    told: list[str] = []
    heard = threading.Event()
    real = live_reconstruction.LiveReconstructor.full

    def not_over_before_it_is_heard(*args: Any, on_progress: Any, **options: Any) -> Any:
        def watch(*record: Any) -> None:
            on_progress(*record)
            heard.wait(WAIT_MS / 1000)

        return real(*args, on_progress=watch, **options)

    def listen(so_far: Any) -> None:
        panel._refined_so_far(so_far)
        told.append(panel.status.text())
        heard.set()

    monkeypatch.setattr(live_reconstruction.LiveReconstructor, "full", not_over_before_it_is_heard)
    qtbot.mouseClick(panel.refine_button, Qt.MouseButton.LeftButton)
    assert panel._refining is not None
    panel._refining.progressed.connect(listen)
    qtbot.waitUntil(lambda: bool(told) or panel._refining is None, timeout=WAIT_MS)
    assert told, panel.status.text()
    assert re.fullmatch(r"Refining: iteration \d+ of at most 200, at most [\d.]+ (s|min|h) left", told[0])
    if panel._refining is not None:
        panel.refine()
    qtbot.waitUntil(lambda: panel._refining is None, timeout=WAIT_MS)


def test_a_folder_without_a_calibration_is_refused_at_the_field(
    qtbot: QtBot, panel: LiveReconstructionPanel, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    panel.file.setText(str(tmp_path / "empty"))
    qtbot.keyClick(panel.file, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: "no calibration" in panel.file.toolTip(), timeout=WAIT_MS)


def test_of_depths_chosen_in_quick_succession_the_last_is_shown(
    qtbot: QtBot, panel: LiveReconstructionPanel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = load_calibration(tmp_path / "calibration")
    places = np.array([[0.0, 0.0, z_um] for z_um in (1e5, 2e5, 3e5)])
    three = Calibration(np.repeat(one.psfs, 3, axis=0), places, one.background)
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    panel.file.setText(str(save_calibration(three, tmp_path / "three")))
    panel.load()
    qtbot.waitUntil(lambda: panel.z_um == 2e5 and panel._loading is None, timeout=WAIT_MS)
    made: dict[Any, float] = {}
    real = live_reconstruction.LiveReconstructor

    def slow_at_first(calibration: Calibration, options: Any, live: Any) -> Any:
        reconstructor = real(calibration, options, live)
        time.sleep(0.6 if options.z_um == 1e5 else 0.0)
        made[reconstructor] = options.z_um
        return reconstructor

    monkeypatch.setattr(live_reconstruction, "LiveReconstructor", slow_at_first)
    for index in (0, 2):
        panel.plane.setCurrentIndex(index)
        panel.plane.activated.emit(index)
    qtbot.waitUntil(lambda: len(made) == 2 and not _preparing(panel), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: panel.follower._view is not None, timeout=WAIT_MS)
    assert panel.loaded is not None
    assert panel.follower._view is not None
    assert made[panel.loaded.reconstructor] == 3e5
    assert panel.follower._view.reconstructor is panel.loaded.reconstructor


def test_sources_of_a_lateral_sweep_are_one_depth(
    qtbot: QtBot, panel: LiveReconstructionPanel, tmp_path: Path
) -> None:
    one = load_calibration(tmp_path / "calibration")
    places = [(x, y, 1e5 + 0.3 * (x > 0)) for y in (-300.0, 0.0, 300.0) for x in (-300.0, 0.0, 300.0)]
    nine = Calibration(np.repeat(one.psfs, 9, axis=0), np.array(places))
    panel.file.setText(str(save_calibration(nine, tmp_path / "lateral")))
    panel.load()
    qtbot.waitUntil(lambda: panel.loaded is not None and panel.loaded.path.name == "lateral", timeout=WAIT_MS)
    assert panel.plane.isHidden()
    qtbot.waitUntil(lambda: "latency" in panel.status.text(), timeout=WAIT_MS)


def test_a_depth_that_cannot_be_prepared_is_told_and_the_one_before_goes_on(
    qtbot: QtBot, panel: LiveReconstructionPanel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = load_calibration(tmp_path / "calibration")
    two = Calibration(np.repeat(one.psfs, 2, axis=0), np.array([[0.0, 0.0, z] for z in (1e5, 2e5)]))
    panel.file.setText(str(save_calibration(two, tmp_path / "two")))
    panel.load()
    qtbot.waitUntil(lambda: panel.z_um == 2e5 and panel._loading is None, timeout=WAIT_MS)

    def refuse(*_: object, **__: object) -> None:
        raise InputError("This PSF is dark.")

    monkeypatch.setattr(live_reconstruction, "LiveReconstructor", refuse)
    panel.plane.setCurrentIndex(0)
    panel.plane.activated.emit(0)
    qtbot.waitUntil(lambda: "This PSF is dark." in panel.file.toolTip(), timeout=WAIT_MS)
    assert "goes on as before:" in panel.file.toolTip()
    assert "two, z 200 mm" in panel.file.toolTip()
    assert panel.z_um == 2e5
    qtbot.waitUntil(lambda: panel.follower.is_following, timeout=WAIT_MS)


def test_after_another_calibration_failed_the_depths_are_still_those_of_the_one_in_use(
    qtbot: QtBot, panel: LiveReconstructionPanel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = load_calibration(tmp_path / "calibration")

    def load(name: str, *depths_um: float) -> None:
        psfs = np.repeat(one.psfs, len(depths_um), axis=0)
        places = np.array([[0.0, 0.0, z_um] for z_um in depths_um])
        panel.file.setText(str(save_calibration(Calibration(psfs, places), tmp_path / name)))
        panel.load()

    load("good", 1e5, 2e5)
    qtbot.waitUntil(lambda: panel.z_um == 2e5 and panel._loading is None, timeout=WAIT_MS)

    def refuse(*_: object, **__: object) -> None:
        raise InputError("This PSF is dark.")

    monkeypatch.setattr(live_reconstruction, "LiveReconstructor", refuse)
    load("bad", 3e5, 4e5, 5e5)
    qtbot.waitUntil(lambda: "This PSF is dark." in panel.file.toolTip(), timeout=WAIT_MS)
    assert [panel.plane.itemText(i) for i in range(panel.plane.count())] == [
        "z 100 mm",
        "z 200 mm",
        "all depths",
    ]
    assert panel.z_um == 2e5
    assert f"{Path('good')}" in panel.as_python()
    assert "bad" not in panel.as_python()


def test_a_first_calibration_that_cannot_be_prepared_leaves_words_for_what_to_do(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = window.show_panel("live_reconstruction")
    assert isinstance(panel, LiveReconstructionPanel)

    def refuse(*_: object, **__: object) -> None:
        raise InputError("This PSF is dark.")

    monkeypatch.setattr(live_reconstruction, "LiveReconstructor", refuse)
    before = panel.status.text()
    assert not panel.refine_button.isEnabled()
    one = Calibration(np.ones((1, 1, 8, 8), np.float32), np.zeros((1, 3)))
    panel.file.setText(str(save_calibration(one, tmp_path / "one")))
    panel.load()
    qtbot.waitUntil(lambda: "This PSF is dark." in panel.file.toolTip(), timeout=WAIT_MS)
    assert panel.status.text() == before


def _preparing(panel: LiveReconstructionPanel) -> bool:
    return any(job.title == "Preparing the preview" for job in panel.session.jobs.jobs)


def test_a_preview_with_another_reconstructor_replaces_the_one_that_runs(
    qtbot: QtBot, panel: LiveReconstructionPanel
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    assert panel.loaded is not None
    other = live_reconstruction.LiveReconstructor(panel.loaded.calibration, budget_ms=80.0)
    panel.follower.use(other)
    qtbot.waitUntil(
        lambda: panel.follower._view is not None and panel.follower._view.reconstructor is other,
        timeout=WAIT_MS,
    )


def test_a_preview_that_is_ended_and_begun_again_stays_one(
    qtbot: QtBot, panel: LiveReconstructionPanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    assert panel.loaded is not None
    reconstructor, inside, most, fed = panel.loaded.reconstructor, [0], [0], [0]
    feed, lock = reconstructor.feed, threading.Lock()

    def slowly(image: Any, **known: Any) -> Any:
        with lock:
            inside[0] += 1
            most[0] = max(most[0], inside[0])
        time.sleep(0.3)
        with lock:
            inside[0] -= 1
            fed[0] += 1
        return feed(image, **known)

    monkeypatch.setattr(reconstructor, "feed", slowly)
    qtbot.waitUntil(lambda: inside[0] == 1, timeout=WAIT_MS)
    for _ in range(4):
        qtbot.mouseClick(panel.run_button, Qt.MouseButton.LeftButton)
        qtbot.wait(30)
    assert panel.run_button.isChecked()
    before = fed[0]
    qtbot.waitUntil(lambda: fed[0] > before + 2, timeout=WAIT_MS)
    assert most == [1]


def test_a_preview_that_is_not_seen_ends_and_goes_on_when_it_is_shown(
    qtbot: QtBot, window: MainWindow, panel: LiveReconstructionPanel
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    shown = panel._shown
    window._docks["live_reconstruction"].hide()
    qtbot.waitUntil(
        lambda: not any(t.name == "live reconstruction" for t in threading.enumerate()), timeout=WAIT_MS
    )
    window.show_panel("live_reconstruction")
    qtbot.waitUntil(lambda: panel._shown is not shown, timeout=WAIT_MS)


def test_the_scenes_depth_is_found_among_those_calibrated_until_one_is_chosen(
    qtbot: QtBot, panel: LiveReconstructionPanel, tmp_path: Path
) -> None:
    qtbot.waitUntil(lambda: panel._shown is not None, timeout=WAIT_MS)
    one = load_calibration(tmp_path / "calibration")
    sizes = (1.0, 0.95, 0.9)  # of the patterns of farther points
    psfs = np.concatenate([transformed(one.psfs, Transformation(scale=size)) for size in sizes])
    places = np.array([[0.0, 0.0, z_um] for z_um in (1e5, 1.6e5, 2.5e5)])
    save_calibration(replace(one, psfs=psfs, source_positions_um=places), tmp_path / "three")
    panel.file.setText(str(tmp_path / "three"))
    qtbot.keyClick(panel.file, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: panel.loaded is not None and panel.loaded.z_um == 1e5, timeout=WAIT_MS)
    assert panel.plane.currentData() == 1e5
    panel.plane.setCurrentIndex(1)
    panel.plane.activated.emit(1)
    qtbot.waitUntil(lambda: panel.loaded is not None and panel.loaded.z_um == 1.6e5, timeout=WAIT_MS)
    shown = panel._shown
    qtbot.waitUntil(lambda: panel._shown is not shown and panel._loading is None, timeout=WAIT_MS)
    assert not panel._seeker.words, "what was chosen by hand stays"
