"""How soon the window shows a simulated scene: seconds of the processor since the program's start.

Each preset starts twice in processes of their own: with nothing kept of its light on disk, and with what the
first start left there. Compiled kernels are there both times.

    python benchmarks/gui_first_frame.py
    python benchmarks/gui_first_frame.py --presets pco
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PRESETS = ("tiny", "pointgrey", "pco")
LIMIT_S = 300.0
LIT = 1e-3
"""Of full scale, in the mean of all pixels: a frame of the scene."""


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    parser.add_argument("--one", metavar="PRESET", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        watch(arguments.one)
        return
    print("| preset | kept | window | coarsely | first frame | scene's frame |\n|---|---|---|---|---|---|")
    for preset in arguments.presets:
        with tempfile.TemporaryDirectory() as folder:
            start(preset, folder)  # compiles
            for path in (Path(folder) / "diffuserbench" / "light").glob("*"):
                path.unlink()
            for kept in ("nothing", "its light"):
                print(f"| {preset} | {kept} | {start(preset, folder)} |", flush=True)


def start(preset: str, folder: str) -> str:
    """Start the program in a process of its own; return its figures."""
    environment = os.environ | {
        "QT_QPA_PLATFORM": "offscreen",
        "XDG_CACHE_HOME": folder,
        "XDG_CONFIG_HOME": folder,
        "MPLCONFIGDIR": folder,
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, __file__, "--one", preset]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=True
    )
    return done.stdout.splitlines()[-1]


def watch(preset: str) -> None:
    """Open a bench in the window and print when what was seen first, " | " between."""
    from PySide6.QtCore import QSettings
    from PySide6.QtTest import QTest

    from gui.app import application, show_and_open
    from gui.main_window import MainWindow
    from gui.panels.live import LivePanel
    from gui.session import BenchSession
    from gui.theme import apply_theme
    from instrument.bench.config_file import parse_config

    devices = "".join(f'[{kind}]\ndriver = "simulated"\n' for kind in ("camera", "stage", "led_array"))
    text = f'[bench]\nname = "first frame"\n{devices}[scene]\ncontrol = "simulated"\n'
    config = parse_config(f'{text}[simulated]\npreset = "{preset}"\n', Path("bench.toml"))
    app = application()
    apply_theme(app, "dark")
    window = MainWindow(BenchSession(config), QSettings("x.ini", QSettings.Format.IniFormat))
    show_and_open(window)
    seen = {"window": time.process_time()}
    deadline = time.monotonic() + LIMIT_S
    while "scene" not in seen and time.monotonic() < deadline:
        QTest.qWait(5)
        live = window.panel("live")
        if not isinstance(live, LivePanel):
            continue
        picture = live.picture
        if picture.is_coarse:
            seen.setdefault("coarse", time.process_time())
        elif picture.frame is not None:
            seen.setdefault("frame", time.process_time())
            above = float(picture.frame.image.mean()) - picture.frame.metadata.black_level
            if above > LIT * picture.frame.full_scale:
                seen.setdefault("scene", time.process_time())
    print(
        " | ".join(
            f"{seen[key]:.1f}" if key in seen else "" for key in ("window", "coarse", "frame", "scene")
        )
    )
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
