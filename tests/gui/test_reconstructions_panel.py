"""Reconstructions by mouse and keys: the form, the work, the viewers, and the lines of Python."""

from __future__ import annotations

import json
import re
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from gui.forms.reconstruct import PSF, VOLUME
from gui.jobs import JobState
from gui.panels.reconstructions import ReconstructionsPanel
from gui.widgets.entry import NumberEdit
from instrument.files.calibration_file import load_calibration, newest_calibration, save_calibration
from instrument.files.images import read_image, write_image
from instrument.reconstruction.request import VolumeRequest
from instrument.reconstruction.stored_result import StoredResult
from recon.camera.transformed import Transformation
from recon.reconstruction.options import Overrides
from recon.types import Calibration
from recon.verdict.calibration_check import GIVEN, CalibrationCheck, Fit, Score

WAIT_MS = 60_000
SIZE, DEPTHS = 32, 4


def psf(z: int) -> np.ndarray:
    """Spots of random lenslets, further apart the nearer the plane."""
    lenses = np.random.default_rng(0).uniform(-9, 9, (12, 2))
    image = np.zeros((SIZE, SIZE), np.float32)
    rows, columns = np.round(lenses * (1 + 0.15 * z) + SIZE // 2).astype(int).T
    np.add.at(image, (rows, columns), 200)
    return image


@pytest.fixture
def files(tmp_path: Path) -> Path:
    folder = tmp_path / "input"
    (folder / "psfs").mkdir(parents=True)
    for z in range(DEPTHS):
        tifffile.imwrite(folder / "psfs" / f"psf{z}.tif", psf(z))
    photograph = 3 * np.roll(psf(2), (4, -3), (0, 1)) + 100
    photograph += np.random.default_rng(1).normal(0, 2, photograph.shape)
    tifffile.imwrite(folder / "photo.tif", photograph.astype(np.uint16))
    write_image(folder / "psf.tif", (psf(2) + 100).astype(np.uint16))
    return folder


def fill(panel: ReconstructionsPanel, kind: str, files: Path, psfs: str) -> None:
    panel.tabs.setCurrentWidget(panel.form)
    panel.form.options.set_values({"kind": kind})
    for name, text in (
        ("image", files / "photo.tif"),
        (panel.form.source, files / psfs),
        ("iterations", "5"),
        ("dark", "100"),
    ):
        put(panel, name, text)


def put(panel: ReconstructionsPanel, name: str, text: object) -> None:
    """Write into a field and leave it."""
    field = panel.form.widgets[name]
    field.setText(str(text))
    field.setModified(True)
    field.submit() if isinstance(field, NumberEdit) else field.check()


def choose(panel: ReconstructionsPanel, **values: object) -> None:
    panel.form.options.set_values(values)


def run(qtbot: QtBot, panel: ReconstructionsPanel) -> None:
    qtbot.mouseClick(panel.form.start, Qt.MouseButton.LeftButton)
    assert panel.job is not None, panel._note.text()
    while not panel.job.is_over:  # as long as compiling takes where nothing is compiled yet
        qtbot.wait(5)
    assert panel.job.state is JobState.SUCCEEDED, panel.job.error
    qtbot.waitUntil(lambda: panel.result is not None, timeout=WAIT_MS)


def test_a_picture_by_mouse_is_written_and_shown(qtbot: QtBot, panel: ReconstructionsPanel, files) -> None:
    fill(panel, PSF, files, "psf.tif")
    run(qtbot, panel)
    written = panel.session.runs_folder / "reconstructions" / "photo.tif"
    assert panel.result.path == written
    assert panel.viewers.currentWidget() is panel.picture
    np.testing.assert_array_equal(panel.picture.picture, read_image(written).pixels)
    assert json.loads(written.with_suffix(".json").read_text())["iterations"] == 5
    assert "Photograph" in panel.facts.toPlainText()
    assert "residual / noise" in panel.convergence.curves
    assert "change" in panel.convergence.curves
    qtbot.waitUntil(lambda: panel.results.list.count() == 1, timeout=WAIT_MS)
    # The next one does not fall on top of it.
    qtbot.waitUntil(lambda: panel.form.text("out").endswith("photo-2.tif"), timeout=WAIT_MS)


def test_how_far_a_picture_may_be_off_is_shown_on_request(qtbot: QtBot, panel, files, tmp_path) -> None:
    fill(panel, PSF, files, "psf.tif")
    choose(panel, uncertainty=True)
    put(panel, "out", tmp_path / "photo.tif")
    assert "uncertainty=True" in panel.as_python()
    run(qtbot, panel)
    view = panel.picture
    picture = np.array(view.shown)
    view.which.setCurrentIndex(1)
    deviation = tifffile.imread(tmp_path / "photo-deviation.tif")
    np.testing.assert_array_equal(view.shown, deviation[::-1, ::-1])  # upright: the bench is simulated
    view.which.setCurrentIndex(0)
    np.testing.assert_array_equal(view.shown, picture)
    view.show_picture(picture)
    assert not view.which.isVisible()


def test_a_volume_by_mouse_and_slices_by_click(qtbot: QtBot, panel: ReconstructionsPanel, files) -> None:
    fill(panel, VOLUME, files, "psfs")
    choose(panel, prior="l1")
    run(qtbot, panel)
    view = panel.volume
    assert panel.viewers.currentWidget() is view
    qtbot.waitUntil(lambda: view.projections is not None, timeout=WAIT_MS)
    voxels = tifffile.imread(panel.result.path)
    np.testing.assert_array_equal(view.projections.front, voxels.max(axis=0))
    brightest = np.unravel_index(voxels.argmax(), voxels.shape)
    qtbot.mouseClick(view.tools.modes["slices"], Qt.MouseButton.LeftButton)
    view.front.clicked.emit(int(brightest[2]), int(brightest[1]))
    view.slider.setFocus()
    view.slider.setValue(0)
    for _ in range(int(brightest[0])):
        qtbot.keyClick(view.slider, Qt.Key.Key_Right)
    assert view.point == tuple(brightest)
    qtbot.keyClick(view.front.graphics, Qt.Key.Key_Up)
    qtbot.keyClick(view.side.graphics, Qt.Key.Key_Down)
    qtbot.keyClick(view.front.graphics, Qt.Key.Key_Left)
    qtbot.keyClick(view.top.graphics, Qt.Key.Key_Right)
    assert view.point == tuple(brightest)
    qtbot.waitUntil(
        lambda: {a: s.index for a, s in view.slices.items()} == dict(zip("zyx", brightest, strict=True)),
        timeout=WAIT_MS,
    )
    np.testing.assert_array_equal(view.slices["z"].pixels, voxels[brightest[0]])
    np.testing.assert_array_equal(view.slices["y"].pixels, voxels[:, brightest[1]])
    np.testing.assert_array_equal(view.slices["x"].pixels, voxels[:, :, brightest[2]])
    assert "one PSF a depth" in panel.facts.toPlainText()


def test_explain_says_what_would_be_chosen_and_reconstructs_nothing(
    qtbot: QtBot, panel: ReconstructionsPanel, files, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(panel, VOLUME, files, "psfs")
    forecast, tried = VolumeRequest.forecast, threading.Event()

    def later(self: VolumeRequest, *given: Any) -> Any:
        tried.wait()
        return forecast(self, *given)

    monkeypatch.setattr(VolumeRequest, "forecast", later)
    qtbot.mouseClick(panel.form.explain, Qt.MouseButton.LeftButton)
    assert panel.form.stop.text() == "Stop", "there is nothing to keep"
    qtbot.waitUntil(lambda: "Model" in panel.facts.toPlainText(), timeout=WAIT_MS)
    assert panel.form.note.text().startswith("Trying what it takes")
    tried.set()
    qtbot.waitUntil(lambda: "Will take" in panel.facts.toPlainText(), timeout=WAIT_MS)
    qtbot.waitUntil(panel.form.start.isEnabled, timeout=WAIT_MS)
    assert panel.form.stop.text() == "Stop and keep"
    assert panel.job is None
    assert re.match(r"Will take about .* ms an iteration, \d+ of them", panel.form.note.text())
    assert panel.facts.toPlainText().lstrip().startswith("Will take")
    assert not (panel.session.runs_folder / "reconstructions").exists()


def test_what_a_model_that_was_asked_for_takes_is_told_too(
    qtbot: QtBot, panel: ReconstructionsPanel, files
) -> None:
    fill(panel, PSF, files, "psf.tif")
    choose(panel, model="convolution")
    qtbot.mouseClick(panel.form.explain, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "Will take about" in panel.form.note.text(), timeout=WAIT_MS)
    assert "what was chosen" not in panel.form.note.text()


def test_stopping_keeps_what_there_is(qtbot: QtBot, panel: ReconstructionsPanel, files) -> None:
    fill(panel, PSF, files, "psf.tif")
    choose(panel, iterations=1_000_000, prior="tv-haar", solver="fista")
    qtbot.mouseClick(panel.form.start, Qt.MouseButton.LeftButton)
    with qtbot.waitSignal(panel.job.progressed, timeout=WAIT_MS):
        pass
    qtbot.mouseClick(panel.form.stop, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: panel.result is not None, timeout=WAIT_MS)
    record = json.loads(panel.result.path.with_suffix(".json").read_text())
    assert record["stop_reason"] in ("cancelled", "the change per iteration fell below the tolerance")
    assert not panel.form.stop.isEnabled()


@pytest.mark.parametrize(
    ("field", "text", "reason"),
    [
        ("image", "absent.tif", "no such file"),
        ("iterations", "0", "1 or more"),
        ("iterations", "2.5", "whole number"),
        ("tau", "-1", "0 or more"),
        ("binning", "many", "no number"),
        ("crop", "12", "Crop '12': write TOP"),
        ("noise", "loud", "Noise 'loud': write a standard deviation"),
        ("dark", "nan", "finite"),
        ("out", "result.jpg", ".tif"),
    ],
)
def test_a_wrong_entry_is_refused_at_its_field(
    qtbot: QtBot, panel: ReconstructionsPanel, files, field, text, reason
) -> None:
    fill(panel, PSF, files, "psf.tif")
    entry = panel.form.widgets[field]
    entry.setFocus()
    entry.clear()
    qtbot.keyClicks(entry, text)
    qtbot.keyClick(entry, Qt.Key.Key_Return)
    assert entry.property("refused")
    assert reason in entry.toolTip()
    assert reason in panel._note.toolTip()
    qtbot.mouseClick(panel.form.start, Qt.MouseButton.LeftButton)
    assert panel.job is None


def test_a_mistake_that_only_the_work_finds_is_told(qtbot: QtBot, panel: ReconstructionsPanel, files) -> None:
    write_image(files / "small.tif", np.arange(100, dtype=np.uint16).reshape(5, 20))
    fill(panel, PSF, files, "small.tif")
    qtbot.mouseClick(panel.form.start, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: "both must have one shape" in panel._note.toolTip(), timeout=WAIT_MS)
    assert panel.form.start.isEnabled()


@pytest.mark.parametrize("kind", [PSF, VOLUME])
def test_the_copied_lines_make_the_same_result(
    qtbot: QtBot, panel: ReconstructionsPanel, files, tmp_path, kind
) -> None:
    fill(panel, kind, files, "psf.tif" if kind == PSF else "psfs")
    put(panel, "crop", "28x30")
    put(panel, "noise", "2,0.5")
    put(panel, "out", tmp_path / "by-script.tif")
    qtbot.mouseClick(panel.copy_button, Qt.MouseButton.LeftButton)
    exec(QApplication.clipboard().text(), {})
    put(panel, "out", tmp_path / "by-mouse.tif")
    run(qtbot, panel)
    np.testing.assert_allclose(
        tifffile.imread(tmp_path / "by-script.tif"), tifffile.imread(tmp_path / "by-mouse.tif"), rtol=1e-4
    )
    panel.tabs.setCurrentIndex(0)
    names: dict = {}
    exec(panel.as_python(), names)
    assert names["result"].path == tmp_path / "by-mouse.tif"
    names["result"].close()


def test_what_is_folded_away_reaches_the_work_and_the_copied_lines(
    qtbot: QtBot, panel: ReconstructionsPanel, files, tmp_path
) -> None:
    fill(panel, PSF, files, "psf.tif")
    form, widgets = panel.form, panel.form.widgets
    more = form.options.more
    assert not widgets["allow_saturated"].isVisible()
    more.setFocus()
    qtbot.keyClick(more, Qt.Key.Key_Space)
    assert widgets["allow_saturated"].isVisible()
    assert not widgets["volume"].isVisible()  # of volumes
    assert "bit depth" in widgets["allow_mixed_depth"].toolTip()
    choose(panel, mosaic=None, rotate_deg="90", precision="float64")
    put(panel, "tolerance", "1e-9")
    qtbot.keyClick(widgets["allow_saturated"], Qt.Key.Key_Space)
    put(panel, "checkpoint", tmp_path / "kept")
    put(panel, "out", tmp_path / "plain.tif")
    request = form.request()
    assert request.inputs.allow_saturated
    assert request.inputs.mosaic is None
    assert request.options.tolerance == 1e-9
    assert request.options.precision == "float64"
    run(qtbot, panel)
    assert list((tmp_path / "kept").iterdir())  # five iterations are not its end
    put(panel, "checkpoint", tmp_path / "kept-by-script")
    put(panel, "out", tmp_path / "by-script.tif")
    qtbot.mouseClick(panel.copy_button, Qt.MouseButton.LeftButton)
    exec(QApplication.clipboard().text(), {})
    by_script, by_window = (tifffile.imread(tmp_path / f"{name}.tif") for name in ("by-script", "plain"))
    np.testing.assert_allclose(by_script, by_window, rtol=1e-4)
    choose(panel, rotate_deg="0")
    put(panel, "checkpoint", "")
    put(panel, "out", tmp_path / "not-turned.tif")
    exec(form.as_python(), {})
    np.testing.assert_allclose(
        np.rot90(tifffile.imread(tmp_path / "not-turned.tif")), by_window, rtol=1e-3, atol=1e-3
    )


def test_zero_is_a_tolerance_and_what_is_one_shot_has_none(panel: ReconstructionsPanel, files) -> None:
    fill(panel, PSF, files, "psf.tif")
    put(panel, "tolerance", "0")
    assert panel.form.request().options.tolerance == 0
    choose(panel, solver="wiener")
    assert not panel.form.widgets["tolerance"].isEnabled()
    assert "one shot" in panel.form.widgets["tolerance"].toolTip()
    asked = panel.form.request().options
    assert (asked.tolerance, asked.iterations) == (None, None)


def test_choices_of_a_volume_are_those_of_the_command_line(
    qtbot: QtBot, panel: ReconstructionsPanel, files, tmp_path
) -> None:
    fill(panel, VOLUME, files, "psfs")
    form = panel.form
    put(panel, "choose", "binning=1 planes=0-1,3")
    form.options.more.click()
    form.widgets["positive_background"].click()
    form.widgets["stop_at_noise"].click()
    request = form.request()
    assert isinstance(request, VolumeRequest)
    assert request.options.choose == Overrides(binning=1, planes=(0, 1, 3))
    assert request.options.positive_background
    assert request.options.stop_at_noise
    names: dict = {}
    exec(form.as_python().split("job = ")[0], names)
    assert names["request"] == request
    put(panel, "checkpoint", tmp_path / "kept")
    assert form.work().kept_in == tmp_path / "kept"  # everything is chosen with a checkpoint, too
    form.widgets["choose"].setText("size=3")
    qtbot.mouseClick(form.start, Qt.MouseButton.LeftButton)
    assert panel.job is None
    assert "no choice 'size'" in panel._note.toolTip()
    put(panel, "memory_gib", "-1")
    form.options.more.setChecked(False)
    qtbot.mouseClick(form.start, Qt.MouseButton.LeftButton)
    assert form.widgets["choose"].property("refused")


def test_a_psf_that_does_not_fit_is_fitted_by_a_button(
    qtbot: QtBot, panel: ReconstructionsPanel, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    turned = Transformation(rotation_deg=2.0)
    scores = {GIVEN: Score(4.0, 1.0, (), ()), turned: Score(1.0, 1.0, (), ())}
    better = CalibrationCheck(Fit.OFF, scores, 600, turned)
    monkeypatch.setattr(StoredResult, "warnings", property(lambda _: better.sentences))
    write_image(tmp_path / "p.tif", np.zeros((20, 30), np.float32))
    panel.show()
    panel.open(tmp_path / "p.tif")
    qtbot.waitUntil(lambda: panel.result is not None, timeout=WAIT_MS)
    assert panel.refine_button.isHidden(), "made by another form"
    panel._made = panel.result.path
    panel.show_result(panel.result)
    asked: list[bool] = []
    monkeypatch.setattr(panel, "reconstruct", lambda: asked.append(panel.form.options.value("refine_psf")))
    qtbot.mouseClick(panel.refine_button, Qt.MouseButton.LeftButton)
    assert asked == [True]
    panel.show_result(panel.result)
    assert panel.refine_button.isHidden(), "it was fitted already"


def test_a_fitted_psf_is_kept_and_used_from_then_on(
    qtbot: QtBot, panel: ReconstructionsPanel, tmp_path
) -> None:
    spot = np.zeros((1, 1, 40, 60), np.float32)
    spot[0, 0, 20, 45] = 1.0
    saved = save_calibration(Calibration(spot, np.array([[500.0, 0.0, 2e4]])), tmp_path / "cal")
    write_image(tmp_path / "p.tif", np.zeros((20, 30), np.float32))
    fitted = {"psf_refinement": {"scale": 1.2, "rotation_deg": 0.0, "used": True}}
    record = {"inputs": {"calibration": str(saved)}, "provenance": fitted}
    given: list[tuple[str, object]] = []
    panel.session.handed_on.connect(lambda name, what: given.append((name, what)))
    panel.show()
    for used in (False, True):
        fitted["psf_refinement"]["used"] = used
        panel.show_result(StoredResult(tmp_path / "p.tif", np.zeros((20, 30), np.float32), None, record))
        assert panel.keep_button.isHidden() is not used
    qtbot.mouseClick(panel.keep_button, Qt.MouseButton.LeftButton)
    assert not panel.keep_button.isEnabled()
    qtbot.waitUntil(lambda: bool(given), timeout=WAIT_MS)
    ((name, folder),) = given
    assert name == "live_reconstruction"
    assert panel.form.options.value("calibration") == folder == newest_calibration(panel.session.runs_folder)
    made = load_calibration(folder)
    assert np.unravel_index(made.psfs[0, 0].argmax(), (40, 60)) == (
        20,
        48,
    )  # 15 pixels from the middle, 18 now
    assert made.source_positions_um[0] == pytest.approx([600.0, 0.0, 2e4])


def test_stop_during_explain_stops_that_and_not_what_was_done_before(
    qtbot: QtBot, panel: ReconstructionsPanel, files, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(panel, PSF, files, "psf.tif")
    run(qtbot, panel)
    before = panel.job
    gate = threading.Event()
    monkeypatch.setattr(type(panel.form.request()), "prepare", lambda _: gate.wait(WAIT_MS / 1000))
    qtbot.waitUntil(panel.form.explain.isEnabled, timeout=WAIT_MS)
    job = panel.explain()
    qtbot.mouseClick(panel.form.stop, Qt.MouseButton.LeftButton)
    gate.set()
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    assert job.state is JobState.CANCELLED
    assert panel.job is before
    assert not before.is_cancelling
    assert panel.form.note.text() == "Stopped."


def test_explain_stands_beside_the_facts_of_the_result_and_goes_where_it_is_stopped(
    qtbot: QtBot, panel: ReconstructionsPanel, files, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(panel, PSF, files, "psf.tif")
    run(qtbot, panel)
    facts = panel.facts.toPlainText()
    request, tried = type(panel.form.request()), threading.Event()
    forecast = request.forecast

    def later(self: Any, *given: Any) -> Any:
        tried.wait(WAIT_MS / 1000)
        return forecast(self, *given)

    monkeypatch.setattr(request, "forecast", later)
    qtbot.waitUntil(panel.form.explain.isEnabled, timeout=WAIT_MS)
    job = panel.explain()
    qtbot.waitUntil(lambda: panel.facts.toPlainText() != facts, timeout=WAIT_MS)
    both = panel.facts.toPlainText()
    assert "The form" in both
    assert all(line in both for line in facts.splitlines()), "the picture's own remain"
    qtbot.mouseClick(panel.form.stop, Qt.MouseButton.LeftButton)
    tried.set()
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    assert panel.facts.toPlainText() == facts
