"""Screenshots of every panel of the desktop program, on SIMULATED benches, for docs/desktop.md.

    python benchmarks/gui_screenshots.py --out docs/images/gui
    python benchmarks/gui_screenshots.py --out /tmp/shots --size 1920x1080 --panel reconstructions

What the panels show is made first, with the commands that an operator uses: a calibration and a photograph of
beads, reconstructed as picture and volume in the window itself, and a hologram on a display whose mask was
aligned. ``--work`` keeps that between calls. Needs no screen (QT_QPA_PLATFORM=offscreen). A few minutes.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.append(str(Path(__file__).parents[1]))

import numpy as np
from PySide6.QtCore import (
    QCoreApplication,
    QEvent,
    QPoint,
    QPointF,
    QSettings,
    QSize,
    Qt,
    QtMsgType,
    qInstallMessageHandler,
)
from PySide6.QtGui import QMouseEvent
from PySide6.QtTest import QTest

import instrument
from gui.app import application
from gui.jobs import Job
from gui.main_window import MainWindow
from gui.panel import Panel
from gui.panels import PANELS
from gui.session import BenchSession
from gui.theme import THEMES, apply_theme
from instrument.bench.config_file import parse_config
from instrument.cli import main as command
from instrument.files.images import write_image
from instrument.files.sample_images import load_sample
from tests.gui.event_loop import let_work, wait_until

SIZE = "1600x980"
WAIT_S = 900.0
LIT_COUNTS = 500
SETTLE_MS = 1500
"""For the live view's first frames, histograms and what else comes by timers."""
CAMERA = """\
[bench]
name = "simulated bench"
data_folder = "runs"
[camera]
driver = "simulated"
exposure_ms = 1.0
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[slm]
driver = "simulated"
shape = [540, 960]
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "tiny"
scene = "beads"
beads = 12
bead_diameter_um = 300.0
scene_distance_mm = 40.84
scene_depth_mm = 50.0
"""
FILM_FRAMES = 40
FILM_REGIONS = ((0.4, 0.3), (0.5, 0.55))
"""Corners, fractions of the view."""
SWEEP = ["--z-min", "22", "--z-max", "80", "--planes", "12", "--average", "2"]
EXPOSURES_MS = {"beads": 1.0, "bars": 60.0}
PICTURE_Z_MM = "40.84"
LENS_TURNS = 20.0
"""Of phase, from the middle of the SLM over its longer side."""
SMALL_DISPLAY = {"shape": "[200, 280]", "shift_um": "[31.0, -42.0]", "z_um": "80.0"}
"""The display that ships takes minutes to align; a small one, less far off, takes one."""
ALIGNMENT = {"reach": "8", "depth_um": "100"}
DISPLAY = {"holograms", "alignment"}
"""Panels that are shown on the holographic display instead of the camera."""


