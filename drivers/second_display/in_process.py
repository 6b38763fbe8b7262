"""The window in this process, where a Qt program runs: its GUI thread does the drawing."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Qt, QThread, Signal
from PySide6.QtGui import QGuiApplication

from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.second_display.outputs import Output, SecondDisplayOptions
from drivers.second_display.window import PatternScreen, outputs

_T = TypeVar("_T")
_ANSWER_S = 10.0


class _Messenger(QObject):
    """Brings calls to the GUI thread, and what came of them back."""

    sent = Signal(object, object)

    def __init__(self) -> None:
        super().__init__()
        self.sent.connect(self._run, Qt.ConnectionType.QueuedConnection)

    def _run(self, call: Callable[[], object], outcome: Future[object]) -> None:
        if not outcome.set_running_or_notify_cancel():
            return
        try:
            outcome.set_result(call())
        except BaseException as error:  # noqa: BLE001 - raised again in the thread that asked
            outcome.set_exception(error)


class WindowHere:
    """Draws in the GUI thread of the running Qt program; callable from any thread, that one included.

    Parameters
    ----------
    device : str
        The device as error messages name it.
    on_lost : callable
        Called, in the GUI thread, when the output is lost.
    """

    def __init__(self, device: str, on_lost: Callable[[DeviceError], None]) -> None:
        app = QGuiApplication.instance()
        assert app is not None
        self._device = device
        self._thread = app.thread()
        self._messenger = _Messenger()
        self._messenger.moveToThread(self._thread)
        self._screen = PatternScreen(device, on_lost)

    def outputs(self) -> tuple[Output, ...]:
        """Return all outputs of the desktop."""
        return self._there(outputs)

    def open(self, options: SecondDisplayOptions) -> tuple[Output, str]:
        """Cover an output; see ``PatternScreen.open``."""
        return self._there(lambda: self._screen.open(options))

    def show(self, levels: npt.NDArray[np.uint8]) -> None:
        """Draw a pattern; see ``PatternScreen.show``."""
        data = levels.tobytes()
        self._there(lambda: self._screen.show(data))

    def close(self) -> None:
        """Uncover the output; a GUI thread that is busy does so later. Closing twice does nothing."""
        if QGuiApplication.instance() is not None:  # else the windows went with the program
            self._there(self._screen.close, gives_up=False)

    def _there(self, call: Callable[[], _T], *, gives_up: bool = True) -> _T:
        if QThread.currentThread() is self._thread:
            return call()
        outcome: Future[_T] = Future()
        self._messenger.sent.emit(call, outcome)
        if not wait([outcome], _ANSWER_S).done and (not gives_up or outcome.cancel()):
            # A call that was not made yet never is; one that is being made is waited for below.
            raise DeviceTimeoutError(
                self._device,
                f"the program's GUI thread did not draw within {_ANSWER_S:g} s.",
                "Is its event loop running, and not blocked by a long computation?",
            )
        return outcome.result()
