"""Every panel of the desktop program, empty, filled and failed, in every theme, on one sheet.

    python benchmarks/gui_contact_sheet.py --out sheet.jpg                  all of it; some minutes
    python benchmarks/gui_contact_sheet.py --out sheet.jpg --size 1350x690 --state empty --panel live
    QT_SCALE_FACTOR=2 python benchmarks/gui_contact_sheet.py --out sheet.jpg --pictures sheet

The last one is 3840 x 2160 at scale 2, every picture kept in its own size, too. Empty: a bench whose folder
holds nothing. Failed: all of its devices unplugged, what is begun or opened refused. Filled: with what
``gui_screenshots.py`` makes and keeps (``--work``). Words cut off, places
scrolled twice or sideways, and parts without a name for screen readers are looked for in each
(``tests/gui/looks.py``) and printed; exit status 1 where there are any. Needs no screen.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.append(str(Path(__file__).parents[1]))

import gui_screenshots as shots
from PySide6.QtCore import QRect, Qt, qInstallMessageHandler
from PySide6.QtGui import QColor, QImage, QPainter

from drivers.simulated.world import SimulatedWorld
from gui.app import application
from gui.main_window import MainWindow
from gui.panels import PANELS
from gui.theme import THEMES, apply_theme
from tests.gui.event_loop import let_work
from tests.gui.looks import faults

STATES = ("empty", "filled", "failed")
HEADING_PX = 22
RESTYLED_MS = 120
DAMAGED = "damaged.tif"


def main() -> int:
    """Make the sheet, and tell of faults."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="the sheet, .jpg or .png")
    parser.add_argument("--work", type=Path, default=Path("runs/screenshots"), help="folder of what is shown")
    parser.add_argument("--size", default="1600x980", help="of the window in pixels, default 1600x980")
    parser.add_argument("--state", action="append", choices=STATES, help="only this one; repeatable")
    parser.add_argument("--theme", action="append", choices=list(THEMES), help="only this one; repeatable")
    parser.add_argument("--panel", action="append", choices=list(PANELS), help="only this one; repeatable")
    parser.add_argument("--pictures", type=Path, help="folder that keeps every picture in its own size")
    parser.add_argument("--tile", type=int, default=400, help="width of a picture on the sheet, pixels")
    given = parser.parse_args()
    width, height = (int(part) for part in given.size.split("x"))
    panels, themes = given.panel or list(PANELS), given.theme or list(THEMES)
    qInstallMessageHandler(shots._quietly)
    apply_theme(application(), themes[0])
    tiles: dict[tuple[str, str, str], QImage] = {}
    found: list[str] = []
    for state in given.state or STATES:
        for name, theme, picture, wrong in _pictures(state, panels, themes, (width, height), given.work):
            if given.pictures is not None:
                given.pictures.mkdir(parents=True, exist_ok=True)
                picture.save(str(given.pictures / f"{state}-{name}-{theme}.png"))
            tiles[name, state, theme] = picture.scaledToWidth(
                given.tile, Qt.TransformationMode.SmoothTransformation
            )
            told = [f"{state}, {name}, {theme}: {fault}" for fault in wrong]
            told = [fault for fault in dict.fromkeys(told) if fault not in found]
            print("".join(f"{fault}\n" for fault in told), end="", flush=True)
            found += told
    _sheet(tiles).save(str(given.out), quality=85)
    print(given.out)
    print(f"{len(found)} faults in {len(tiles)} pictures")
    return 1 if found else 0


def _pictures(
    state: str, panels: list[str], themes: list[str], size: tuple[int, int], work: Path
) -> Iterator[tuple[str, str, QImage, list[str]]]:
    """Yield every panel in every theme: name, theme, picture, faults."""
    benches = {"camera": [name for name in panels if state != "filled" or name not in shots.DISPLAY]}
    benches["display"] = [name for name in panels if name not in benches["camera"]]
    for bench, names in benches.items():
        if not names:
            continue
        own = Path(tempfile.mkdtemp())
        folder = (work.resolve() if state == "filled" else own) / bench
        _prepare(folder, state)
        apply_theme(application(), themes[0])  # the state before ended with the last
        window = shots._open(folder, *size)
        if state == "failed":
            _unplug(window)
        for name in names:
            try:
                _come_to(window, name, state, own)
            except SystemExit as in_vain:  # the others are looked at all the same
                yield name, themes[0], window.grab().toImage(), [str(in_vain)]
                continue
            for theme in themes:
                window.set_theme(theme)
                shots._wait(lambda window=window: not window.is_restyling, "the theme")
                let_work(RESTYLED_MS)
                picture = window.grab().toImage()
                picture.setDevicePixelRatio(1.0)  # in the screen's own pixels
                yield name, theme, picture, faults(window)
        shots._close(window)
        shutil.rmtree(own, ignore_errors=True)


def _prepare(folder: Path, state: str) -> None:
    """Make a bench, and what its panels are filled with."""
    folder.mkdir(parents=True, exist_ok=True)
    if state != "filled":
        (folder / "bench.toml").write_text(shots.CAMERA)
        (folder / DAMAGED).write_text("neither a picture nor a film")
    elif folder.name == "display":
        shots._prepare_display(folder)
    else:
        shots._prepare_camera(folder)


def _unplug(window: MainWindow) -> None:
    """Take every device away, and wait until that is noticed."""
    world = window.session.bench.shared["simulated"]
    assert isinstance(world, SimulatedWorld)
    for kind in window.session.kinds:
        world.unplug(kind)
        window.session.reconnect(kind)
    shots._wait(
        lambda: all(window.session.state(k).condition == "failed" for k in window.session.kinds),
        "the devices to fail",
    )


def _come_to(window: MainWindow, name: str, state: str, out: Path) -> None:
    """Bring a panel to the front in a state."""
    if state == "filled" and name == "alignment":
        shots._align(window)
    elif state == "filled" and name == "holograms":
        shots._hologram(window)
    elif state == "filled":
        shots._show(window, name, out)
        return
    panel: Any = window.show_panel(name)
    if state == "failed":
        damaged = window.session.runs_folder.parent / DAMAGED
        if name in ("films", "charts", "reconstructions"):
            panel.open(damaged)
        elif name == "tasks":
            panel.take(("export", {"run": damaged}))
            shots._wait(lambda: panel.run_bar.start_button.isEnabled(), "the form")
            panel.options_form.set_values({"out": damaged.with_suffix(".npy")})
            panel.start()
            shots._wait(lambda: not panel.run.is_running, "the refusal")
    let_work(shots.SETTLE_MS)


def _sheet(tiles: dict[tuple[str, str, str], QImage]) -> QImage:
    """Put the pictures in rows of a panel and columns of state and theme."""
    rows = list(dict.fromkeys(name for name, _, _ in tiles))
    columns = list(dict.fromkeys((state, theme) for _, state, theme in tiles))
    first = next(iter(tiles.values()))
    across, down = first.width(), first.height() + HEADING_PX
    sheet = QImage(across * len(columns), down * len(rows), QImage.Format.Format_RGB888)
    sheet.fill(QColor("#808080"))
    painter = QPainter(sheet)
    for (name, state, theme), picture in tiles.items():
        x, y = columns.index((state, theme)) * across, rows.index(name) * down
        place = QRect(x + 4, y, across - 8, HEADING_PX)
        painter.drawText(place, Qt.AlignmentFlag.AlignVCenter, f"{PANELS[name].title}, {state}, {theme}")
        painter.drawImage(x, y + HEADING_PX, picture)
    painter.end()
    return sheet


if __name__ == "__main__":
    sys.exit(main())
