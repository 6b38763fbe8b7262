"""What Qt does not tell about an X server, and keeping its screen saver and power saving off."""

from __future__ import annotations

import ctypes
import logging
import os
from ctypes import POINTER, byref, c_char_p, c_int, c_ulong, c_void_p
from itertools import count
from pathlib import Path
from typing import NamedTuple

from PySide6.QtDBus import QDBusConnection, QDBusMessage
from PySide6.QtGui import QGuiApplication

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


class Place(NamedTuple):
    """Where an output is on the X server's screen, and its size, pixels."""

    x: int
    y: int
    width: int
    height: int


class _Monitor(ctypes.Structure):
    _fields_ = (  # XRRMonitorInfo of X11/extensions/Xrandr.h
        ("name", c_ulong),
        ("primary", c_int),
        ("automatic", c_int),
        ("noutput", c_int),
        ("x", c_int),
        ("y", c_int),
        ("width", c_int),
        ("height", c_int),
        ("mwidth", c_int),
        ("mheight", c_int),
        ("outputs", c_void_p),
    )


class XConnection:
    """A connection to the X server that ``DISPLAY`` names; what it asked for ends with it."""

    def __init__(self, xlib: ctypes.CDLL, display: c_void_p) -> None:
        self._xlib = xlib
        self._display: c_void_p | None = display

    @classmethod
    def open(cls) -> XConnection | None:
        """Return a connection, None where there is no X server or no libX11."""
        xlib = _library("libX11.so.6")
        if xlib is None:
            return None
        xlib.XOpenDisplay.restype = c_void_p
        xlib.XOpenDisplay.argtypes = [c_char_p]
        display = xlib.XOpenDisplay(None)
        return cls(xlib, c_void_p(display)) if display else None

    def suspend_screen_saver(self) -> bool:
        """Keep screen saver and DPMS off until this connection ends; whether that could be asked for."""
        extension = _library("libXss.so.1")
        if extension is None:
            return False
        extension.XScreenSaverSuspend(self._display, c_int(1))
        self._xlib.XFlush(self._display)
        return True

    def place(self, output: str) -> Place | None:
        """Return where an output is now; None when it is off, or nothing can tell (no libXrandr).

        Qt 6.11 learns that outputs come and go, but not that one changed its mode or its place.
        """
        randr = _library("libXrandr.so.2")
        if randr is None:
            return None
        root = self._xlib.XDefaultRootWindow
        root.restype = c_ulong
        randr.XRRGetMonitors.restype = POINTER(_Monitor)
        randr.XRRGetMonitors.argtypes = [c_void_p, c_ulong, c_int, POINTER(c_int)]
        self._xlib.XInternAtom.restype = c_ulong
        name = self._xlib.XInternAtom(self._display, output.encode(), c_int(0))
        count = c_int()
        monitors = randr.XRRGetMonitors(self._display, root(self._display), 1, byref(count))
        found = None
        for monitor in monitors[: count.value]:
            if monitor.name == name:
                found = Place(monitor.x, monitor.y, monitor.width, monitor.height)
        randr.XRRFreeMonitors(monitors)
        return found

    def close(self) -> None:
        """End the connection; closing twice does nothing."""
        if self._display is not None:
            self._xlib.XCloseDisplay(self._display)
            self._display = None


def _library(name: str) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(name)
    except OSError:
        return None