def main() -> int:
    """Make the screenshots."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    parser.add_argument("--work", type=Path, default=Path("runs/screenshots"), help="folder of what is shown")
    parser.add_argument("--size", default=SIZE, help=f"of the window in pixels, default {SIZE}")
    parser.add_argument("--theme", choices=list(THEMES), default="dark")
    parser.add_argument("--panel", action="append", choices=list(PANELS), help="only this one; repeatable")
    given = parser.parse_args()
    width, height = (int(part) for part in given.size.split("x"))
    given.out.mkdir(parents=True, exist_ok=True)
    work = given.work.resolve()
    names = given.panel or list(PANELS)
    qInstallMessageHandler(_quietly)
    apply_theme(application(), given.theme)
    if set(names) - DISPLAY:
        _prepare_camera(work / "camera")
        window = _open(work / "camera", width, height)
        for name in names:
            if name not in DISPLAY:
                _show(window, name, given.out)
        _close(window)
    if set(names) & DISPLAY:
        _prepare_display(work / "display")
        window = _open(work / "display", width, height)
        if "alignment" in names:
            _align(window)
            _grab(window, given.out / "alignment.png")
        if "holograms" in names:
            _hologram(window)
            _grab(window, given.out / "holograms.png")
        _close(window)
    return 0


# What is shown -----------------------------------------------------------------------------------------
def _prepare_camera(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    bench = folder / "bench.toml"
    fast = CAMERA.replace('preset = "tiny"', 'preset = "tiny"\ntime_scale = 0.0')
    bench.write_text(fast)
    if not list((folder / "runs").glob("*/calibration")):
        _do("calibrate", "axial", "--bench", bench, *SWEEP)
    for scene, exposure_ms in EXPOSURES_MS.items():
        bench.write_text(fast.replace('scene = "beads"', f'scene = "{scene}"'))
        if not (folder / f"{scene}.tif").exists():
            _do("snap", "--bench", bench, "--exposure-ms", exposure_ms, "--out", folder / f"{scene}.tif")
    bench.write_text(fast)
    if not list((folder / "runs").glob("*recording")):
        _do("record", "--bench", bench, "--frames", FILM_FRAMES, "--exposure-ms", 1)
    if not (folder / "chart" / "chart.json").exists():
        _do("chart", "scene", "sparse-picture", "--size", 32, "--budget", 30, "--out", folder / "chart")
    bench.write_text(CAMERA)


def _prepare_display(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    text = (Path(instrument.__file__).parent / "bench" / "display_bench.toml").read_text()
    for key, value in SMALL_DISPLAY.items():
        text, count = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
        if count != 1:
            raise SystemExit(f"display_bench.toml has {count} lines {key}; one is expected.")
    (folder / "bench.toml").write_text(text)
    write_image(folder / "portrait.png", np.round(255 * load_sample("portrait", (512, 512))).astype(np.uint8))


def _do(*words: object) -> None:
    if command([str(word) for word in words]) != 0:
        raise SystemExit(f"diffuserbench {' '.join(map(str, words))} failed.")


# The window --------------------------------------------------------------------------------------------
def _open(folder: Path, width: int, height: int) -> MainWindow:
    bench = folder / "bench.toml"
    session = BenchSession(parse_config(bench.read_text(), bench))
    settings = QSettings(str(folder / "window.ini"), QSettings.Format.IniFormat)
    settings.clear()
    window = MainWindow(session, settings, QSize(width, height))
    window.resize(width, height)
    window.show()
    opened: list[bool] = []
    session.opened.connect(lambda: opened.append(True))
    session.open()
    _wait(lambda: bool(opened), "the bench to open")
    if folder.name == "camera":
        _wait(lambda: _is_lit(session), "the first frame with light")
    let_work(SETTLE_MS)
    return window


def _is_lit(session: BenchSession) -> bool:
    frame = session.live.newest()
    return frame is not None and int(frame.image.max()) > LIT_COUNTS


def _close(window: MainWindow) -> None:
    for panel in window._panels.values():
        panel.shutdown()
    window.session.close()
    _wait(lambda: window.session.is_closed, "the bench to close")


def _show(window: MainWindow, name: str, out: Path) -> None:
    window.show_panel(name)
    let_work(SETTLE_MS)
    if name == "reconstructions":
        _reconstructions(window, out)
        return
    if name == "sweeps":
        _sweep(window)
    if name == "runs":
        _first_run(window)
    if name == "led_array":
        _half(window)
    if name == "slm":
        _lens(window)
    if name == "films":
        _film(window)
    if name == "tasks":
        _analysis(window)
    _grab(window, out / f"{name}.png")
    if name == "charts":
        _chart(window)
        _grab(window, out / "chart.png")


def _chart(window: MainWindow) -> None:
    """Open the chart of speed against accuracy."""
    from gui.panels.charts import ChartsPanel

    panel = window.panel("charts")
    assert isinstance(panel, ChartsPanel)
    panel.open(panel.session.runs_folder.parent / "chart" / "chart.json")
    _wait(lambda: bool(panel.chart.front), "the chart")


def _half(window: MainWindow) -> None:
    """Light a half circle of LEDs."""
    from gui.panels.led_array import LedPanel

    panel = window.panel("led_array")
    assert isinstance(panel, LedPanel)
    panel.pattern_buttons["DPC left"].click()
    _wait(lambda: panel._drawn is not None and not panel._drawn.is_dark, "the LEDs")


def _lens(window: MainWindow) -> None:
    """Show the phase of a lens on the SLM."""
    from gui.panels.slm import SlmPanel

    panel = window.panel("slm")
    assert isinstance(panel, SlmPanel)
    slm = panel.session.bench.slm
    assert slm is not None
    y, x = (np.arange(n) - n / 2 for n in slm.shape)
    turns = (y[:, None] ** 2 + x**2) * (LENS_TURNS / max(slm.shape) ** 2)
    picture = panel.session.runs_folder.parent / "lens.png"
    write_image(picture, np.round(256 * (turns % 1)).astype(np.uint8))
    panel.file.setText(str(picture))
    panel.load()
    _wait(lambda: slm.displayed.any(), "the SLM")


def _film(window: MainWindow) -> None:
    """Open a recording, and follow two regions in it."""
    from gui.panels.films import FilmsPanel

    panel = window.panel("films")
    assert isinstance(panel, FilmsPanel)
    panel.open(next(panel.session.runs_folder.glob("*recording")))
    _wait(lambda: panel.film is not None, "the film")
    panel.region_button.click()
    for left, top in FILM_REGIONS:
        _drag(panel.view, (left, top), (left + 0.12, top + 0.15))
    _wait(lambda: len(panel.courses) == len(FILM_REGIONS), "the curves")


def _drag(view: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Drag the mouse over a picture, between places in fractions of the view."""
    port = view.graphics.viewport()
    places = [QPoint(round(x * port.width()), round(y * port.height())) for x, y in (start, end)]
    QTest.mousePress(port, Qt.MouseButton.LeftButton, pos=places[0])
    for share in np.linspace(0, 1, 6):
        at = places[0] + (places[1] - places[0]) * float(share)
        move = QMouseEvent(
            QEvent.Type.MouseMove,
            QPointF(at),
            QPointF(port.mapToGlobal(at)),
            Qt.MouseButton.NoButton,
            Qt.MouseButton.LeftButton,
            Qt.KeyboardModifier.NoModifier,
        )  # QTest's own hold no button
        QCoreApplication.sendEvent(port, move)
        let_work(60)  # pyqtgraph thins out what comes sooner
    QTest.mouseRelease(port, Qt.MouseButton.LeftButton, pos=places[1])


