"""An operator's day by clicks and keys alone, step by step, from a start in an empty folder.

``tests/gui/test_operators_day.py`` samples it; ``benchmarks/gui_day.py`` goes through all of it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PySide6.QtCore import QPoint, QSettings, QSize, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QLineEdit, QMessageBox, QPushButton, QWidget

from gui.main_window import MainWindow
from gui.session import BenchSession
from gui.widgets.dialogues import TextWindow
from instrument.bench.config import BenchConfig
from instrument.bench.config_file import no_bench
from instrument.files.images import write_image

KEY, CONTROL = Qt.Key, Qt.KeyboardModifier.ControlModifier
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


class Operator:
    """Clicks, types and looks; a window after the other, as ``gui.app`` shows them."""

    def __init__(self, folder: Path, size: QSize, wait_s: float = 300.0) -> None:
        self.folder, self.size, self._wait_s = folder, size, wait_s
        self._settings = QSettings(str(folder / "window.ini"), QSettings.Format.IniFormat)
        self.photographs = 0
        self.open(no_bench(folder))

    def open(self, config: BenchConfig) -> None:
        """Show the window for a bench."""
        self.session = BenchSession(config)
        self.window = MainWindow(self.session, self._settings, self.size)
        opened: list[bool] = []
        self.session.opened.connect(lambda: opened.append(True))
        self.window.show()
        self.session.open()
        self.wait(lambda: bool(opened))

    def another(self) -> None:
        """Wait until the window has closed for another bench, and show that one's."""
        before = self.window
        self.wait(lambda: before.session.is_closed and before.next_bench is not None)
        before.deleteLater()
        assert before.next_bench is not None
        self.open(before.next_bench)

    def wait(self, until: Callable[[], object]) -> None:
        """Let the window work until something is so."""
        end_s = time.monotonic() + self._wait_s
        while not until():
            assert time.monotonic() < end_s, f"waited {self._wait_s:g} s in vain"
            QTest.qWait(10)

    def panel(self, name: str) -> Any:
        """Return a panel, once it is made."""
        self.wait(lambda: name in self.window.maker.panels)
        return self.window.maker.panels[name]

    def click(self, widget: Any) -> None:
        """Click a widget that can be clicked."""
        self.wait(lambda: widget.isEnabled() and widget.isVisible())
        QTest.mouseClick(widget, Qt.MouseButton.LeftButton)

    def keys(
        self, key: Qt.Key, modifier: Qt.KeyboardModifier = Qt.KeyboardModifier.NoModifier, on: Any = None
    ) -> None:
        """Press a key where the keyboard is, or bring the keyboard somewhere first."""
        self.window.activateWindow()
        if on is not None:
            on.setFocus()
        QTest.keyClick(on or QApplication.focusWidget() or self.window, key, modifier)

    def goes_to(self, name: str, key: Qt.Key, modifier: Qt.KeyboardModifier = CONTROL) -> None:
        """Bring a panel to the front by its keys."""
        self.window.activateWindow()
        self.wait(self.window.isActiveWindow)
        QTest.keyClick(self.window, key, modifier)
        self.wait(self.panel(name).isVisible)

    def types(self, field: Any, text: str) -> None:
        """Type into a field that takes keys, and press Return."""
        self.wait(field.isEnabled)
        field.setFocus()
        field.selectAll()
        QTest.keyClicks(field, text)
        QTest.keyClick(field, KEY.Key_Return)

    def idle(self) -> None:
        """Wait until no job that is shown runs."""
        self.wait(lambda: all(job.quiet for job in self.session.jobs.jobs))

    def answers(self, words: str) -> None:
        """Answer the question in front."""
        boxes = [box for box in self.window.findChildren(QMessageBox) if box.isVisible()]
        self.click(next(b for box in boxes for b in box.buttons() if b.text() == words))

    def reads_and_closes(self, words: str) -> None:
        """Wait until the text in front has some words, and close it."""
        shown: list[TextWindow] = []
        self.wait(
            lambda: shown.extend(w for w in self.window.findChildren(TextWindow) if w.isVisible()) or shown
        )
        self.wait(lambda: words in shown[0].view.toPlainText())
        self.click(next(b for b in shown[0].findChildren(QPushButton) if "Close" in b.text()))
        self.window.activateWindow()

    def ends(self) -> None:
        """Close the window and wait until the bench is closed."""
        self.window.close()
        self.wait(lambda: self.session.is_closed)
        self.session.join()


