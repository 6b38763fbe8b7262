"""Keeps the desktop's screen saver and the display server's power saving off, for as long as it lives."""

from __future__ import annotations

import logging
import os
from itertools import count
from pathlib import Path

from PySide6.QtDBus import QDBusConnection, QDBusMessage
from PySide6.QtGui import QGuiApplication

from drivers.second_display.x11 import XConnection

_log = logging.getLogger(__name__)
_SERVICE = "org.freedesktop.ScreenSaver"
_PATH = "/org/freedesktop/ScreenSaver"
_ANSWER_MS = 1000
_numbers = count()


class ScreenSaverInhibition:
    """Asks the desktop (D-Bus) and the X server (XScreenSaverSuspend), each over a connection of its own.

    Both let the screen saver come again when the connection ends, however this process ends.
    """

    def __init__(self) -> None:
        self._bus = _ask_desktop()
        self._x11 = XConnection.open() if QGuiApplication.platformName() == "xcb" else None
        if self._x11 is not None and not self._x11.suspend_screen_saver():
            self._x11.close()
            self._x11 = None
        ways = [
            *(["the desktop"] if self._bus is not None else []),
            *(["the X server"] if self._x11 is not None else []),
        ]
        self.by = " and ".join(ways) or "nothing"
        """Who was asked and agreed, in words."""
        if not ways and QGuiApplication.platformName() != "offscreen":
            _log.warning("Nothing here can be asked to keep the screen saver off: switch it off by hand.")

    def end(self) -> None:
        """Let the screen saver come again; ending twice does nothing."""
        if self._bus is not None:
            QDBusConnection.disconnectFromBus(self._bus)
            self._bus = None
        if self._x11 is not None:
            self._x11.close()
            self._x11 = None


def _ask_desktop() -> str | None:
    """Return the name of the connection that inhibits, None where no desktop listens."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    has_bus = "DBUS_SESSION_BUS_ADDRESS" in os.environ or (runtime and Path(runtime, "bus").exists())
    if not has_bus:  # libdbus would else start one
        return None
    name = f"diffuserbench-{next(_numbers)}"
    bus = QDBusConnection.connectToBus(QDBusConnection.BusType.SessionBus, name)
    if bus.isConnected():
        call = QDBusMessage.createMethodCall(_SERVICE, _PATH, _SERVICE, "Inhibit")
        call.setArguments(["diffuserbench", "a pattern is shown on the SLM"])
        reply = bus.call(call, timeout=_ANSWER_MS)
        if reply.type() == QDBusMessage.MessageType.ReplyMessage:
            return name
    QDBusConnection.disconnectFromBus(name)
    return None
