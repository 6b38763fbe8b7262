"""Starting and ending the desktop program."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import traceback
from functools import partial
from pathlib import Path
from types import FrameType, TracebackType

from PySide6.QtCore import QCoreApplication, QSettings, QSize, QTimer, qInstallMessageHandler
from PySide6.QtWidgets import QApplication

from gui.main_window import MainWindow
from gui.making import PICTURE_MS
from gui.session import BenchSession
from gui.theme import apply_theme, theme_of
from gui.widgets.dialogues import TextWindow
from instrument.bench.config import BenchConfig
from instrument.bench.config_file import no_bench
from instrument.files import kept_times
from instrument.files.errors import BenchError, in_words
from instrument.live.frame_view import compile_for_frames
from recon.base.threads import stand_back
from recon.optics.jit import extensions_put_off

_FRAME = QSize(16, 40)
"""What a window manager puts round a window, at most: the first window fits the screen with it."""
HANDOVER_S = 0.001
"""After which a thread of Python hands over to another that waits (0296)."""
_log = logging.getLogger(__name__)
_SIGNAL_CHECK_MS = 200
"""Python sees signals only while it runs: an idle event loop has to be woken for them."""


def run(config: BenchConfig | None) -> int:
    """Show the window for a bench, and for those that are opened from it, until it is closed.

    Returns the exit status. None: no bench; the start page leads to one.
    """
    require_screen()
    kept_times.in_a_window()
    app = application()
    settings = QSettings("diffuserbench", "diffuserbench")
    status = 0
    wanted: BenchConfig | None = no_bench(working_folder()) if config is None else config
    while wanted is not None:
        status, wanted = _shown(app, wanted, settings)
    return status


def working_folder() -> Path:
    """Return where work begins: this folder, else one in the home folder where nobody should write here."""
    here = Path.cwd()
    return here if os.access(here, os.W_OK) and here != Path(here.anchor) else Path.home() / "diffuserbench"


def _shown(app: QApplication, config: BenchConfig, settings: QSettings) -> tuple[int, BenchConfig | None]:
    """Show the window for a bench until it is closed; returns the exit status, and which bench is next."""
    status = 0
    go_first()
    apply_theme(app, theme_of(settings))  # which the window before may have changed
    session = BenchSession(config)
    sys.excepthook = _ToLog(session)
    qInstallMessageHandler(lambda _kind, _where, text: _log.debug("Qt: %s", text))
    waker = QTimer()
    waker.timeout.connect(lambda: None)
    waker.start(_SIGNAL_CHECK_MS)

    def end(number: int, _frame: FrameType | None) -> None:
        # Not here: Python calls this between any two of its steps, also in the midst of a job's start.
        QTimer.singleShot(0, session, partial(session.end_by, signal.Signals(number).name))

    # Before the window is made: Python's own KeyboardInterrupt would get lost in one of Qt's callbacks.
    before = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        # A signal that the parent chose to ignore (nohup) stays ignored.
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, end)
    try:
        window = MainWindow(session, settings, app.primaryScreen().availableSize() - _FRAME)
        show_and_open(window)
        if not session.is_closed:  # by a signal while the window was made: a loop begun after that never ends
            status = app.exec()
        session.join()
    finally:
        gc.unfreeze()  # of this window
        qInstallMessageHandler(None)
        sys.excepthook = sys.__excepthook__
        for number, handler in before.items():
            signal.signal(number, handler)
    window.deleteLater()
    return status, window.next_bench


def go_first() -> None:
    """Have the window's thread, the main one, answer before those that compute, for good."""
    sys.setswitchinterval(HANDOVER_S)
    stand_back()


def show_and_open(window: MainWindow) -> None:
    """Show a window, and open its bench when it was seen: what takes long is done before there is light."""
    load = extensions_put_off()  # before panels are prepared, which begins with the first events
    application().processEvents()  # to be made and to be shown are turns of their own
    window.show()
    application().processEvents()

    def settle() -> None:
        # What stays is not looked through for garbage again and again, 0.1 s during which nothing answers.
        gc.freeze()
        gc.enable()  # the terminal's command begins without
        if not window.session.is_closing:
            window.session.jobs.watch("Loading extensions", lambda _: load())

    def compile_now() -> None:  # not before: what computes a simulated scene would wait for it
        if not window.session.is_closing:
            window.session.jobs.watch("Compiling what shows frames", lambda _: compile_for_frames())

    if "camera" in window.session.kinds:
        window.session.pictured.connect(compile_now)
    else:
        QTimer.singleShot(PICTURE_MS, window, compile_now)
    window.session.pictured.connect(settle)
    QTimer.singleShot(PICTURE_MS, window, settle)  # where no picture comes
    window.session.opened.connect(gc.freeze)
    window.maker.made.connect(gc.freeze)
    if not window.session.is_closing:
        window.session.open()


def show_mistake(error: BenchError) -> None:
    """Show why the program does not start in a window of its own, until that is closed.

    Does nothing where nobody would see it: without a screen.
    """
    if not _has_viewer():
        return
    app = application()
    apply_theme(app, theme_of(QSettings("diffuserbench", "diffuserbench")))
    window = TextWindow("diffuserbench cannot start", in_words(error) or str(error))
    window.show()
    app.exec()


def _has_viewer() -> bool:
    try:
        require_screen()
    except BenchError:
        return False
    return application().platformName() not in ("offscreen", "minimal")


def require_screen() -> None:
    """Refuse to start where no screen can be reached: Qt would abort without a word to the user.

    Raises
    ------
    BenchError
    """
    on_linux = sys.platform.startswith("linux")
    if on_linux and not any(os.environ.get(v) for v in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM")):
        raise BenchError(
            "There is no screen to show the window on (neither DISPLAY nor WAYLAND_DISPLAY is set). "
            "Log in to a desktop, or with ssh -X; the command line does everything without one."
        )


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