@dataclass(frozen=True, slots=True)
class DayStep:
    """A step: what the operator does, and the function that does it and looks whether it came about."""

    words: str
    do: Callable[[Operator], None]


STEPS: list[DayStep] = []


def step(words: str) -> Callable[[Callable[[Operator], None]], Callable[[Operator], None]]:
    """Add a step to the day."""

    def add(do: Callable[[Operator], None]) -> Callable[[Operator], None]:
        STEPS.append(DayStep(words, do))
        return do

    return add


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


# Calibrate, photograph, reconstruct --------------------------------------------------------------------
@step("the strip leads to the calibration")
def _(o: Operator) -> None:
    o.wait(lambda: o.window.strip.button.isVisible() and o.window.strip.button.text() == "Calibrate…")
    o.click(o.window.strip.button)
    o.wait(lambda: o.panel("sweeps").isVisible() and o.panel("sweeps").routine.name == "axial")


@step("a wrong number of frames is refused, and mended")
def _(o: Operator) -> None:
    sweeps = o.panel("sweeps")
    o.wait(lambda: sweeps.run_bar.start_button.isEnabled())
    field = sweeps.view.widgets["average"]
    o.types(field, "0")
    o.wait(lambda: not sweeps.run_bar.start_button.isEnabled() and field.property("refused"))
    o.types(field, "2")
    o.wait(lambda: sweeps.run_bar.start_button.isEnabled())


@step("the sweep is begun by keys, paused, and goes on")
def _(o: Operator) -> None:
    sweeps = o.panel("sweeps")
    o.keys(KEY.Key_Return, CONTROL, on=sweeps.view.widgets["average"])
    o.wait(lambda: sweeps.run.is_running or bool(sweeps.use_button.isVisible()))
    if sweeps.run.is_running and sweeps.run_bar.pause_button.isEnabled():
        o.click(sweeps.run_bar.pause_button)
        o.click(sweeps.run_bar.pause_button)


@step("the PSF is good")
def _(o: Operator) -> None:
    sweeps = o.panel("sweeps")
    o.wait(lambda: not sweeps.run.is_running and sweeps.use_button.isVisible())
    assert "1 PSF good" in sweeps.verdict.toPlainText(), sweeps.verdict.toPlainText()


@step("the PSF is looked at")
def _(o: Operator) -> None:
    table = o.panel("sweeps").psfs.table
    place = table.visualItemRect(table.item(0, 0)).center()
    QTest.mouseClick(table.viewport(), Qt.MouseButton.LeftButton, pos=place)
    o.wait(lambda: "PSF 1 at" in o.panel("sweeps").frame_words.text())


@step("the live reconstruction has found the calibration")
def _(o: Operator) -> None:
    o.goes_to("live_reconstruction", KEY.Key_2)
    o.wait(lambda: o.panel("live_reconstruction").loaded is not None)


@step("the strip leads back to the photograph taken before, and it is handed on")
def _(o: Operator) -> None:
    o.wait(lambda: o.window.strip.button.text() == "Reconstruct…")
    o.click(o.window.strip.button)
    form = o.panel("reconstructions").form
    o.wait(lambda: form.text("image") and form.text(form.source))


@step("the better photograph: its own routine, dark frames taken off")
def _(o: Operator) -> None:
    o.goes_to("sweeps", KEY.Key_4)
    sweeps = o.panel("sweeps")
    while sweeps.routine.name != "photograph":
        o.keys(KEY.Key_Down, on=sweeps.choice)
    o.wait(lambda: sweeps.run_bar.start_button.isEnabled())
    o.click(sweeps.run_bar.start_button)
    o.wait(lambda: not sweeps.run.is_running and sweeps.use_button.isVisible())


@step("it goes into the form with the newest calibration")
def _(o: Operator) -> None:
    o.click(o.panel("sweeps").use_button)
    form = o.panel("reconstructions").form
    o.wait(lambda: "photograph.tif" in form.text("image") and form.text(form.source))


@step("why this model: it is explained")
def _(o: Operator) -> None:
    panel = o.panel("reconstructions")
    o.click(panel.form.explain)
    o.wait(lambda: "Chosen in" in panel.form.note.text())


@step("the first calibrated reconstruction")
def _(o: Operator) -> None:
    panel = o.panel("reconstructions")
    o.click(panel.form.start)
    o.wait(lambda: panel.result is not None)
    assert panel.result.path.is_relative_to(o.session.runs_folder)


