"""Stalls of the window's thread and the time to STOP, in a fresh process: panels, themes, work beside them.

Every turn of the event loop is timed by the processor time of the window's own thread, so that other programs
and the program's own jobs do not count; so is each panel's first opening, from the click on its tab to when
it stands (what it imports is a job's), and by the clock. Meanwhile STOP is clicked every 0.3 s from another
thread; its times are by the clock, on however busy a machine: from the click to when the window's thread
takes it, and to when light is off and nothing moves (an SLM that is blanked then takes its settling time).

    python benchmarks/gui_stalls.py [BENCH.toml] [--over 50]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import numpy as np
from PySide6.QtCore import QAbstractEventDispatcher, QEventLoop, QMetaObject, QSettings, Qt, QTimer

from gui.app import application, go_first, show_and_open
from gui.jobs import JobContext
from gui.main_window import MainWindow
from gui.panels import PANELS
from gui.session import BenchSession
from gui.theme import apply_theme
from instrument.bench.config_file import load_config
from instrument.files.images import write_image
from recon import reconstruct

_STOP_EVERY_S = 0.3
_PATIENCE_S = 60.0
"""By the clock, for a panel to stand; then it is told what its opening waits for."""


class Turns:
    """The turns of the event loop of the thread that makes it, as processor time."""

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

    def forget(self) -> None:
        """Begin anew: neither the turns so far nor what was done since the last one count."""
        self._turned()
        self.ms = []


class Stopper:
    """Clicks STOP again and again from a thread of its own, and times how long it is until dark and still."""

    def __init__(self, window: MainWindow) -> None:
        self._window = window
        self._clicked_s: float | None = None
        self._noted_s: float | None = None
        self.heard_ms: list[float] = []
        self.ms: list[float] = []
        self._ending = threading.Event()
        window.session.stop_pressed.connect(self._heard)
        bench = window.session.bench
        self._halt = bench.stop
        bench.stop = self._stopped  # type: ignore[method-assign]
        if bench.stage is not None:  # light is off by then: safety's order
            self._still = bench.stage.stop
            bench.stage.stop = self._stage_stopped  # type: ignore[method-assign]
        threading.Thread(target=self._click, daemon=True).start()

    def _click(self) -> None:
        while not self._ending.wait(_STOP_EVERY_S):
            if self._clicked_s is None:
                self._clicked_s = time.monotonic()
                QMetaObject.invokeMethod(
                    self._window.stop_button, "click", Qt.ConnectionType.QueuedConnection
                )

    def _heard(self) -> None:
        if self._clicked_s is not None:
            self.heard_ms.append((time.monotonic() - self._clicked_s) * 1e3)

    def _stage_stopped(self) -> None:
        self._still()
        self._note()

    def _stopped(self) -> None:
        self._halt()
        self._note()
        self._clicked_s = None

    def _note(self) -> None:
        """Note the first time after a click that all was dark and still."""
        if self._clicked_s is not None and self._noted_s != self._clicked_s:
            self._noted_s = self._clicked_s
            self.ms.append((time.monotonic() - self._clicked_s) * 1e3)

    def end(self) -> None:
        """Click no more."""
        self._ending.set()


def wait(seconds: float, until: Callable[[], bool] = lambda: False) -> None:
    """Let the event loop run for so long, or until something is so."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and not until():
        loop = QEventLoop()
        QTimer.singleShot(100, loop.quit)
        loop.exec()


def opened(window: MainWindow, name: str, patience_s: float = _PATIENCE_S) -> tuple[float, float]:
    """Bring a panel to the front; returns how long it took, seconds: of the window's thread, by the clock.

    Raises TimeoutError where it does not stand after ``patience_s``: what it waits for, what threads do.
    """
    began_s, began_cpu_s = time.monotonic(), time.thread_time()
    loop = QEventLoop()
    window.maker.made.connect(loop.quit)
    window.bring(name)
    while name not in window.maker.panels and time.monotonic() - began_s < patience_s:
        QTimer.singleShot(100, loop, loop.quit)  # each time: one timer may come a little early, and no other
        loop.exec()
    window.maker.made.disconnect(loop.quit)
    if name not in window.maker.panels:
        jobs = ", ".join(f"{job.title} ({job.state.value})" for job in window.session.jobs.jobs)
        raise TimeoutError(
            f"{PANELS[name].title} does not stand after {patience_s:g} s; it waits for "
            f"{window.maker.waits_for(name)}. Jobs: {jobs or 'none'}.\n{_doing()}"
        )
    return time.thread_time() - began_cpu_s, time.monotonic() - began_s