def _analysis(window: MainWindow) -> None:
    """Analyse the calibration in Files."""
    from gui.panels.tasks import TasksPanel

    panel = window.panel("tasks")
    assert isinstance(panel, TasksPanel)
    calibration = sorted(panel.session.runs_folder.glob("*/calibration"))[0]
    panel.choose("analyze", calibration=calibration, points=False)
    _wait(lambda: panel.name == "analyze" and panel.run_bar.start_button.isEnabled(), "the form")
    over: list[bool] = []
    panel.run.over.connect(lambda: over.append(True))
    panel.start()  # which may wait for a name that no file has
    _wait(lambda: bool(over), "the analysis")


def _sweep(window: MainWindow) -> None:
    """Carry out an axial sweep with the form."""
    from gui.panels.sweeps import SweepsPanel

    panel = window.panel("sweeps")
    assert isinstance(panel, SweepsPanel)
    _wait(lambda: panel.outlook is not None, "the first look at the form")
    _type(panel, {"z_min_um": "22", "z_max_um": "80", "planes": "6", "average": "2"})
    over: list[bool] = []
    panel.run.over.connect(lambda: over.append(True))
    panel.run_bar.start_button.click()
    _wait(lambda: bool(over), "the sweep")


def _type(panel: Any, numbers: dict[str, str]) -> None:
    """Type numbers into a procedure's form and wait until it is found right."""
    for name, text in numbers.items():
        field: Any = panel.view.widgets[name]
        field.setFocus()
        field.selectAll()
        QTest.keyClicks(field, text)
    let_work(SETTLE_MS)
    _wait(lambda: panel.run_bar.start_button.isEnabled(), "the form to be right")


