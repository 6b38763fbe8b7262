"""The SLM as a second display: a full-screen window whose pixels are the SLM's, one for one."""

from __future__ import annotations

import importlib.util
import sys
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, Setting, SharedPart
from drivers.errors import DeviceError, DeviceNotOpenError
from drivers.second_display.outputs import Output, SecondDisplayOptions
from drivers.slm import Slm, read_only

if TYPE_CHECKING:
    from drivers.second_display.in_process import WindowHere
    from drivers.second_display.process import WindowProcess

_INSTALL = 'Install it: pip install "diffuserbench[gui]".'


class SecondDisplaySlm(Slm):
    """An SLM that takes its picture from an output of this computer (HDMI, DisplayPort, DVI).

    The window is drawn by the Qt program that runs in this process, or else by a process of its own, which
    ends with this one, however this one ends. When the output is lost, ``display`` raises an error that names
    it, ``is_open`` turns false, and ``open`` starts over.
    """

    Options = SecondDisplayOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self.options = options = SecondDisplayOptions.of(options)
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._window: WindowHere | WindowProcess | None = None
        self._output: Output | None = None
        self._inhibited_by = ""
        self._lost: DeviceError | None = None
        self._displayed: npt.NDArray[np.uint8] | None = None

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the output by the name that the configuration gives it."""
        wanted = SecondDisplayOptions.of(options).wanted
        return ("display " + ", ".join(f"{key} {value}" for key, value in wanted.items()),)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the desktop's outputs; those that are not the primary one with the lines to use them."""
        window = _window("display", lambda _error: None)
        try:
            found = window.outputs()
        finally:
            window.close()
        return tuple(_found(output) for output in found)

    @property
    def name(self) -> str:
        """The device as error messages name it."""
        return "slm (second_display)"

    def open(self) -> None:
        """Cover the output with a blank window.

        Raises DeviceError when Qt is not installed, there is no desktop, or the output is missing or in a
        wrong mode.
        """
        with self._lock:
            if self.is_open:
                return
            self._end_window()
            self._lost = None
            window = _window(self.name, self._on_lost)
            try:
                output, inhibited_by = window.open(self.options)
            except BaseException:
                window.close()
                raise
            self._closing.clear()
            self._window, self._output, self._inhibited_by = window, output, inhibited_by
            self._displayed = np.zeros((output.height, output.width), np.uint8)

    def close(self) -> None:
        """Remove the window: the output shows the desktop again."""
        self._closing.set()
        with self._lock:
            self._end_window()
            self._lost = None

    @property
    def is_open(self) -> bool:
        """Whether the output is covered by our window."""
        return self._window is not None and self._lost is None

    @property
    def identity(self) -> DeviceIdentity:
        """What the display reports about itself (EDID)."""
        output = self._require()
        return DeviceIdentity(
            kind="slm",
            driver="second_display",
            vendor=output.manufacturer or "unknown vendor",
            model=output.model or f"display on {output.name}",
            serial_number=output.serial_number or "unknown",
            firmware="unknown",
            simulated=False,
        )

    def settings(self) -> Mapping[str, Setting]:
        """Read output, shape, timing, and what keeps the screen saver off."""
        output = self._require()
        return {
            "output": output.name,
            "shape": self.shape,
            "refresh_hz": output.refresh_hz,
            "pixel_pitch_um": self.options.pixel_pitch_um,
            "settle_ms": self.settle_ms,
            "screen_saver_kept_off_by": self._inhibited_by,
        }

    @property
    def shape(self) -> tuple[int, int]:
        """``(height, width)`` of the output, pixels."""
        output = self._require()
        return output.height, output.width

    @property
    def pixel_pitch_um(self) -> float:
        """Pixel pitch, micrometres."""
        return self.options.pixel_pitch_um

    @property
    def settle_ms(self) -> float:
        """Time from the drawn pattern to settled optics: sending it whole, then the liquid crystal."""
        output = self._output
        refresh_ms = 1e3 / output.refresh_hz if output is not None and output.refresh_hz > 0 else 0.0
        return self.options.refreshes_to_wait * refresh_ms + self.options.settle_ms

    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        """Show grey levels: drawn, confirmed by the display server, sent and settled when this returns."""
        with self._lock:
            self._check(levels)
            window = self._window
            assert window is not None
            shown = levels.copy()
            self._displayed = None
            window.show(shown)
            self._displayed = shown
        self._closing.wait(self.settle_ms * 1e-3)

    @property
    def displayed(self) -> npt.NDArray[np.uint8]:
        """The grey levels shown now, read only; after a pattern that failed an error until the next one."""
        self._require()
        if self._displayed is None:
            raise DeviceError(self.name, "what it shows is unknown after a failure.", "Display again.")
        return read_only(self._displayed)

    def _require(self) -> Output:
        lost = self._lost
        if lost is not None:
            raise lost
        if self._window is None or self._output is None:
            raise DeviceNotOpenError(self.name)
        return self._output

    def _on_lost(self, error: DeviceError) -> None:
        self._lost = error

    def _end_window(self) -> None:
        window, self._window = self._window, None
        if window is not None:
            window.close()


def _window(device: str, on_lost: Callable[[DeviceError], None]) -> WindowHere | WindowProcess:
    """Return where a window is drawn: by the Qt program in this process, or in a process of its own."""
    if importlib.util.find_spec("PySide6") is None:
        raise DeviceError(device, "needs PySide6 (Qt), which is not installed.", _INSTALL)
    if _qt_program_runs():
        from drivers.second_display.in_process import WindowHere

        return WindowHere(device, on_lost)
    from drivers.second_display.process import WindowProcess

    return WindowProcess(device, on_lost)


def _qt_program_runs() -> bool:
    gui = sys.modules.get("PySide6.QtGui")  # without importing Qt into a program that has none
    return gui is not None and isinstance(gui.QGuiApplication.instance(), gui.QGuiApplication)


def _found(output: Output) -> FoundDevice:
    usable = not output.primary
    return FoundDevice(
        bus="display",
        address=output.name,
        description=str(output).removeprefix(f"{output.name} ").strip("()"),
        vendor=output.manufacturer,
        product=output.model,
        serial_number=output.serial_number,
        driver="second_display" if usable else None,
        kind="slm" if usable else None,
        options={"output": output.name, "shape": [output.height, output.width]} if usable else {},
        note="pixel_pitch_um = ... must be added, from the SLM's data sheet" if usable else "",
    )