def _doing() -> str:
    """Return what every thread does, the innermost calls of each."""
    frames = sys._current_frames()
    return "".join(
        f"{thread.name}\n{''.join(traceback.format_stack(frames[thread.ident])[-8:])}"
        for thread in threading.enumerate()
        if thread.ident in frames
    )


def _hung(_: JobContext, end: threading.Event) -> None:
    """Wait as a call does on a disk that does not answer."""
    end.wait()


def _reconstruction(context: JobContext) -> None:
    rng = np.random.default_rng(1)
    psf = rng.random((256, 256), np.float32) ** 8
    while not context.cancel.is_set():
        reconstruct(rng.random((256, 256), np.float32), psf, max_iterations=60, cancel=context.cancel)


def _imports(_: JobContext) -> None:
    """Read and write as importing and file work do: much Python, all of it holding the interpreter."""
    for _n in range(400):
        compile("\n".join(f"x{i} = [{i}, 'a', (1, 2)]" for i in range(400)), "busy", "exec")


def _spread(times: list[float]) -> str:
    ranked = sorted(times) or [float("nan")]
    return " / ".join(f"{ranked[min(int(p * len(ranked)), len(ranked) - 1)]:.0f}" for p in (0.5, 0.95, 1))


def main() -> int:
    """Open every panel and tell of turns and STOP; 1 where one took too long, or does not stand."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bench", nargs="?", type=Path, help="its bench.toml; default: the one that is found")
    parser.add_argument("--over", type=float, default=50.0, help="milliseconds of processor time")
    arguments = parser.parse_args()
    application().setQuitOnLastWindowClosed(False)
    began_s = time.thread_time()
    apply_theme(application(), "dark")
    session = BenchSession(load_config(arguments.bench))
    folder = Path(tempfile.mkdtemp())
    window = MainWindow(session, QSettings(str(folder / "window.ini"), QSettings.Format.IniFormat))
    print(f"{'before the window is there':30s}{(time.thread_time() - began_s) * 1e3:6.0f} ms")
    go_first()
    show_and_open(window)
    print(f"{'the window on the screen':30s}{1e3 * time.process_time():6.0f} ms since the program began")
    turns, worst, longest_ms = Turns(), list[float](), 0.0
    stopper = Stopper(window)

    def tell(what: str) -> None:
        nonlocal longest_ms
        longest, halts, heard = turns.fetch(), sorted(stopper.ms), sorted(stopper.heard_ms)
        stopper.ms, stopper.heard_ms = [], []
        longest_ms = max(longest_ms, longest[0])
        worst.extend(over := [ms for ms in longest if ms > arguments.over])
        words = f"{what:30s}{longest[0]:6.0f} ms the longest turn"
        if halts:
            words += f"; STOP taken {_spread(heard)}, halted {_spread(halts)} ms"
        print(words + (f"   OVER: {' '.join(f'{ms:.0f}' for ms in over)}" if over else ""), flush=True)
        takes.extend(heard)
        stops.extend(halts)

    takes, stops, missing = list[float](), list[float](), list[str]()
    wait(6)
    tell("opening the bench")
    for name in PANELS:
        was_open = name in window.maker.panels
        try:
            cpu_s, clock_s = opened(window, name)
        except TimeoutError as error:
            print(error, flush=True)
            missing.append(name)
            was_open = True
        wait(1)
        tell(f"first opening: {PANELS[name].title}")
        if not was_open:
            print(f"{'':30s}{1e3 * cpu_s:6.0f} ms until it stands, {1e3 * clock_s:.0f} by the clock")
    for theme in ("red", "light", "dark"):
        window.set_theme(theme)
        wait(1)
        tell(f"theme: {theme}")
    write_image(folder / "a.png", np.zeros((64, 64), np.uint8))
    end = threading.Event()
    work: dict[str, Callable[[JobContext], None]] = {
        "a disk that hangs": lambda context: _hung(context, end),
        "a reconstruction": _reconstruction,
        "imports": _imports,
    }
    for what, do in work.items():
        job = session.jobs.compute(what, do)
        wait(4)
        tell(f"beside: {what}")
        job.cancel()
    end.set()
    stopper.end()
    closed = QEventLoop()
    session.closed.connect(closed.quit)
    window._may_close = False
    window.close()
    if window.question is not None:
        window.question.accept()
    session.close()
    if not session.is_closed:
        closed.exec()
    tell("the end")
    session.join()
    print(f"{len(worst)} turns over {arguments.over:g} ms, longest {longest_ms:.0f} ms")
    print(f"STOP taken {_spread(takes)}, halted {_spread(stops)} ms (median, 95 %, most of {len(stops)})")
    if missing:
        print(f"not made: {', '.join(missing)}")
    return bool(worst or missing)


if __name__ == "__main__":
    sys.exit(main())