def _first_run(window: MainWindow) -> None:
    """Open a run and look at a frame in its middle."""
    from gui.panels.runs import RunsPanel

    panel = window.panel("runs")
    assert isinstance(panel, RunsPanel)
    _wait(lambda: panel.table.rowCount() > 0, "the list of runs")
    last = panel.table.visualItemRect(panel.table.item(panel.table.rowCount() - 1, 0)).center()
    QTest.mouseClick(panel.table.viewport(), Qt.MouseButton.LeftButton, pos=last)
    _wait(lambda: panel.slider.maximum() > 0, "the run's frames")
    panel.slider.setValue(panel.slider.maximum() // 2)


def _reconstructions(window: MainWindow, out: Path) -> None:
    """Reconstruct a picture and a volume with the form, and look at them."""
    from gui.forms.reconstruct import CALIBRATION, VOLUME
    from gui.panels.reconstructions import ReconstructionsPanel

    panel = window.panel("reconstructions")
    assert isinstance(panel, ReconstructionsPanel)
    folder = panel.session.runs_folder.parent
    calibration = sorted(panel.session.runs_folder.glob("*/calibration"))[0]
    form = panel.form
    for kind, scene, prior, tau, shot in (
        (CALIBRATION, "bars", "tv", None, "reconstruct"),
        (VOLUME, "beads", "l1", 0.05, "volume"),
    ):
        panel.tabs.setCurrentWidget(form)
        form.options.set_values({"kind": kind})
        form.options.set_values(
            {
                "image": folder / f"{scene}.tif",
                form.source: calibration,
                "z_um": 1e3 * float(PICTURE_Z_MM),
                "prior": prior,
                "tau": tau,
                "iterations": 150,
            }
        )
        panel._suggest_out()
        _wait(lambda: not panel.jobs.jobs, "a free name")
        job = panel.reconstruct()
        _wait_for(job, panel)
        _wait(lambda: panel.result is not None, "the result to open")
        if kind == CALIBRATION:
            _grab(window, out / f"{shot}.png")
            continue
        _wait(lambda: panel.volume.projections is not None, "the projections")
        panel.tabs.setCurrentIndex(0)
        _grab(window, out / f"{shot}.png")
        brightest = np.unravel_index(
            panel.volume.projections.front.argmax(), panel.volume.projections.front.shape
        )
        plane = int(panel.volume.projections.deepest[brightest])
        panel.volume.set_mode("slices")
        panel.volume.go_to(plane, int(brightest[0]), int(brightest[1]))
        _grab(window, out / "slices.png")


def _hologram(window: MainWindow) -> None:
    """Compute a foveated hologram, show it, photograph it."""
    from gui.panels.holograms import HologramsPanel

    folder = window.session.runs_folder
    if not list(folder.glob("*alignment*.json")):
        _align(window)
    alignments = sorted(folder.glob("*alignment*.json"), key=lambda path: path.stat().st_mtime)
    panel = window.show_panel("holograms")
    assert isinstance(panel, HologramsPanel)
    panel.form.set_values(
        {
            "picture": folder.parent / "portrait.png",
            "alignment": alignments[-1],
            "counts": "a fovea, dragged",
            "iterations": 60,
        }
    )
    panel.target.set_fovea((0.42, 0.5), 0.24)
    for start in (panel.compute, panel.photograph):
        _wait_for(start(), panel)


def _align(window: MainWindow) -> None:
    """Find the mask and bring it to its place."""
    from gui.panels.alignment import AlignmentPanel

    panel = window.show_panel("alignment")
    assert isinstance(panel, AlignmentPanel)
    _wait(lambda: panel.outlook is not None, "the first look at the form")
    _type(panel, ALIGNMENT)
    over: list[bool] = []
    panel.run.over.connect(lambda: over.append(True))
    panel.run_bar.start_button.click()
    _wait(lambda: bool(over), "the alignment")
    if not list(panel.session.runs_folder.glob("*alignment*.json")):
        raise SystemExit(f"The alignment: {panel._note.toolTip() or panel.run_bar.words.text()}")


def _grab(window: MainWindow, path: Path) -> None:
    let_work(SETTLE_MS)
    if not window.grab().save(str(path)):
        raise SystemExit(f"{path}: could not be written.")
    print(path)


def _wait_for(job: Job | None, panel: Panel) -> None:
    """Wait for the end of a job; SystemExit with the reason of one that was refused or failed."""
    if job is None:
        raise SystemExit(panel._note.toolTip())
    _wait(lambda: job.is_over, job.title)
    if job.error is not None:
        raise SystemExit(f"{job.title}: {job.error}")


def _wait(until: Callable[[], bool], what: str) -> None:
    try:
        wait_until(until, WAIT_S)
    except TimeoutError:
        raise SystemExit(f"Waited {WAIT_S:g} s for {what} in vain.") from None


def _quietly(kind: QtMsgType, _context: object, text: str) -> None:
    """Pass on Qt's messages but the one that the offscreen platform has for every window."""
    if "propagateSizeHints" not in text:
        print(f"{kind.name}: {text}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