@step("it is turned")
def _(o: Operator) -> None:
    panel = o.panel("reconstructions")
    panel.picture.turn.menu().actions()[0].trigger()
    o.wait(lambda: panel.picture.orientation.quarters == 1)


@step("it is exported as a picture")
def _(o: Operator) -> None:
    panel = o.panel("reconstructions")
    o.click(panel.export_button)
    _types_a_path(o, panel.viewers, o.folder / "picture.png")
    o.wait((o.folder / "picture.png").exists)


@step("the strip says that all is done")
def _(o: Operator) -> None:
    o.wait(lambda: "All is done" in o.window.strip.words.toolTip())


# Looking back ------------------------------------------------------------------------------------------
@step("the runs are listed")
def _(o: Operator) -> None:
    o.goes_to("runs", KEY.Key_5)
    o.wait(lambda: o.panel("runs").table.rowCount() >= 2)


@step("the newest is opened by keys")
def _(o: Operator) -> None:
    runs = o.panel("runs")
    o.keys(KEY.Key_Down, on=runs.table)
    o.wait(lambda: runs.opened is not None)


@step("its frames are gone through")
def _(o: Operator) -> None:
    slider = o.panel("runs").slider
    o.wait(lambda: slider.maximum() > 0)
    o.keys(KEY.Key_Home, on=slider)
    o.keys(KEY.Key_Right, on=slider)
    assert slider.value() == 1


@step("it is verified")
def _(o: Operator) -> None:
    runs = o.panel("runs")
    before = runs.about.toPlainText()
    o.click(runs.verify_button)
    o.wait(lambda: runs.about.toPlainText() != before)


@step("where methods fail")
def _(o: Operator) -> None:
    o.goes_to("charts", KEY.Key_C, CONTROL | Qt.KeyboardModifier.ShiftModifier)
    o.wait(lambda: "shipped" in o.panel("charts").heading.text())


@step("the alignment says which bench it takes")
def _(o: Operator) -> None:
    o.goes_to("alignment", KEY.Key_A, CONTROL | Qt.KeyboardModifier.ShiftModifier)


@step("the holograms ask for a picture")
def _(o: Operator) -> None:
    o.goes_to("holograms", KEY.Key_H, CONTROL | Qt.KeyboardModifier.ShiftModifier)
    panel = o.panel("holograms")
    o.click(panel.compute_button)
    o.wait(lambda: panel._note.text() or panel.form.reason("picture"))


@step("light and red, and dark again")
def _(o: Operator) -> None:
    for key in (KEY.Key_3, KEY.Key_2, KEY.Key_1):
        QTest.keyClick(o.window, key, CONTROL | Qt.KeyboardModifier.ShiftModifier)
        o.wait(lambda: not o.window.is_restyling)


@step("the log, only what warns")
def _(o: Operator) -> None:
    o.goes_to("log", KEY.Key_0)
    log = o.panel("log")
    o.keys(KEY.Key_Down, on=log.level)
    assert "STOP" in log.view.toPlainText()


# Faults and the end ------------------------------------------------------------------------------------
@step("the camera is unplugged, and said to be")
def _(o: Operator) -> None:
    o.session.bench.shared["simulated"].unplug("camera")  # type: ignore[attr-defined]
    o.wait(lambda: o.session.state("camera").condition == "failed")
    o.wait(lambda: o.window.strip.button.text() == "Reconnect" and o.window.strip.button.isVisible())


@step("plugged in, it comes back by the strip's button")
def _(o: Operator) -> None:
    o.session.bench.shared["simulated"].plug_in("camera")  # type: ignore[attr-defined]
    o.click(o.window.strip.button)
    o.wait(lambda: o.session.is_open("camera") and o.session.live.is_running)


@step("the device says who it is")
def _(o: Operator) -> None:
    o.click(o.window.chips.chips["stage"])
    o.reads_and_closes("SIM")


@step("the day ends: light off, nothing moving, all closed")
def _(o: Operator) -> None:
    o.ends()
    assert not any(device.is_open for device in o.session.bench.devices.values())


def _types_a_path(o: Operator, parent: QWidget, path: Path) -> None:
    """Type a path into the file dialogue in front."""
    from PySide6.QtWidgets import QFileDialog

    found: list[QFileDialog] = []
    o.wait(lambda: found.extend(d for d in parent.findChildren(QFileDialog) if d.isVisible()) or found)
    field = found[0].findChild(QLineEdit)
    assert field is not None
    field.setText(str(path))
    QTest.keyClick(found[0], KEY.Key_Return)
    QTest.mouseMove(o.window, QPoint(5, 5))
