"""What Qt does not tell about an X server, asked over a connection of our own."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_char_p, c_int, c_ulong, c_void_p
from typing import NamedTuple


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
