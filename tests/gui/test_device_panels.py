"""Stage, LED array and SLM: clicks and keys on the simulated bench."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PySide6.QtCore import Qt
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panel import Panel
from gui.panels.led_array import LedPanel
from gui.panels.slm import SlmPanel
from gui.panels.stage import StagePanel
from gui.panels.sweeps import SweepsPanel
from gui.widgets.dialogues import Question
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.files.slm_image import SlmCorrection, load_slm_correction, write_slm_image
from instrument.plan.patterns import shape_buttons

WAIT_MS = 60_000
LEFT = Qt.MouseButton.LeftButton


def _settled(qtbot: QtBot, window: MainWindow) -> None:
    qtbot.waitUntil(lambda: not window.session.jobs.device_jobs, timeout=WAIT_MS)


@pytest.fixture
def stage(qtbot: QtBot, window: MainWindow) -> StagePanel:
    panel = window.show_panel("stage")
    assert isinstance(panel, StagePanel)
    qtbot.waitUntil(lambda: panel.rows["x_um"].position.text() != "–", timeout=WAIT_MS)
    return panel


def _home(qtbot: QtBot, window: MainWindow, panel: StagePanel) -> None:
    qtbot.mouseClick(panel.home_button, LEFT)
    assert panel.question is not None
    button = next(b for b in panel.question.buttons() if b.text() == "Home")
    qtbot.mouseClick(button, LEFT)
    stage = window.session.bench.stage
    assert stage is not None
    qtbot.waitUntil(lambda: stage.is_homed, timeout=WAIT_MS)
    _settled(qtbot, window)


def test_home_asks_first(qtbot: QtBot, window: MainWindow, stage: StagePanel) -> None:
    assert "Not homed" in stage.state.text()
    qtbot.mouseClick(stage.home_button, LEFT)
    assert stage.question is not None
    stay = next(b for b in stage.question.buttons() if b.text() == "Stay")
    qtbot.mouseClick(stay, LEFT)
    assert window.session.bench.stage is not None
    assert not window.session.bench.stage.is_homed
    _home(qtbot, window, stage)
    qtbot.waitUntil(
        lambda: "homed" in stage.state.text() and "Not" not in stage.state.text(), timeout=WAIT_MS
    )


def test_stop_takes_clicks_while_home_is_asked_and_withdraws_it(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    qtbot.mouseClick(stage.home_button, LEFT)
    qtbot.mouseClick(stage.home_button, LEFT)  # not asked twice
    (box,) = stage.findChildren(Question)
    assert box is stage.question
    assert not box.isModal()
    with qtbot.waitSignal(window.session.stopped, timeout=WAIT_MS):
        qtbot.mouseClick(window.stop_button, LEFT)
        assert stage.question is None
    assert window.session.bench.stage is not None
    assert not window.session.bench.stage.is_homed


def test_jogging_by_keys(qtbot: QtBot, window: MainWindow, stage: StagePanel) -> None:
    _home(qtbot, window, stage)
    device = window.session.bench.stage
    assert device is not None
    shift, control = Qt.KeyboardModifier.ShiftModifier, Qt.KeyboardModifier.ControlModifier
    for key, modifier, axis, delta in (
        (Qt.Key.Key_Right, Qt.KeyboardModifier.NoModifier, "x_um", 100.0),
        (Qt.Key.Key_Up, shift, "y_um", 1000.0),
        (Qt.Key.Key_PageUp, control, "z_um", 10.0),
        (Qt.Key.Key_Left, Qt.KeyboardModifier.NoModifier, "x_um", -100.0),
    ):
        before = device.commanded_position()[axis]
        qtbot.keyClick(stage.pad, key, modifier)
        _settled(qtbot, window)
        assert device.commanded_position()[axis] == pytest.approx(before + delta, abs=0.2)


def test_a_target_is_typed_and_one_outside_the_limits_refused(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    _home(qtbot, window, stage)
    field, device = stage.rows["x_um"].target, window.session.bench.stage
    assert device is not None
    field.setFocus()
    field.selectAll()
    qtbot.keyClicks(field, "1.234")
    qtbot.keyClick(field, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: abs(device.position()["x_um"] - 1234) < 20, timeout=WAIT_MS)
    _settled(qtbot, window)
    field.selectAll()
    qtbot.keyClicks(field, "60001 um")
    qtbot.keyClick(field, Qt.Key.Key_Return)
    assert field.property("refused")
    assert "-60 mm to 60 mm" in field.toolTip()
    assert abs(device.commanded_position()["x_um"] - 1234) < 1


def test_an_unhomed_stage_says_why_it_does_not_move(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    qtbot.mouseClick(stage.rows["x_um"].buttons[1], LEFT)
    qtbot.waitUntil(lambda: "home" in stage._note.text().lower(), timeout=WAIT_MS)
    assert window.session.is_open("stage")


def test_a_place_is_kept_with_the_bench_and_gone_to_again(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    session = window.session
    stage._home_answered(True)
    qtbot.waitUntil(lambda: stage.state.text() == "At rest, homed", timeout=WAIT_MS)
    here = dict(stage._here or {})
    stage.places.names.setCurrentText("middle")
    qtbot.mouseClick(stage.places.save_button, LEFT)
    qtbot.waitUntil(session.kept.path.is_file, timeout=WAIT_MS)
    stage.jog("x", 5.0)
    qtbot.waitUntil(lambda: (stage._here or here)["x_um"] != here["x_um"], timeout=WAIT_MS)
    qtbot.waitUntil(lambda: not session.jobs.is_busy("stage"), timeout=WAIT_MS)
    at = dict(stage._here or {})
    stage.places.names.activated.emit(0)  # by a wheel or a key: chosen, and nothing moves
    assert not session.jobs.is_busy("stage")
    assert stage._here == pytest.approx(at, abs=1.0)
    qtbot.mouseClick(stage.places.use_button, LEFT)
    qtbot.waitUntil(lambda: (stage._here or {}) == pytest.approx(here, abs=1.0), timeout=WAIT_MS)
    session.keep("places", "off/left", at)
    qtbot.mouseClick(stage.all_button, LEFT)
    qtbot.waitUntil(lambda: "sweeps" in window.maker.panels, timeout=WAIT_MS)
    sweeps = window.maker.panels["sweeps"]
    assert isinstance(sweeps, SweepsPanel)
    qtbot.waitUntil(lambda: sweeps.run_bar.start_button.isEnabled(), timeout=WAIT_MS)
    plan = sweeps.procedure().plan  # type: ignore[union-attr]
    assert [part.label for part in plan.parts] == ["middle", "off-left"]
    assert plan.parts[0].positions.points[0] == pytest.approx(here, abs=1.0)  # type: ignore[union-attr]
    assert all(part.scene_lit for part in plan.parts)
    session.keep("places", "off/left", None)
    qtbot.mouseClick(stage.places.remove_button, LEFT)
    assert not stage.all_button.isEnabled()
    assert not stage.places.names.count()
    assert not stage.places.use_button.isEnabled()
    assert not stage.places.remove_button.isEnabled()
    for name in ("place 1", "place 2"):  # without a name it gets one
        stage.places.names.setCurrentText("")
        qtbot.mouseClick(stage.places.save_button, LEFT)
        assert stage.places.names.currentText() == name
        assert stage.places.use_button.isEnabled()
    assert sorted(session.kept.of("places")) == ["place 1", "place 2"]


def test_a_stage_that_is_unplugged_is_noticed_and_the_rest_goes_on(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    window.session.bench.shared["simulated"].unplug("stage")  # type: ignore[attr-defined]
    qtbot.waitUntil(lambda: window.session.state("stage").condition == "failed", timeout=WAIT_MS)
    assert "unplugged" in stage.state.text()
    assert window.session.live.is_running
    window.session.bench.shared["simulated"].plug_in("stage")  # type: ignore[attr-defined]
    assert "unplugged" in stage.closed.words.text()
    qtbot.mouseClick(stage.closed.other, LEFT)  # a message may say: home it
    assert stage.question is not None
    stage.question.reject()
    stage._home_answered(True)
    qtbot.waitUntil(lambda: window.session.is_open("stage"), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: stage.state.text() == "At rest, homed", timeout=WAIT_MS)


@pytest.fixture
def leds(qtbot: QtBot, window: MainWindow) -> LedPanel:
    panel = window.show_panel("led_array")
    assert isinstance(panel, LedPanel)
    qtbot.waitUntil(lambda: panel._drawn is not None, timeout=WAIT_MS)
    return panel


@pytest.mark.parametrize("name", ["Source", *shape_buttons()])
def test_led_patterns(qtbot: QtBot, window: MainWindow, leds: LedPanel, name: str) -> None:
    array = window.session.bench.led_array
    assert array is not None
    leds.colour.setCurrentText("green")
    leds.brightness.setValue(100)
    leds.na.set_value(0.2)
    qtbot.mouseClick(leds.pattern_buttons[name], LEFT)
    qtbot.waitUntil(lambda: not array.pattern.is_dark, timeout=WAIT_MS)
    lit = dict(array.pattern.levels)
    if name == "Source":
        assert set(lit) == {0}
    else:
        assert set(lit.values()) == {(0, 100, 0)}
        inside = np.hypot(*array.led_na[sorted(lit)].T) <= 0.2
        if name == "Dark field":
            assert not inside.any()
        elif hasattr(shape_buttons()[name], "na"):
            assert inside.all()
    qtbot.waitUntil(lambda: leds._drawn == array.pattern, timeout=WAIT_MS)
    qtbot.mouseClick(leds.pattern_buttons["Off"], LEFT)
    qtbot.waitUntil(lambda: array.pattern.is_dark, timeout=WAIT_MS)


def test_a_click_toggles_an_led(qtbot: QtBot, window: MainWindow, leds: LedPanel) -> None:
    array = window.session.bench.led_array
    assert array is not None
    for _ in range(2):  # the second time it goes out again
        spot = leds.spots.points()[5]
        view = leds.plot.plotItem.vb.mapViewToScene(spot.pos())
        before = array.pattern
        qtbot.mouseClick(leds.plot.viewport(), LEFT, pos=leds.plot.mapFromScene(view))
        qtbot.waitUntil(lambda before=before: array.pattern is not before, timeout=WAIT_MS)
        _settled(qtbot, window)
        leds.look()
    assert array.pattern.is_dark
    leds.index.setFocus()
    leds.index.selectAll()
    qtbot.keyClicks(leds.index, "7")
    qtbot.keyClick(leds.index, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: dict(array.pattern.levels).keys() == {7}, timeout=WAIT_MS)


@pytest.fixture
def slm(window: MainWindow) -> SlmPanel:
    panel = window.show_panel("slm")
    assert isinstance(panel, SlmPanel)
    return panel


def _type(qtbot: QtBot, field: object, text: str) -> None:
    field.setFocus()  # type: ignore[attr-defined]
    field.selectAll()  # type: ignore[attr-defined]
    qtbot.keyClicks(field, text)
    qtbot.keyClick(field, Qt.Key.Key_Return)


def test_a_picture_goes_on_the_slm_through_its_table_and_off_again(
    qtbot: QtBot, window: MainWindow, slm: SlmPanel, tmp_path: Path
) -> None:
    device = window.session.bench.slm
    assert device is not None
    levels = np.arange(60 * 80, dtype=np.uint32).reshape(60, 80).astype(np.uint8)
    write_slm_image(tmp_path / "phase.png", levels, {})
    _type(qtbot, slm.file, str(tmp_path / "phase.png"))
    qtbot.waitUntil(lambda: np.array_equal(device.displayed, levels), timeout=WAIT_MS)
    qtbot.waitUntil(lambda: "phase.png" in slm.now.text(), timeout=WAIT_MS)
    SlmCorrection(np.arange(256) * (3.9 * np.pi / 256)).save(tmp_path / "table.json", {})
    table = load_slm_correction(tmp_path / "table.json")
    _type(qtbot, slm.table_file, str(tmp_path / "table.json"))
    qtbot.waitUntil(slm.use_table.isChecked, timeout=WAIT_MS)
    qtbot.mouseClick(slm.load_button, LEFT)
    qtbot.waitUntil(lambda: np.array_equal(device.displayed, table.apply(levels)), timeout=WAIT_MS)
    qtbot.mouseClick(slm.blank_button, LEFT)
    qtbot.waitUntil(lambda: not device.displayed.any(), timeout=WAIT_MS)


def test_wrong_files_are_refused_at_their_fields(
    qtbot: QtBot, window: MainWindow, slm: SlmPanel, tmp_path: Path
) -> None:
    write_slm_image(tmp_path / "small.png", np.zeros((6, 8), np.uint8), {})
    _type(qtbot, slm.file, str(tmp_path / "small.png"))
    qtbot.waitUntil(lambda: bool(slm.file.property("refused")), timeout=WAIT_MS)
    assert "(60, 80)" in slm.file.toolTip()
    _type(qtbot, slm.table_file, str(tmp_path / "nothing.json"))
    qtbot.waitUntil(lambda: "no such file" in slm.table_file.toolTip(), timeout=WAIT_MS)
    assert not slm.use_table.isEnabled()
    assert window.session.is_open("slm")


def run_copied(panel: Panel, text: str, monkeypatch: pytest.MonkeyPatch, look: Callable[[Bench], Any]) -> Any:
    """Run a panel's lines on a bench of their own; returns what ``look`` saw before it was closed."""
    seen: list[Any] = []

    class Looked(Bench):
        def close(self) -> None:
            seen.append(look(self))
            super().close()

    monkeypatch.setattr(
        "instrument.bench.bench.open_bench", lambda _: Looked(parse_config(text, Path("bench.toml"))).open()
    )
    asked: list[str] = []
    monkeypatch.setattr("builtins.input", asked.append)
    code = panel.as_python()
    exec(code, {})
    assert len(seen) == 1
    assert len(asked) == code.count("input(")
    return seen[0]


