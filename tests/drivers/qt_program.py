"""A Qt program with a running event loop that uses an SLM from a thread; prints what it found as JSON.

Started by ``test_second_display`` with the names of some of the functions below.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable

import numpy as np
from PySide6.QtCore import QCoreApplication, QEvent, Qt, QTimer
from PySide6.QtGui import QCloseEvent, QGuiApplication, QImage, QKeyEvent, QWindow

from drivers.errors import DeviceError
from drivers.second_display.in_process import WindowHere
from drivers.second_display.outputs import SecondDisplayOptions
from drivers.second_display.slm import SecondDisplaySlm

OPTIONS = SecondDisplayOptions(
    output=os.environ.get("SLM_OUTPUT", "SLM-1"),
    pixel_pitch_um=8.0,
    settle_ms=0,
    refreshes_to_wait=0,
    check_by_screenshot=True,
)


def ramp(shape: tuple[int, int]) -> np.ndarray:
    return (np.arange(np.prod(shape)) % 256).astype(np.uint8).reshape(shape)


def on_gui(call: Callable[[], object]) -> object:
    """Make a call in the GUI thread, from another."""
    done, result = threading.Event(), []

    def run() -> None:
        result.append(call())
        done.set()

    QTimer.singleShot(0, QCoreApplication.instance(), run)
    assert done.wait(10)
    return result[0]


def grab() -> np.ndarray:
    """The SLM's screen as it is, red, green and blue."""
    window = next(w for w in QGuiApplication.topLevelWindows() if w.isVisible())
    shot = window.screen().grabWindow(window.winId()).toImage()
    return pixels(shot)


def pixels(shot: QImage) -> np.ndarray:
    """Red, green and blue."""
    shot = shot.convertToFormat(QImage.Format.Format_RGBX8888)
    rows = np.frombuffer(shot.constBits(), np.uint8).reshape(shot.height(), shot.bytesPerLine())
    return rows[:, : 4 * shot.width()].reshape(shot.height(), shot.width(), 4)[..., :3].copy()


def exact() -> dict[str, object]:
    """Every grey level of a pattern, by screenshot."""
    with SecondDisplaySlm(OPTIONS) as slm:
        here = isinstance(slm._window, WindowHere)
        slm.display(ramp(slm.shape))
        return {"here": here, "same": same(on_gui(grab), slm)}


def scaled() -> dict[str, object]:
    """The same on a scaled desktop, as drawn: Qt's offscreen platform takes no screenshots of one."""
    with SecondDisplaySlm(OPTIONS.model_copy(update={"check_by_screenshot": False})) as slm:
        slm.display(ramp(slm.shape))
        window = slm._window._screen._window
        ratio = window.devicePixelRatio()
        return {"ratio": ratio, "shape": slm.shape, "same": same(on_gui(lambda: drawn(window)), slm)}


def drawn(window: QWindow) -> np.ndarray:
    """What was given to the display server."""
    return pixels(window._store.paintDevice())


def same(shown: np.ndarray, slm: SecondDisplaySlm) -> bool:
    return shown.shape[:2] == slm.shape and bool((shown == ramp(slm.shape)[..., None]).all())


def clicks_and_keys() -> dict[str, object]:
    """What a user could do to the window, and the pattern after it."""
    with SecondDisplaySlm(OPTIONS) as slm:
        slm.display(ramp(slm.shape))
        before = on_gui(grab)

        def disturb() -> bool:
            window = slm._window._screen._window
            for key in (Qt.Key.Key_Escape, Qt.Key.Key_F4, Qt.Key.Key_Q):
                modifier = Qt.KeyboardModifier.AltModifier
                QCoreApplication.sendEvent(window, QKeyEvent(QEvent.Type.KeyPress, key, modifier))
            QCoreApplication.sendEvent(window, QCloseEvent())
            window.close()
            return window.isVisible() and window.cursor().shape() == Qt.CursorShape.BlankCursor

        visible = on_gui(disturb)
        after = on_gui(grab)
        slm.display(ramp(slm.shape)[::-1].copy())
        again = on_gui(grab)
        return {
            "visible": visible,
            "same": bool((before == after).all()),
            "goes_on": bool((again == ramp(slm.shape)[::-1, :, None]).all()),
        }


def drawn_wrongly() -> dict[str, object]:
    """A display server that shows something else than it was given."""
    with SecondDisplaySlm(OPTIONS) as slm:
        window = slm._window._screen._window
        paint = window.paint

        def wrong() -> None:
            right = window.image
            window.image = right.copy()
            window.image.setPixel(3, 2, 77)
            paint()
            window.image = right

        window.paint = wrong
        try:
            slm.blank()
        except DeviceError as error:
            return {"said": str(error)}
    return {"said": ""}


def from_the_gui_thread() -> dict[str, object]:
    """Called where a button's handler is."""

    def show() -> bool:
        with SecondDisplaySlm(OPTIONS) as slm:
            slm.display(ramp(slm.shape))
            return bool((grab() == ramp(slm.shape)[..., None]).all())

    return {"same": on_gui(show)}


def unplugged() -> dict[str, object]:
    """The output goes, as Qt tells it, and comes back."""
    slm = SecondDisplaySlm(OPTIONS)
    slm.open()
    app = QGuiApplication.instance()
    screen = QGuiApplication.screens()[1]
    on_gui(lambda: app.screenRemoved.emit(screen))
    was_open = slm.is_open
    try:
        slm.display(np.zeros((200, 320), np.uint8))
        said = ""
    except DeviceError as error:
        said = str(error)
    slm.open()
    blank = not slm.displayed.any() and slm.is_open
    slm.close()
    return {"was_open": was_open, "said": said, "reopened_blank": blank}


def blocked() -> dict[str, object]:
    """The GUI thread computes for longer than it may."""
    from drivers.second_display import in_process

    in_process._ANSWER_S = 0.2
    release = threading.Event()
    with SecondDisplaySlm(OPTIONS) as slm:
        QTimer.singleShot(0, QCoreApplication.instance(), lambda: release.wait(20))
        try:
            slm.display(ramp(slm.shape))
            said = ""
        except DeviceError as error:
            said = str(error)
        release.set()
        in_process._ANSWER_S = 10.0
        old = bool((on_gui(grab) == 0).all())  # what was given up is not drawn later
    return {"said": said, "old": old}


def closed_while_blocked() -> dict[str, object]:
    """The SLM is closed while the GUI thread computes: its window goes as soon as that thread has time."""
    from drivers.second_display import in_process

    in_process._ANSWER_S = 0.2
    release = threading.Event()
    slm = SecondDisplaySlm(OPTIONS)
    slm.open()
    QTimer.singleShot(0, QCoreApplication.instance(), lambda: release.wait(20))
    try:
        slm.close()
        said = ""
    except DeviceError as error:
        said = str(error)
    release.set()
    in_process._ANSWER_S = 10.0
    left = on_gui(lambda: sum(window.isVisible() for window in QGuiApplication.topLevelWindows()))
    return {"said": said, "left": left}


def main() -> int:
    app = QGuiApplication(sys.argv[:1])
    app.setQuitOnLastWindowClosed(False)
    failure: list[BaseException] = []

    def work() -> None:
        try:
            print(json.dumps({test: globals()[test]() for test in sys.argv[1:]}))
        except BaseException as error:  # noqa: BLE001 - raised again in the main thread
            failure.append(error)
        finally:
            QTimer.singleShot(0, app, app.quit)

    QTimer.singleShot(0, threading.Thread(target=work).start)
    app.exec()
    if failure:
        raise failure[0]
    return 0


if __name__ == "__main__":
    sys.exit(main())
