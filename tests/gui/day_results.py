"""The day's second half: calibrate, photograph, reconstruct, look back, faults, the end."""

from __future__ import annotations

from pathlib import Path

from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QFileDialog, QLineEdit, QWidget

from tests.gui.by_hand import CONTROL, KEY, Operator, step


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
    o.wait(lambda: "Will take" in panel.form.note.text())


@step("the first calibrated reconstruction")
def _(o: Operator) -> None:
    panel = o.panel("reconstructions")
    o.click(panel.form.start)
    o.wait(lambda: panel.result is not None)
    assert panel.result.path.is_relative_to(o.session.runs_folder)


@step("it is turned")
def _(o: Operator) -> None:
    panel = o.panel("reconstructions")
    upright = panel.picture.orientation
    assert upright.quarters == 2, "a simulated bench's"
    panel.picture.turn.menu().actions()[0].trigger()
    o.wait(lambda: panel.picture.orientation == upright.turned(1))


@step("it is exported as a picture")
def _(o: Operator) -> None:
    panel = o.panel("reconstructions")
    o.click(panel.export_button)
    _types_a_path(o, panel, o.folder / "picture.png")
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
    found: list[QFileDialog] = []
    o.wait(lambda: found.extend(d for d in parent.findChildren(QFileDialog) if d.isVisible()) or found)
    field = found[0].findChild(QLineEdit)
    assert field is not None
    field.setText(str(path))
    QTest.keyClick(found[0], KEY.Key_Return)
    QTest.mouseMove(o.window, QPoint(5, 5))
