"""The stage in an operator's hands: steps that make no sense, and a target entered again after STOP."""

from __future__ import annotations

import threading

import pytest
from PySide6.QtCore import Qt
from pytestqt.qtbot import QtBot

from gui.main_window import MainWindow
from gui.panels.stage import StagePanel
from gui.widgets.dialogues import Question

WAIT_MS = 60_000
LEFT = Qt.MouseButton.LeftButton


@pytest.fixture
def stage(qtbot: QtBot, window: MainWindow) -> StagePanel:
    panel = window.show_panel("stage")
    assert isinstance(panel, StagePanel)
    device = window.session.bench.stage
    assert device is not None
    device.home()
    qtbot.waitUntil(lambda: panel.state.text() == "At rest, homed", timeout=WAIT_MS)
    return panel


def _type(qtbot: QtBot, field: object, text: str) -> None:
    field.setFocus()  # type: ignore[attr-defined]
    field.selectAll()  # type: ignore[attr-defined]
    qtbot.keyClicks(field, text)


def test_what_stood_in_the_way_is_told_until_it_has_ended(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    gate = threading.Event()
    sweep = window.session.jobs.exclusive("Sweep", lambda _: gate.wait(WAIT_MS / 1000))
    assert stage.command("Move", lambda _: None, stage.home_button) is None
    assert "Sweep is running" in stage._note.toolTip()
    gate.set()
    qtbot.waitUntil(lambda: sweep.is_over and not stage._note.text(), timeout=WAIT_MS)
    assert not stage.home_button.property("refused")


def test_an_alarm_that_homing_does_not_end_is_unlocked_after_a_question(
    qtbot: QtBot, window: MainWindow, stage: StagePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = window.session.bench.stage
    assert device is not None
    assert not stage.unlock_button.isVisible()
    locked = [True]
    monkeypatch.setattr(type(device), "needs_unlocking", property(lambda _: bool(locked)))
    monkeypatch.setattr(type(device), "unlock", lambda _: locked.clear(), raising=False)
    qtbot.waitUntil(stage.unlock_button.isVisible, timeout=WAIT_MS)
    assert stage.state.text().startswith("Locked by an alarm")
    for asks, answer in ((stage.unlock_button, "Unlock"), (stage.home_button, "Home")):
        qtbot.mouseClick(asks, LEFT)  # another question than the one that is open withdraws that one
        assert stage.question is not None
        assert answer in [b.text() for b in stage.question.buttons()]
        assert [box.isVisible() for box in stage.findChildren(Question)].count(True) == 1
    for answer in ("Leave it locked", "Unlock"):
        assert locked
        qtbot.mouseClick(stage.unlock_button, LEFT)
        assert stage.question is not None
        (yes_or_no,) = [b for b in stage.question.buttons() if b.text() == answer]
        qtbot.mouseClick(yes_or_no, LEFT)
    qtbot.waitUntil(lambda: not stage.unlock_button.isVisible(), timeout=WAIT_MS)
    assert not locked


def test_a_step_that_makes_no_sense_moves_nothing(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    device = window.session.bench.stage
    assert device is not None
    before = device.position()
    _type(qtbot, stage.steps["um"], "-5")
    qtbot.mouseClick(stage.pad, LEFT)
    qtbot.keyClick(stage.pad, Qt.Key.Key_Right)
    assert stage.steps["um"].property("refused")
    assert not window.session.jobs.is_busy("stage")
    assert device.position() == before
    _type(qtbot, stage.steps["um"], "0.2 mm")
    qtbot.mouseClick(stage.pad, LEFT)
    qtbot.keyClick(stage.pad, Qt.Key.Key_Right)
    qtbot.waitUntil(lambda: device.position()["x_um"] == before["x_um"] + 200, timeout=WAIT_MS)


def test_a_target_can_be_entered_again_after_stop(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    device = window.session.bench.stage
    assert device is not None
    target = stage.rows["z_um"].target
    for _ in range(2):
        _type(qtbot, target, "290")
        qtbot.keyClick(target, Qt.Key.Key_Return)
        qtbot.waitUntil(lambda: device.is_moving, timeout=WAIT_MS)
        assert "Move z to 290 mm" in window.status.words.text()
        with qtbot.waitSignal(window.session.stopped, timeout=WAIT_MS):
            qtbot.keyClick(target, Qt.Key.Key_Escape)
        here = device.position()["z_um"]
        assert here < 290_000
        qtbot.waitUntil(
            lambda here=here: target.value is not None and abs(target.value - here) < 1, timeout=WAIT_MS
        )


def test_stop_leaves_the_target_that_is_being_typed(
    qtbot: QtBot, window: MainWindow, stage: StagePanel
) -> None:
    device = window.session.bench.stage
    assert device is not None
    target = stage.rows["z_um"].target
    _type(qtbot, target, "290")
    qtbot.keyClick(target, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: device.is_moving, timeout=WAIT_MS)
    _type(qtbot, target, "12")
    with qtbot.waitSignal(window.session.stopped, timeout=WAIT_MS):
        qtbot.keyClick(target, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: stage.state.text() == "At rest, homed", timeout=WAIT_MS)
    assert target.text() == "12"
    qtbot.keyClick(target, Qt.Key.Key_Return)
    qtbot.waitUntil(lambda: device.position()["z_um"] == 12_000, timeout=WAIT_MS)


def test_a_place_without_a_reference_is_not_kept(qtbot: QtBot, window: MainWindow) -> None:
    stage = window.show_panel("stage")
    assert isinstance(stage, StagePanel)
    qtbot.waitUntil(lambda: "Not homed" in stage.state.text(), timeout=WAIT_MS)
    stage.places.save()
    assert not window.session.kept.of("places")
    assert "Not homed" in stage.places.save_button.toolTip()