def test_the_copied_lines_light_the_same_leds_until_enter(
    qtbot: QtBot, window: MainWindow, leds: LedPanel, bench_text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    array = window.session.bench.led_array
    assert array is not None
    # The live view lights the scene with its first frame, and would take the pattern away again.
    qtbot.waitUntil(lambda: window.session.bench.scene_lit, timeout=WAIT_MS)
    pattern = array.set_pattern(array.single(5, (0, 9, 0)))
    qtbot.waitUntil(lambda: leds._drawn == pattern, timeout=WAIT_MS)
    assert "input(" in leds.as_python()
    lit = run_copied(leds, bench_text, monkeypatch, lambda bench: bench.devices["led_array"].pattern)  # type: ignore[attr-defined]
    assert lit == pattern


def test_the_copied_lines_show_the_same_levels_until_enter(
    qtbot: QtBot, slm: SlmPanel, bench_text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    levels = np.arange(60 * 80, dtype=np.uint32).reshape(60, 80).astype(np.uint8)
    write_slm_image(tmp_path / "phase.png", levels, {})
    _type(qtbot, slm.file, str(tmp_path / "phase.png"))
    assert "input(" in slm.as_python()
    shown = run_copied(slm, bench_text, monkeypatch, lambda bench: bench.devices["slm"].displayed)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(shown, levels)


def test_the_copied_lines_bring_the_stage_to_the_same_place(
    stage: StagePanel, bench_text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.shutdown()
    stage.rows["x_um"].target.set_value(250.0)
    place = run_copied(stage, bench_text, monkeypatch, lambda bench: bench.source_mount.stage.position())
    assert place["x_um"] == pytest.approx(250.0, abs=20)
