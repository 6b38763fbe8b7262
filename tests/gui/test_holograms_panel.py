"""Holograms by mouse: what counts, computing, showing, photographing, the lines of Python."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

import gui.panels.holograms as holograms
import instrument
from calibration_routines.display.hologram_photograph import Capture, Photographed
from gui.jobs import JobState
from gui.panel import whole
from gui.panels.holograms import HologramsPanel
from gui.session import BenchSession
from gui.widgets.result_views import best_columns
from instrument.bench.config_file import parse_config
from instrument.display.bench_display import bench_display, depth_limit_mm
from instrument.display.hologram import square
from instrument.files.images import read_image, write_image
from instrument.files.slm_image import levels_phase, read_slm_image
from recon.errors import InputError
from recon.holography import LOSSES
from recon.holography.losses import LowPassed

WAIT_MS = 60_000


def aligned() -> str:
    """Return the display bench that ships, small, its mask where it belongs."""
    text = (Path(instrument.__file__).parent / "bench" / "display_bench.toml").read_text()
    changes = {
        "shape": "[200, 280]",
        "expansion": "4",
        "settle_ms": "0.0",
        "dc_power": "0.0",
        "shift_um": "[0.0, 0.0]",
        "z_um": "0.0",
        "roll_mrad": "0.0",
        "pitch_mrad": "0.0",
        "yaw_mrad": "0.0",
        "magnification": "0.0",
        "relay_distortion_um": "0.0",
        "mask_pitch_um": "8.0",
    }
    for key, value in changes.items():
        text, count = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
        assert count, key
    return text


@pytest.fixture
def bench_text() -> str:
    return aligned()


@pytest.fixture
def panel(qtbot: QtBot, make_session: Callable[[], BenchSession], tmp_path: Path) -> HologramsPanel:
    session = make_session()
    Path(session.config.path).write_text(aligned())
    session.viewing.wanted = False
    with qtbot.waitSignal(session.opened, timeout=WAIT_MS):
        session.open()
    assert session.is_open("slm"), session.state("slm").text
    assert session.is_open("camera"), session.state("camera").text
    y, x = np.mgrid[:80, :120]
    picture = np.where((y - 40) ** 2 + (x - 60) ** 2 < 500, 220, 60 + x // 2)
    write_image(tmp_path / "picture.png", picture.astype(np.uint8))
    panel = whole(HologramsPanel(session))
    panel.resize(1000, 700)
    qtbot.addWidget(panel, before_close_func=lambda p: p.shutdown())
    panel.show()
    assert panel.empty.words.text().startswith("No hologram yet")
    assert panel.empty.isVisible()
    panel.form.widgets["picture"].setText(str(tmp_path / "picture.png"))
    qtbot.keyClick(panel.form.widgets["picture"], Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: panel.target.image is not None, timeout=WAIT_MS)
    panel.form.widgets["iterations"].setText("12")
    return panel


def type_in(qtbot: QtBot, entry, text: str) -> None:
    entry.selectAll()
    qtbot.keyClicks(entry, text)
    qtbot.keyClick(entry, Qt.Key.Key_Return)


def click(qtbot: QtBot, button) -> None:
    qtbot.mouseClick(button, Qt.MouseButton.LeftButton)


def computed(qtbot: QtBot, panel: HologramsPanel, button) -> None:
    click(qtbot, button)
    assert panel.job is not None, panel._note.toolTip()
    with qtbot.waitSignal(panel.job.ended, timeout=WAIT_MS):
        pass
    assert panel.computed is not None, panel._note.toolTip()


def test_compute_show_and_photograph(qtbot: QtBot, panel: HologramsPanel) -> None:
    session = panel.session
    computed(qtbot, panel, panel.compute_button)
    pattern = session.runs_folder / "holograms" / "picture.png"
    levels, facts = read_slm_image(pattern)
    assert facts["iterations"] == 12
    out = panel.form.widgets["out"]
    qtbot.waitUntil(lambda: out.text().endswith("picture-2.png"), timeout=WAIT_MS)
    click(qtbot, panel.show_button)
    with qtbot.waitSignal(panel.job.ended, timeout=WAIT_MS):
        pass
    assert panel.job.error is None
    np.testing.assert_array_equal(session.bench.slm.displayed, levels)
    click(qtbot, panel.capture_button)
    with qtbot.waitSignal(panel.job.ended, timeout=WAIT_MS):
        pass
    assert panel.job.error is None, panel._note.toolTip()
    seen = json.loads(pattern.with_name("picture-seen.json").read_text())
    assert seen["simulated"]
    assert seen["metrics"]["psnr_db"] > 12
    text = panel.views.metrics.toPlainText()
    assert "SIMULATED" in text
    assert f"{seen['metrics']['psnr_db']:.2f} dB" in text
    assert panel.views.captured.image is not None


def test_a_preview_writes_nothing_and_is_square_as_the_field_is(qtbot: QtBot, panel: HologramsPanel) -> None:
    assert panel.views.seen.caption == "Preview or Compute fills this in"
    panel.form.widgets["expansion"].setText("1")
    computed(qtbot, panel, panel.preview_button)
    assert panel.computed is not None
    rows, columns = panel.computed.result.seen[0].shape
    assert rows < columns
    assert panel.views.seen.image is not None
    assert panel.views.seen.image.shape == (columns, columns)
    assert (panel.views.seen.caption, panel.views.phase.caption) == ("", "")
    assert panel.views.captured.caption == "Show and photograph takes it"
    assert not (panel.session.runs_folder / "holograms").exists()
    wide = np.ones((20, 30))
    capture = Capture(wide, wide, panel.computed.result.scores[0], 0.0)
    panel.views.show_photographed(Photographed(capture, None, 0.1, False, simulated=True), "seen.png")
    assert panel.views.captured.image.shape == (30, 30)


def test_what_it_takes_is_told_before_and_nothing_is_written(qtbot: QtBot, panel: HologramsPanel) -> None:
    click(qtbot, panel.explain_button)
    with qtbot.waitSignal(panel.job.succeeded, timeout=WAIT_MS):
        pass
    assert re.match(r"Will take about .* ms an iteration, 12 of them", panel.note.text())
    assert panel.note.isVisible()
    assert panel.computed is None
    assert not (panel.session.runs_folder / "holograms").exists()
    type_in(qtbot, panel.form.widgets["iterations"], "13")
    assert not panel.note.isVisible(), "it was of other options"


def test_photographs_of_a_preview_each_have_a_name_of_their_own(qtbot: QtBot, panel: HologramsPanel) -> None:
    computed(qtbot, panel, panel.preview_button)
    for name in ("picture-seen", "picture-seen-2"):
        click(qtbot, panel.capture_button)
        with qtbot.waitSignal(panel.job.ended, timeout=WAIT_MS):
            pass
        assert panel.job.error is None, panel._note.toolTip()
        for suffix in (".png", ".json"):
            assert (panel.session.runs_folder / "holograms" / f"{name}{suffix}").is_file()


def test_what_is_wrong_is_told_before_the_bench_is_touched(
    qtbot: QtBot, panel: HologramsPanel, tmp_path: Path
) -> None:
    panel.form.widgets["out"].setText(str(tmp_path / "nowhere" / "pattern.png"))
    computed(qtbot, panel, panel.preview_button)
    before = panel.job
    for button in (panel.show_button, panel.capture_button):
        panel.form.widgets["correction"].setText("absent.json")
        click(qtbot, button)
        assert panel.form.widgets["correction"].property("refused")
        assert "no such file" in panel._note.toolTip()
        assert panel.job is before
    panel.form.widgets["correction"].setText("")
    click(qtbot, panel.capture_button)
    with qtbot.waitSignal(panel.job.ended, timeout=WAIT_MS):
        pass
    assert "nowhere" in panel._note.toolTip()
    assert not panel.session.bench.slm.displayed.any()


def test_the_fovea_dragged_is_the_weights_computed_with(qtbot: QtBot, panel: HologramsPanel) -> None:
    panel.form.widgets["counts"].setCurrentText("a fovea, dragged")
    before = panel.target.weights()
    view = panel.target.graphics
    middle = view.mapFromScene(
        panel.target.box.mapViewToScene(panel.target.fovea.pos() + panel.target.fovea.size() / 2)
    )
    port = view.viewport()
    qtbot.mousePress(port, Qt.MouseButton.LeftButton, pos=middle)
    for step in range(1, 6):
        qtbot.mouseMove(port, middle + QPoint(-4 * step, 3 * step))
    qtbot.mouseRelease(port, Qt.MouseButton.LeftButton, pos=middle + QPoint(-20, 15))
    y, x = panel.target.centre
    assert y > 0.51
    assert x < 0.49
    after = panel.target.weights()
    assert np.abs(after - before).max() > 0.1
    np.testing.assert_array_equal(panel.order().options.weights, after)


def test_painting_and_rubbing_out(qtbot: QtBot, panel: HologramsPanel) -> None:
    panel.form.widgets["counts"].setCurrentText("painted")
    target = panel.target
    port = target.graphics.viewport()

    def at(y: float, x: float) -> QPoint:
        from PySide6.QtCore import QPointF

        size = target.extent[0]
        return target.graphics.mapFromScene(target.box.mapViewToScene(QPointF(x * size, y * size)))

    qtbot.mousePress(port, Qt.MouseButton.LeftButton, pos=at(0.5, 0.2))
    for x in np.linspace(0.2, 0.8, 30):
        qtbot.mouseMove(port, at(0.5, x))
    qtbot.mouseRelease(port, Qt.MouseButton.LeftButton, pos=at(0.5, 0.8))
    weights = target.weights()
    assert (weights[128, 60:200] > 0.9).all()
    assert weights[30, 128] == pytest.approx(0.1)
    qtbot.mouseClick(port, Qt.MouseButton.RightButton, pos=at(0.5, 0.5))
    assert target.weights()[128, 128] < 0.05
    click(qtbot, panel.clear)
    assert (target.weights() == 0.1).all()


def test_fovea_and_brush_by_keys_alone(qtbot: QtBot, panel: HologramsPanel) -> None:
    target = panel.target
    picture = target.graphics
    panel.form.widgets["counts"].setCurrentText("a fovea, dragged")
    (y, x), radius = target.centre, target.radius
    shift, alt = Qt.KeyboardModifier.ShiftModifier, Qt.KeyboardModifier.AltModifier
    qtbot.keyClick(picture, Qt.Key.Key_Down)
    qtbot.keyClick(picture, Qt.Key.Key_Left, shift)
    qtbot.keyClick(picture, Qt.Key.Key_Up, alt)
    assert target.centre == pytest.approx((y + 0.02, x - 0.2), abs=2e-3)
    assert target.radius == pytest.approx(radius + 0.02, abs=2e-3)
    panel.form.widgets["counts"].setCurrentText("painted")
    picture.setFocus()
    for _ in range(3):
        qtbot.keyClick(picture, Qt.Key.Key_Right)
    qtbot.keyClick(picture, Qt.Key.Key_Space)
    assert target.strokes == [(0.5, 0.56, target.brush_radius, 1.0)]
    weights = target.weights()
    assert weights is not None
    assert weights[128, 143] > 0.9
    qtbot.keyClick(picture, Qt.Key.Key_Backspace)
    rubbed = target.weights()
    assert rubbed is not None
    assert rubbed[128, 143] < 0.05


def test_planes_are_computed_together_shown_one_by_one_and_copied(
    qtbot: QtBot, panel: HologramsPanel, tmp_path: Path
) -> None:
    far = tmp_path / "far.png"
    write_image(far, np.tile(np.linspace(0, 255, 64).astype(np.uint8), (64, 1)))
    panel.form.widgets["further"].setText(f"{far} @ wide")
    click(qtbot, panel.preview_button)
    assert panel.form.widgets["further"].property("refused")
    assert panel.job is None
    panel.form.widgets["further"].setText(f"{far} @ 40 mm")
    panel.form.widgets["iterations"].setText("3")
    computed(qtbot, panel, panel.compute_button)
    assert panel.computed is not None
    result = panel.computed.result
    assert len(result.seen) == 2
    assert panel.views.plane.isVisible()
    assert [panel.views.plane.itemText(i) for i in range(2)] == ["seen at 0 mm", "seen at 40 mm"]
    np.testing.assert_array_equal(panel.views.seen.image, np.maximum(result.seen[0], 0))
    panel.views.plane.setFocus()
    qtbot.keyClick(panel.views.plane, Qt.Key.Key_Down)
    np.testing.assert_array_equal(panel.views.seen.image, np.maximum(result.seen[1], 0))
    assert "at 40 mm" in panel.views.metrics.toPlainText()
    by_window, facts = read_slm_image(panel.computed.patterns[0])
    assert len(facts["metrics"]) == 2
    panel.form.widgets["out"].setText(str(tmp_path / "by-script.png"))
    exec(panel.as_python(), {})
    by_script, _ = read_slm_image(tmp_path / "by-script.png")
    difference = np.angle(np.exp(1j * (levels_phase(by_script) - levels_phase(by_window))))
    assert np.sqrt(np.mean(difference**2)) < 0.02


@pytest.mark.parametrize("counts", ["all alike", "a fovea, dragged", "painted"])
def test_the_copied_lines_make_the_same_pattern(
    qtbot: QtBot, panel: HologramsPanel, tmp_path: Path, counts: str
) -> None:
    panel.form.widgets["counts"].setCurrentText(counts)
    panel.target.set_fovea((0.4, 0.55), 0.2)
    panel.target.strokes = [(0.4, 0.5, 0.2, 1.0), (0.5, 0.5, 0.1, 0.5)]
    panel.form.widgets["iterations"].setText("4")
    panel.form.widgets["out"].setText(str(tmp_path / "script.png"))
    click(qtbot, panel.copy_button)
    code = QApplication.clipboard().text()
    panel.session.bench.close()  # a script opens the bench for itself
    exec(code, {})
    panel.session._states["slm"] = type(panel.session._states["slm"])("open")
    panel.form.widgets["out"].setText(str(tmp_path / "mouse.png"))
    computed(qtbot, panel, panel.compute_button)
    script, mouse = (levels_phase(read_slm_image(tmp_path / f"{n}.png")[0]) for n in ("script", "mouse"))
    assert np.abs(np.angle(np.exp(1j * (script - mouse)))).mean() < 0.05


@pytest.mark.parametrize(
    ("field", "text", "reason"),
    [
        ("picture", "absent.png", "no such file"),
        ("z_mm", "far", "no number of mm"),
        ("frames", "0", "1 or more"),
        ("periphery", "2", "0 or more, 1 or less"),
        ("brush", "0", "above 0"),
        ("expansion", "5", "square"),
        ("out", "slm.jpg", ".png"),
        ("alignment", "absent.json", "no such file"),
    ],
)
def test_a_wrong_entry_is_refused_at_its_field(
    qtbot: QtBot, panel: HologramsPanel, field, text, reason
) -> None:
    panel.form.widgets["counts"].setCurrentText("painted")
    entry = panel.form.widgets[field]
    type_in(qtbot, entry, text)
    assert entry.property("refused")
    assert reason in entry.toolTip()
    click(qtbot, panel.compute_button)
    assert panel.job is None


def test_an_expansion_that_is_no_square_is_told(qtbot: QtBot, panel: HologramsPanel) -> None:
    panel.form.widgets["expansion"].setText("5")
    click(qtbot, panel.compute_button)
    qtbot.waitUntil(lambda: "square" in panel._note.toolTip(), timeout=WAIT_MS)


def test_views_stand_so_that_they_are_largest() -> None:
    assert best_columns(4, 1600, 400) == 4
    assert best_columns(4, 800, 800) == 2
    assert best_columns(4, 200, 900) == 1


def test_the_target_is_shown_as_it_fills_the_field(
    qtbot: QtBot, panel: HologramsPanel, tmp_path: Path
) -> None:
    pixels = read_image(tmp_path / "picture.png").pixels
    picture = pixels / pixels.max()
    np.testing.assert_allclose(panel.target.image, picture[:, 20:100])
    panel.form.widgets["fit"].setCurrentText("stretch")
    qtbot.waitUntil(lambda: panel.target.image.shape == (120, 120), timeout=WAIT_MS)
    np.testing.assert_allclose(panel.target.image, square(picture))
    with qtbot.waitSignal(panel.session.logged, timeout=WAIT_MS) as said:
        panel.form.widgets["fit"].setCurrentText("cover")
    assert "the middle 80 x 80 of the picture's 80 x 120 pixels are shown" in said.args[1]


@pytest.mark.parametrize("how", ["the panel's Stop", "STOP"])
def test_a_photograph_is_stopped_before_its_next_frame(
    qtbot: QtBot, panel: HologramsPanel, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    computed(qtbot, panel, panel.compute_button)
    bench = panel.session.bench
    before_ms = bench.camera.exposure_ms
    frames: list[bool] = []
    first, go_on = threading.Event(), threading.Event()
    snap = bench.snap

    def slowly(*arguments, **names):
        frames.append(bench.scene_lit)
        first.set()
        assert go_on.wait(WAIT_MS / 1000)
        return snap(*arguments, **names)

    monkeypatch.setattr(bench, "snap", slowly)
    click(qtbot, panel.capture_button)
    job = panel.job
    qtbot.waitUntil(first.is_set, timeout=WAIT_MS)
    if how == "STOP":
        panel.session.stop()
    else:
        click(qtbot, panel.stop_button)
    go_on.set()
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    assert job.state is JobState.CANCELLED
    assert len(frames) == 1
    assert not bench.scene_lit
    assert bench.camera.exposure_ms == before_ms


def test_a_photograph_leaves_the_light_off_and_the_exposure_as_it_was(
    qtbot: QtBot, panel: HologramsPanel
) -> None:
    computed(qtbot, panel, panel.compute_button)
    bench = panel.session.bench
    before_ms = bench.camera.exposure_ms
    click(qtbot, panel.capture_button)
    with qtbot.waitSignal(panel.job.ended, timeout=WAIT_MS):
        pass
    assert panel.job.error is None
    assert not bench.scene_lit
    assert bench.camera.exposure_ms == before_ms


def test_a_picture_is_read_once_and_not_in_the_windows_thread(
    qtbot: QtBot, panel: HologramsPanel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = []

    def read(path: Path):
        threads.append(threading.current_thread())
        return read_image(path)

    monkeypatch.setattr(holograms, "read_image", read)
    write_image(tmp_path / "other.png", np.eye(50, dtype=np.uint8))
    (tmp_path / "words.png").write_text("no picture")
    panel.form.widgets["picture"].setText(str(tmp_path / "other.png"))
    for _ in range(2):
        qtbot.keyClick(panel.form.widgets["picture"], Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: panel.target.image.shape == (50, 50), timeout=WAIT_MS)
    assert len(threads) == 1
    assert threads[0] is not threading.main_thread()
    panel.form.widgets["picture"].setText(str(tmp_path / "words.png"))
    qtbot.keyClick(panel.form.widgets["picture"], Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: bool(panel.form.widgets["picture"].property("refused")), timeout=WAIT_MS)


def test_a_depth_out_of_reach_is_refused_at_its_field(
    qtbot: QtBot, panel: HologramsPanel, tmp_path: Path
) -> None:
    slm = panel.session.bench.slm
    limit_mm = depth_limit_mm(panel.session.config, (slm.shape, slm.pixel_pitch_um))
    for depth, field in (
        (f"{1.02 * limit_mm:.6g}", panel.form.widgets["z_mm"]),
        (f"{tmp_path / 'picture.png'} @ {-1.02 * limit_mm:.6g} mm", panel.form.widgets["further"]),
    ):
        type_in(qtbot, field, depth)
        assert field.property("refused")
        assert "too far for this display" in field.toolTip()
    z_mm, expansion = (panel.form.widgets[name] for name in ("z_mm", "expansion"))
    panel.form.widgets["further"].setText("")
    type_in(qtbot, z_mm, f"{0.9 * limit_mm:.6g}")
    assert not z_mm.property("refused")
    type_in(qtbot, expansion, "16")  # finer mask pixels reach farther
    wide_mm = depth_limit_mm(panel.session.config, (slm.shape, slm.pixel_pitch_um), expansion=16)
    type_in(qtbot, z_mm, f"{0.98 * wide_mm:.6g}")
    assert bool(z_mm.property("refused")) == (wide_mm <= 0)
    type_in(qtbot, expansion, "4")
    assert bool(z_mm.property("refused")) == (0.98 * wide_mm > limit_mm)
    type_in(qtbot, z_mm, f"{1.02 * limit_mm:.6g}")
    assert z_mm.property("refused")
    type_in(qtbot, panel.form.widgets["distance_mm"], "300")  # the limit is the lens'
    assert not z_mm.property("refused")


def test_the_depth_limit_is_that_of_the_display_itself() -> None:
    config = parse_config(aligned(), None)
    size = ((40, 60), 32.0)
    limit_mm = depth_limit_mm(config, size)
    display = bench_display(config, size)
    display.defocus(0.999 * limit_mm)
    with pytest.raises(InputError, match="too far for this display"):
        display.defocus(-1.001 * limit_mm)


def test_a_registered_loss_can_be_chosen(qtbot: QtBot, make_session, monkeypatch: pytest.MonkeyPatch) -> None:
    class Own(LowPassed):
        name = "own"
        help = "As the low-passed one."

    monkeypatch.setattr(LOSSES, "_foreign", dict(LOSSES._foreign))
    LOSSES.register(Own())
    panel = whole(HologramsPanel(make_session()))
    qtbot.addWidget(panel, before_close_func=lambda p: p.shutdown())
    loss = panel.form.widgets["loss"]
    assert loss.itemData(loss.findText("own"), Qt.ItemDataRole.ToolTipRole) == Own.help
    assert loss.currentText() == "frequency"
