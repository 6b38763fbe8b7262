"""The window in this process, where a Qt program runs: its GUI thread does the drawing."""

from __future__ import annotations

import threading
from collections.abc import Callable
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


class _Errand:
    """A call to be made in the GUI thread, and what came of it."""

    def __init__(self, call: Callable[[], object]) -> None:
        self._call = call
        self._given_up = False
        self._lock = threading.Lock()
        self.done = threading.Event()
        self.result: object = None
        self.error: BaseException | None = None

    def run(self) -> None:
        with self._lock:
            if self._given_up:
                return
            try:
                self.result = self._call()
            except BaseException as error:  # noqa: BLE001 - raised again in the thread that asked
                self.error = error
        self.done.set()

    def give_up(self) -> None:
        """See to it that a call that was not made yet never is; waits for one that is being made."""
        with self._lock:
            self._given_up = True


class _Messenger(QObject):
    """Brings errands to the GUI thread."""

    sent = Signal(object)

    def __init__(self) -> None:
        super().__init__()
        self.sent.connect(self._run, Qt.ConnectionType.QueuedConnection)

    def _run(self, errand: _Errand) -> None:
        errand.run()


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
        errand = _Errand(call)
        self._messenger.sent.emit(errand)
        if not errand.done.wait(_ANSWER_S):
            if gives_up:
                errand.give_up()
            if not errand.done.is_set():
                raise DeviceTimeoutError(
                    self._device,
                    f"the program's GUI thread did not draw within {_ANSWER_S:g} s.",
                    "Is its event loop running, and not blocked by a long computation?",
                )
        if errand.error is not None:
            raise errand.error
        return errand.result  # type: ignore[return-value]
