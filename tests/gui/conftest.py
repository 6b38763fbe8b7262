"""The desktop program without a screen, on a small simulated bench."""

from __future__ import annotations

import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

try:
    from PySide6.QtCore import QSettings
    from PySide6.QtWidgets import QApplication
    from pytestqt.qtbot import QtBot
except ImportError as error:
    WITHOUT_QT = f"the desktop program: {error}"
else:
    WITHOUT_QT = ""
    from gui.main_window import MainWindow
    from gui.panel import whole
    from gui.panels.reconstructions import ReconstructionsPanel
    from gui.session import BenchSession
    from gui.theme import apply_theme
from instrument.bench.config_file import parse_config

WAIT_MS = 60_000
"""Against a hang, not a slow machine: for what takes a fraction of a second where nothing else runs."""

BENCH = """
[bench]
name = "test bench"
data_folder = "runs"
[camera]
driver = "simulated"
exposure_ms = 10.0
frames_per_s = 60.0
replay_frames = 2
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
leds = 89
[slm]
driver = "simulated"
shape = [60, 80]
settle_ms = 0.0
[scene]
control = "simulated"
[simulated]
preset = "tiny"
scene_rgb = [30.0, 30.0, 30.0]
"""


class _SkippedModule(pytest.Module):
    """In place of a module that cannot be imported here."""

    def collect(self) -> list[pytest.Item]:
        pytest.skip(f"cannot be tested here: {WITHOUT_QT}", allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module | None:
    """Say of each module why it is not run where Qt is not."""
    return _SkippedModule.from_parent(parent, path=module_path) if WITHOUT_QT else None


@pytest.fixture(scope="session")
def qapp() -> QApplication:
    """The application in the program's own looks."""
    app = QApplication.instance() or QApplication(["diffuserbench"])
    assert isinstance(app, QApplication)
    apply_theme(app, "dark")
    return app


@pytest.fixture
def bench_text() -> str:
    """The bench.toml of the test; a module may override this."""
    return BENCH


@pytest.fixture
def make_session(qtbot: QtBot, tmp_path: Path, bench_text: str) -> Iterator[Callable[[], BenchSession]]:
    """Make sessions (not yet opened) that are closed after the test."""
    made: list[BenchSession] = []

    def make() -> BenchSession:
        session = BenchSession(parse_config(bench_text, tmp_path / "bench.toml"))
        made.append(session)
        return session

    yield make
    for session in made:
        if not session.is_closed:
            with qtbot.waitSignal(session.closed, timeout=WAIT_MS):
                session.close()
        assert session.join(WAIT_MS / 1000), f"still running: {_threads()}"


def _threads() -> str:
    """Return the threads that run, each with what it is doing."""
    doing = sys._current_frames()
    return "\n".join(
        f"{thread.name}\n{''.join(traceback.format_stack(doing[thread.ident]))}"
        for thread in threading.enumerate()
        if thread.ident in doing and thread is not threading.main_thread()
    )


@pytest.fixture
def session(qtbot: QtBot, make_session: Callable[[], BenchSession]) -> BenchSession:
    """A session whose devices are open and whose live view runs."""
    session = make_session()
    with qtbot.waitSignal(session.opened, timeout=WAIT_MS):
        session.open()
    qtbot.waitUntil(lambda: session.live.newest() is not None, timeout=WAIT_MS)
    return session


@pytest.fixture
def panel(qtbot: QtBot, make_session: Callable[[], BenchSession]) -> ReconstructionsPanel:
    """The panel of reconstructions of a session whose devices stay closed: none is needed."""
    panel = whole(ReconstructionsPanel(make_session()))
    panel.resize(1000, 700)
    qtbot.addWidget(panel, before_close_func=lambda p: p.shutdown())
    panel.show()
    return panel


@pytest.fixture
def settings(tmp_path: Path) -> QSettings:
    """A place of the test's own for the window's layout."""
    return QSettings(str(tmp_path / "window.ini"), QSettings.Format.IniFormat)


@pytest.fixture
def window(qtbot: QtBot, session: BenchSession, settings: QSettings) -> Iterator[MainWindow]:
    """The main window on an open session."""
    window = MainWindow(session, settings)
    window.show()
    with qtbot.waitExposed(window):
        pass
    yield window
    for panel in window._panels.values():
        panel.shutdown()
    if not session.is_closed:
        with qtbot.waitSignal(session.closed, timeout=WAIT_MS):
            session.close()
    window._may_close = True
    window.close()
    window.deleteLater()
