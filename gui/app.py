"""Starting and ending the desktop program."""

from __future__ import annotations

import signal
import sys
import traceback
from types import FrameType, TracebackType

from PySide6.QtCore import QCoreApplication, QSettings, QTimer
from PySide6.QtWidgets import QApplication

from gui.main_window import MainWindow, theme_of
from gui.session import BenchSession
from gui.theme import apply_theme
from instrument.config import BenchConfig

_SIGNAL_CHECK_MS = 200
"""Python sees signals only while it runs: an idle event loop has to be woken for them."""


def run(config: BenchConfig) -> int:
    """Show the window for a bench until it is closed; returns the exit status."""
    app = application()
    settings = QSettings("diffuserbench", "diffuserbench")
    apply_theme(app, theme_of(settings))
    session = BenchSession(config)
    window = MainWindow(session, settings)
    sys.excepthook = _ToLog(session)
    waker = QTimer()
    waker.timeout.connect(lambda: None)
    waker.start(_SIGNAL_CHECK_MS)

    def end(number: int, _frame: FrameType | None) -> None:
        session.log("warning", f"Signal {signal.Signals(number).name}: closing.")
        session.stop()
        session.close()

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)
    window.show()
    session.open()
    status = app.exec()
    session.join()
    sys.excepthook = sys.__excepthook__
    return status


def application() -> QApplication:
    """Return the application object, made once."""
    existing = QCoreApplication.instance()
    if isinstance(existing, QApplication):
        return existing
    app = QApplication(["diffuserbench"])
    app.setApplicationName("diffuserbench")
    return app


class _ToLog:
    """Brings an error in the window's own code into the log: it never ends unseen."""

    def __init__(self, session: BenchSession) -> None:
        self._session = session

    def __call__(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        text = "".join(traceback.format_exception(kind, error, trace))
        sys.stderr.write(text)
        self._session.log("error", f"An error in the window itself; please report it.\n{text}")
