"""The day's first half: the start page, the camera, stage, light and SLM by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication, QPushButton, QWidget

from instrument.files.images import write_image
from tests.gui.by_hand import CONTROL, KEY, Operator, step

BENCH = """\
[bench]
name = "simulated bench"
data_folder = "runs"
[camera]
driver = "simulated"
exposure_ms = 300.0
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
leds = 89
[slm]
driver = "simulated"
shape = [60, 80]
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0.03
scene = "picture"
scene_distance_mm = 100
"""


def _counts(o: Operator) -> float:
    frame = o.session.live.newest()
    return 0.0 if frame is None else float(np.percentile(frame.image, 99.9))


def _light(o: Operator, words: str) -> None:
    live = o.panel("live")
    o.click(next(b for b in live.light_buttons.buttons() if b.text() == words))
    o.idle()


def _same(names: Sequence[QWidget]) -> bool:
    return all(widget.isVisible() for widget in names)


# The first hour ----------------------------------------------------------------------------------------
@step("the start page is there, without a bench")
def _(o: Operator) -> None:
    assert _same(list(o.panel("start").cards.values()))


@step("F1 tells what it is for")
def _(o: Operator) -> None:
    o.keys(KEY.Key_F1)
    o.reads_and_closes("Try the camera")


@step("the live view says that it needs a bench")
def _(o: Operator) -> None:
    o.goes_to("live", KEY.Key_1)
    o.keys(KEY.Key_Home, Qt.KeyboardModifier.AltModifier)
    o.wait(o.panel("start").isVisible)


@step("what is connected is looked for, and left alone")
def _(o: Operator) -> None:
    start = o.panel("start")
    o.click(start.cards["new"])
    o.wait(lambda: "needs one" in start.new_bench.said.text() or start.new_bench.chosen)
    o.click(next(b for b in start.new_bench.findChildren(QPushButton) if b.text() == "Back"))


@step("Try the camera opens the simulated bench in its place")
def _(o: Operator) -> None:
    file = o.folder / "simulated-default" / "bench.toml"
    file.parent.mkdir(exist_ok=True)
    file.write_text(BENCH)  # a small one: the bench that ships has five megapixels
    o.click(o.panel("start").cards["default"])
    o.another()
    assert o.session.config.path == file


@step("all devices are open, SIMULATED is shown")
def _(o: Operator) -> None:
    assert o.window.simulated.isVisible()
    assert all(o.session.is_open(kind) for kind in o.session.kinds)


@step("the first frame, lit")
def _(o: Operator) -> None:
    o.goes_to("live", KEY.Key_1)
    o.wait(lambda: _counts(o) > 0 and o.panel("live").picture.frame is not None)


@step("the light goes off, and the picture is dark")
def _(o: Operator) -> None:
    o.wait(lambda: o.window.strip.step.name == "Calibrate")  # lit: the strip is past Expose
    o.idle()
    lit = _counts(o)
    _light(o, "Dark")
    o.wait(lambda: _counts(o) < 0.7 * lit)


@step("the light comes on again")
def _(o: Operator) -> None:
    dark = _counts(o)
    _light(o, "Scene")
    o.wait(lambda: _counts(o) > 1.3 * dark)


@step("the strip says that the picture can be used")
def _(o: Operator) -> None:
    o.wait(lambda: "✓&nbsp;Expose" in o.window.strip.marks.text())


# The camera --------------------------------------------------------------------------------------------
@step("a wrong exposure is refused where it stands")
def _(o: Operator) -> None:
    field = o.panel("live").form.widgets["exposure_ms"]
    o.types(field, "-5")
    o.wait(lambda: field.property("refused"))


@step("a right one is taken, in seconds")
def _(o: Operator) -> None:
    o.types(o.panel("live").form.widgets["exposure_ms"], "0.25 s")
    o.wait(lambda: abs(o.session.bench.camera.exposure_ms - 250) < 5)


@step("Auto finds one")
def _(o: Operator) -> None:
    form = o.panel("live").form
    o.click(form.auto_button)
    o.idle()
    o.wait(form.auto_button.isEnabled)


@step("the live view is held")
def _(o: Operator) -> None:
    o.keys(KEY.Key_L, CONTROL)
    o.wait(lambda: not o.session.live.is_running)


@step("and goes on")
def _(o: Operator) -> None:
    o.keys(KEY.Key_L, CONTROL)
    o.wait(lambda: o.session.live.is_running)


@step("cross-hair, profile and region, on and off")
def _(o: Operator) -> None:
    picture = o.panel("live").picture
    for button in (picture.cross_button, picture.profile_button, picture.region_button):
        o.click(button)
        assert button.isChecked()
        o.click(button)


@step("another colour map, by keys")
def _(o: Operator) -> None:
    box = o.panel("live").picture.colour_map
    before = box.currentText()
    o.keys(KEY.Key_Down, on=box)
    assert box.currentText() != before


@step("a photograph, by keys")
def _(o: Operator) -> None:
    o.keys(KEY.Key_K, CONTROL)
    o.wait(lambda: o.panel("live").photograph is not None)
    o.idle()


@step("another, of three frames")
def _(o: Operator) -> None:
    live = o.panel("live")
    first = live.photograph
    o.types(live.average, "3")
    o.click(live.snap_button)
    o.wait(lambda: live.photograph != first)


@step("no photograph of no frames")
def _(o: Operator) -> None:
    live = o.panel("live")
    o.types(live.average, "0")
    o.wait(lambda: live.average.property("refused"))
    o.types(live.average, "1")


@step("a recording of a tenth of a second")
def _(o: Operator) -> None:
    bar = o.panel("live").record_bar
    o.types(bar.seconds, "0.1")
    o.click(bar.button)
    o.wait(lambda: any(o.session.runs_folder.glob("*recording*")))
    o.idle()


@step("all settings of the camera are read")
def _(o: Operator) -> None:
    o.click(o.panel("live").form.all_button)
    o.reads_and_closes("exposure")


@step("the lines of Python are copied")
def _(o: Operator) -> None:
    o.click(o.panel("live").copy_button)
    compile(QApplication.clipboard().text(), "day", "exec")


# Stage, light, SLM -------------------------------------------------------------------------------------
@step("the stage asks before it homes")
def _(o: Operator) -> None:
    o.goes_to("stage", KEY.Key_7)
    o.click(o.panel("stage").home_button)
    o.answers("Home")
    o.idle()


@step("the stage goes where it is told")
def _(o: Operator) -> None:
    o.types(o.panel("stage").rows["x_um"].target, "500 um")
    o.wait(lambda: abs(o.session.bench.stage.position()["x_um"] - 500) < 1)
    o.idle()


@step("beyond its limits it does not go")
def _(o: Operator) -> None:
    target = o.panel("stage").rows["x_um"].target
    o.types(target, "9999999 um")
    o.wait(lambda: target.property("refused"))


@step("a jog by the arrow keys")
def _(o: Operator) -> None:
    before = o.session.bench.stage.position()["y_um"]
    o.keys(KEY.Key_Up, on=o.panel("stage").pad)
    o.wait(lambda: o.session.bench.stage.position()["y_um"] > before)
    o.idle()


@step("another along the axis, ten steps at once")
def _(o: Operator) -> None:
    before = o.session.bench.stage.position()["z_um"]
    o.keys(KEY.Key_PageUp, Qt.KeyboardModifier.ShiftModifier, on=o.panel("stage").pad)
    o.wait(lambda: o.session.bench.stage.position()["z_um"] > before + 900)
    o.idle()


@step("STOP by Escape, on the way")
def _(o: Operator) -> None:
    stopped: list[bool] = []
    o.session.stopped.connect(lambda: stopped.append(True))
    o.types(o.panel("stage").rows["x_um"].target, "50000 um")
    o.keys(KEY.Key_Escape)
    o.wait(lambda: bool(stopped) and not o.session.bench.stage.is_moving)
    o.idle()


@step("bright field on the LED array")
def _(o: Operator) -> None:
    o.goes_to("led_array", KEY.Key_8)
    o.click(o.panel("led_array").pattern_buttons["Bright field"])
    o.wait(lambda: not o.session.bench.led_array.pattern.is_dark)
    o.idle()


@step("and off")
def _(o: Operator) -> None:
    o.click(o.panel("led_array").pattern_buttons["Off"])
    o.wait(lambda: o.session.bench.led_array.pattern.is_dark)
    o.idle()


@step("a picture on the SLM")
def _(o: Operator) -> None:
    picture = o.folder / "phase.png"
    write_image(picture, np.tile(np.arange(80, dtype=np.uint8), (60, 1)))
    o.goes_to("slm", KEY.Key_9)
    slm = o.panel("slm")
    o.types(slm.file, str(picture))
    o.wait(lambda: o.session.bench.slm.displayed.any())
    o.idle()


@step("the SLM blank")
def _(o: Operator) -> None:
    o.click(o.panel("slm").blank_button)
    o.wait(lambda: not o.session.bench.slm.displayed.any())
    o.idle()
