"""Stalls of the window's thread and the time to STOP, panel by panel, in a fresh process.

Every turn of the event loop is timed by the processor time of the window's own thread, so that other programs
and the program's own jobs do not count. STOP is pressed again and again from a timer of another thread; what
is told of it is when its light and motion commands were given.

    python benchmarks/gui_stalls.py [BENCH.toml] [--turns-over 50]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

from PySide6.QtCore import QAbstractEventDispatcher, QEventLoop, QSettings, QTimer

from gui.app import application
from gui.main_window import MainWindow, theme_of
from gui.panels import PANELS
from gui.session import BenchSession
from gui.theme import apply_theme
from instrument.bench.config_file import load_config


class Turns:
    """The longest turns of the event loop of the thread that makes it, as processor time."""

    def __init__(self) -> None:
        dispatcher = QAbstractEventDispatcher.instance()
        assert dispatcher is not None
        self._began_s = time.thread_time()
        self.ms: list[float] = []
        dispatcher.awake.connect(
            self._turned
        )  # blocking costs no processor time: any two of them make a turn
        dispatcher.aboutToBlock.connect(self._turned)

    def _turned(self) -> None:
        now_s = time.thread_time()
        self.ms.append((now_s - self._began_s) * 1e3)
        self._began_s = now_s

    def fetch(self) -> list[float]:
        """Return the turns since the last call, longest first."""
        turns, self.ms = sorted(self.ms, reverse=True), []
        return turns


def wait(seconds: float) -> None:
    """Let the event loop run for so long."""
    loop = QEventLoop()
    QTimer.singleShot(round(seconds * 1e3), loop.quit)
    loop.exec()


def main() -> int:
    """Open every panel and tell of the turns; 1 where one took too long."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bench", nargs="?", type=Path, help="its bench.toml; default: the one that is found")
    parser.add_argument("--over", type=float, default=50.0, help="milliseconds of processor time")
    arguments = parser.parse_args()
    application().setQuitOnLastWindowClosed(False)
    began_s = time.thread_time()
    apply_theme(application(), theme_of(QSettings(tempfile.mkstemp()[1], QSettings.Format.IniFormat)))
    session = BenchSession(load_config(arguments.bench))
    window = MainWindow(session, QSettings(tempfile.mkstemp()[1], QSettings.Format.IniFormat))
    window.show()
    made_ms = (time.thread_time() - began_s) * 1e3
    turns, worst = Turns(), []
    print(f"{'before the window answers':32s} {made_ms:7.0f} ms")

    def tell(what: str) -> None:
        longest = turns.fetch()
        over = [ms for ms in longest if ms > arguments.over]
        worst.extend(over)
        print(
            f"{what:32s} {longest[0]:7.0f} ms   {len(over)} over {arguments.over:g} ms: "
            + " ".join(f"{ms:.0f}" for ms in over[:12]),
            flush=True,
        )

    session.open()
    wait(8)
    tell("start")
    for name in PANELS:
        window.bring(name)
        wait(1.5)
        tell(name)
    closed = QEventLoop()
    session.closed.connect(closed.quit)
    window.close()
    closed.exec()
    tell("end")
    session.join()
    print(f"{len(worst)} turns over {arguments.over:g} ms, longest {max(worst, default=0):.0f} ms")
    return bool(worst)


if __name__ == "__main__":
    sys.exit(main())
