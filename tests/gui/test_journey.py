"""The strip: what is done and what comes next, on every kind of bench."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from PySide6.QtCore import Qt
from pytestqt.qtbot import QtBot

from gui.journey import EXPOSING, Facts, Made, after_all, facts_of, light_of, made_in, next_of, steps_of
from gui.main_window import MainWindow
from gui.panels import PANELS
from gui.panels.sweeps import SweepsPanel
from instrument.bench.config_file import TEMPLATES, no_bench, parse_config, template
from instrument.bench.lit import LightState, switch_light
from instrument.runs.inspection import runs_and_photographs

WAIT_MS = 60_000
GOOD = Facts(light="good")
_CONTROL_SHIFT = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
WAYS = {
    "default": ["Connect", "Expose", "Calibrate", "Photograph", "Reconstruct"],
    "display": ["Connect", "Align", "Compute", "Show"],
    "led_microscope": ["Connect", "Expose", "Measure"],
    "screen": ["Connect", "Expose", "Calibrate", "Photograph", "Reconstruct"],
}


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_bench_has_a_way_whose_steps_lead_somewhere(name: str) -> None:
    config = parse_config(template(name), None)
    steps = steps_of(config, GOOD)
    assert [step.name for step in steps] == WAYS[name]
    assert all(step.panel in PANELS for step in steps[1:])
    first = next_of(steps)
    assert first is not None
    assert first.words.endswith(".")
    assert first.answer
    assert first.name == WAYS[name][1 if name == "display" else 2]


def test_the_way_of_a_camera_is_gone_step_by_step(tmp_path: Path) -> None:
    config = parse_config(template(), None)

    def step(facts: Facts) -> str:
        following = next_of(steps_of(config, facts))
        return "" if following is None else following.name

    assert step(Facts(opening=True)) == "Connect"
    assert step(Facts(failed=("stage",))) == "Connect"
    assert step(Facts()) == step(Facts(light="dark")) == step(Facts(light="saturated")) == "Expose"
    held = next_of(steps_of(config, Facts(light="held")))
    assert held is not None
    assert "“Live”" in held.words
    assert step(GOOD) == "Calibrate"
    paths = [tmp_path / name for name in ("calibration", "photo.tif", "result.json")]
    for number, path in enumerate(paths):
        path.write_text("")
        os.utime(path, (100 + number, 100 + number))
    made = Made(calibration=paths[0])
    assert step(replace(GOOD, made=made)) == step(Facts(light="dark", made=made)) == "Photograph"
    made = replace(made, photograph=paths[1])
    assert step(replace(GOOD, made=made)) == "Reconstruct"
    made = replace(made, result=paths[2])
    done = replace(GOOD, made=made)
    assert step(done) == ""
    assert after_all(config, done).words.endswith("the newest result is result.")  # not its record
    assert step(replace(GOOD, made=replace(made, stale=True))) == "Reconstruct"  # another photograph
    assert next_of(steps_of(no_bench(tmp_path), Facts())).panel == "start"  # type: ignore[union-attr]


def test_what_lies_in_a_folder_is_found(tmp_path: Path) -> None:
    assert made_in(tmp_path / "nothing") == Made()
    for name in ("photographs/a.tif", "x_photograph/photograph.tif", "mask_alignment.json", "y_dpc/dpc.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    os.utime(tmp_path / "photographs/a.tif", (100, 100))
    (tmp_path / "photographs/.b.tif.12ab34cd.part.tif").write_text("")
    assert runs_and_photographs(tmp_path) == [tmp_path / "photographs/a.tif"]
    made = made_in(tmp_path)
    assert made.photograph == tmp_path / "x_photograph/photograph.tif"
    assert made.alignment == tmp_path / "mask_alignment.json"
    assert made.surface == tmp_path / "y_dpc/dpc.json"


def test_the_strip_names_the_next_step_and_leads_there(
    qtbot: QtBot, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    strip = window.strip
    session = window.session
    assert light_of(session.live.newest()) in ("good", "dark", "saturated")
    switch_light(session.bench, LightState.DARK)
    qtbot.waitUntil(lambda: facts_of(session, Made()).light == "dark", timeout=WAIT_MS)
    switch_light(session.bench, LightState.SCENE)
    assert facts_of(session, Made()).light == "awaited", "the newest frame is of the light before"
    monkeypatch.setattr("gui.widgets.step_strip.facts_of", lambda _session, _made: given[0])
    given = [GOOD]
    strip.look()
    given = [Facts(light="held")]
    strip.look()  # the picture was well exposed before it was held, and is so still
    assert "▸&nbsp;Calibrate" in strip.marks.text()
    monkeypatch.undo()
    strip.show_facts(GOOD)
    assert "▸&nbsp;Calibrate" in strip.marks.text()
    assert "✓&nbsp;Connect" in strip.marks.text()
    qtbot.mouseClick(strip.button, Qt.MouseButton.LeftButton)
    sweeps = window.panel("sweeps")
    assert isinstance(sweeps, SweepsPanel)
    assert window.tabs.currentWidget() is window._places["sweeps"]
    assert sweeps.routine.name == "axial"
    strip.show_facts(replace(GOOD, made=Made(calibration=Path("c"))))
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow)
    qtbot.keyClick(window, Qt.Key.Key_Return, _CONTROL_SHIFT)
    assert sweeps.routine.name == "photograph"
    job = window.session.exclusive_job("A run", lambda context: context.cancel.wait(WAIT_MS / 1000))
    strip.look()
    assert strip.words.toolTip() == "A run is under way …"
    assert not strip.button.isVisible()
    job.cancel()
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
    lanes = {"camera"}
    job = window.session.jobs.device(EXPOSING, lambda context: context.cancel.wait(WAIT_MS / 1000), lanes)
    strip.look()
    assert strip.words.toolTip() == "Auto exposure is under way …"
    assert not strip.button.isVisible()
    job.cancel()
    qtbot.waitUntil(lambda: job.is_over, timeout=WAIT_MS)
