"""Every task of *Files* by its button, from its form to what was found, with what the commands wrote before.

    python benchmarks/gui_tasks.py --folder /tmp/files
    python benchmarks/gui_tasks.py --folder /tmp/files --only compare --only table7.1

Runs are made with the commands on a small simulated bench and kept in the folder. Each task is chosen in the
list, a few fields are filled in, *Start* is clicked; its time, last words and files are printed, a picture
of the window is kept for each, and faults of its looks are told (``tests/gui/looks.py``). Exit status 1 where
a task fails. Needs no screen.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.append(str(Path(__file__).parents[1]))

import gui_screenshots as shots
import numpy as np
from PySide6.QtCore import Qt, qInstallMessageHandler
from PySide6.QtTest import QTest

from gui.app import application
from gui.panels.tasks import TasksPanel
from gui.theme import apply_theme
from instrument.files.images import write_image
from instrument.files.sample_images import load_sample
from instrument.tasks import TASKS
from tests.gui.event_loop import let_work
from tests.gui.looks import faults

SWEEP = ["--z-min", "22", "--z-max", "80", "--planes", "3"]
FRAMES = 30


def main() -> int:
    """Carry out the tasks one after another."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="where runs and results are kept")
    parser.add_argument("--size", default="1350x690", help="of the window in pixels, default 1350x690")
    parser.add_argument("--only", action="append", choices=list(TASKS), help="only this one; repeatable")
    given = parser.parse_args()
    folder = given.folder.resolve() / "camera"
    made = _made(folder)
    qInstallMessageHandler(shots._quietly)
    apply_theme(application(), "dark")
    window = shots._open(folder, *(int(part) for part in given.size.split("x")))
    panel = window.show_panel("tasks")
    assert isinstance(panel, TasksPanel)
    failed = []
    for name in given.only or TASKS:
        began_s = time.monotonic()
        good, words = _carried_out(panel, name, made)
        wrong = list(faults(window))
        failed += [] if good and not wrong else [name]
        files = ", ".join(path.name for path in panel.found.files) or "no files"
        print(f"{'' if good else 'FAILS '}{name}: {time.monotonic() - began_s:.0f} s, {files}")
        print(f"    {' '.join(words.split())[-300:]}", *wrong, sep="\n    ", flush=True)
        shots._grab(window, given.folder / f"{name.replace(' ', '-')}.png")
    shots._close(window)
    print(f"{len(failed)} failed: {', '.join(failed)}" if failed else "all of them came to their end")
    return 1 if failed else 0


def _made(folder: Path) -> dict[str, dict[str, Any]]:
    """Make what the tasks work with, where it is not there yet; returns the fields that each is given."""
    folder.mkdir(parents=True, exist_ok=True)
    bench = folder / "bench.toml"
    bench.write_text(shots.CAMERA.replace('preset = "tiny"', 'preset = "tiny"\ntime_scale = 0.0'))
    portrait = folder / "portrait.png"
    write_image(portrait, np.round(255 * load_sample("portrait", (64, 64))).astype(np.uint8))
    np.save(folder / "film.npy", np.ones((3, 8, 9), np.uint16))
    runs = folder / "runs"
    while len(list(runs.glob("*sweep/calibration"))) < 2:
        shots._do("calibrate", "axial", "--bench", bench, *SWEEP)
    if not list(runs.glob("*recording")):
        shots._do("record", "--bench", bench, "--frames", FRAMES, "--exposure-ms", 1)
    if not (folder / "photo.tif").exists():
        shots._do("snap", "--bench", bench, "--exposure-ms", 1, "--out", folder / "photo.tif")
    lamp, plan = folder / "lamp.toml", folder / "patterns.toml"
    if not plan.exists():
        for scene in ("picture", "sheet"):
            lamp.write_text(bench.read_text().replace('"beads"', f'"{scene}"\nled_light = "scene"'))
            plan.unlink(missing_ok=True)
            shots._do("plan", "illumination", "--bench", lamp, "--lattice", 2, plan)
            shots._do("run", plan, "--bench", lamp)
    volume = folder / "volume.ome.zarr"
    if not volume.exists():
        planes = sorted(runs.glob("*sweep/calibration"))[0]
        shots._do(
            "reconstruct", "-i", folder / "photo.tif", "--volume", planes, "--bin", 4, "-n", 30, "-o", volume
        )
    lit, sheet = sorted(runs.glob("*active-illumination"))[-2:]
    old, new = sorted(runs.glob("*sweep/calibration"))[:2]
    recording = sorted(runs.glob("*recording"))[-1]
    photo = folder / "photo.tif"
    at, light = {"calibration": new, "z_um": 40_000.0}, {"z_um": 40_000.0, "binning": 4}
    return {
        "verify": {"runs": (recording,)},
        "export": {"run": recording, "out": folder.parent / f"frames-{time.monotonic_ns()}.tif"},
        "import": {"film": folder / "film.npy", "frames_per_s": 10.0, "pixel_um": 5.0},
        "video": {"run": recording, **at, "binning": 8, "film": False},
        "activity": {"video": recording, **at, "binning": 8, "window_s": 0.1},
        "patterned": {"run": lit, "patterned": sheet, **at, "iterations": 10},
        "table7.1": {"slm": "27x48", "expansion": (4,), "iterations": 5, "pictures": ("portrait",)},
        "chart scene": {"name": "sparse-picture", "size": 32, "budget_s": 20.0},
        "chart photograph": {"image": photo, **at, "binning": 4, "budget_s": 20.0},
        "chart hologram": {"targets": (portrait,), "slm": "27x48", "bench": None, "budget_s": 20.0},
        "chart calibrations": {"folders": (old, new), "image": photo, **light, "budget_s": 20.0},
        "points": {"volume": volume, "fit": True},
        "stability": {"names": ("light",), "method": ("wiener",)},
        "limit": {"target": portrait, "iterations": 3},
        "spots": {"spots": "2x2", "iterations": 3},
        "analyze": {"calibration": new, "points": False},
        "compare": {"old": old, "new": new},
        "optics": {"photons": (30000.0,), "beads": 5, "iterations": 3},
        "refocus": {**at},
    }


def _carried_out(panel: TasksPanel, name: str, made: dict[str, dict[str, Any]]) -> tuple[bool, str]:
    """Choose a task in the list by keys, fill in its fields, click Start, wait for its end."""
    ended: list[str] = []
    told = [
        panel.run.succeeded.connect(lambda _: ended.append("")),
        panel.run.failed.connect(lambda why: ended.append(str(why) or "it failed")),
        panel.run.ended_early.connect(lambda *_: ended.append("it ended early")),
    ]
    panel.choice.setFocus()
    QTest.keyClick(panel.choice, Qt.Key.Key_Home)
    for _ in range(list(TASKS).index(name)):
        QTest.keyClick(panel.choice, Qt.Key.Key_Down)
    shots._wait(lambda: panel.name == name and name in panel._pages, "the form")
    panel._pages[name].form.set_values(made.get(name, {}))
    let_work(300)
    QTest.mouseClick(panel.run_bar.start_button, Qt.MouseButton.LeftButton)
    if not panel.run.is_running and not ended:
        let_work(300)
    shots._wait(lambda: not panel.run.is_running, f"{name} to end")
    for connection in told:
        panel.disconnect(connection)
    words = panel.found.words.toPlainText() or panel._note.text()
    return ended == [""], words if ended != [""] or words else "no words"


if __name__ == "__main__":
    sys.exit(main())
