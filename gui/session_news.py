"""What a session has for the window: how devices do, what is logged, what the operator is asked to do."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.device import Device
from drivers.errors import DeviceError, DeviceLostError, DeviceNotOpenError, DeviceTimeoutError


class OperatorRequest:
    """Something that the operator is asked to do by hand; a job waits for the answer."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.answered: Callable[[], None] | None = None
        self.withdrawn: Callable[[], object] | None = None
        """Takes the question from the screen when STOP has answered it."""
        self._done = threading.Event()
        self._refused = False

    def answer(self, done: bool) -> None:
        """Say that it is done, or will not be: the job ends then."""
        self._refused = self._refused or not done
        if not self._done.is_set():
            self._done.set()
            if self.answered is not None:
                self.answered()

    def wait(self) -> None:
        """Wait for the answer, in the job's thread; KeyboardInterrupt when it is no."""
        self._done.wait()
        if self._refused:
            raise KeyboardInterrupt


@dataclass(frozen=True, slots=True)
class OwnFiles:
    """Files from anywhere to be worked with: a photograph and its PSF, or a result."""

    photograph: Path | None = None
    psf: Path | None = None
    result: Path | None = None


DeviceCondition = Literal["closed", "opening", "open", "failed"]


@dataclass(frozen=True, slots=True)
class DeviceState:
    """How a device is doing.

    Attributes
    ----------
    condition : str
        ``"closed"``, ``"opening"``, ``"open"`` or ``"failed"``.
    text : str
        Who the device says it is, or why it failed and what to check.
    simulated : bool
    """

    condition: DeviceCondition
    text: str = ""
    simulated: bool = False


def name_of(kind: str) -> str:
    """Return what people call a kind of device: ``"led_array"`` is an LED array."""
    return kind.replace("_", " ").replace("led", "LED").replace("slm", "SLM")


def names_of(kinds: Sequence[str]) -> str:
    """Return kinds of devices as they are listed in a sentence."""
    *others, last = [name_of(kind) for kind in kinds] or [""]
    return f"{', '.join(others)} and {last}" if others else last


def is_gone(device: Device, error: DeviceError) -> bool:
    """Whether an error means that a device cannot be used any more."""
    if isinstance(error, DeviceLostError | DeviceNotOpenError | DeviceTimeoutError) or not device.is_open:
        return True
    try:
        _ = device.identity
    except DeviceError:
        return True
    return False


_OWN = frozenset({"calibration_routines", "drivers", "gui", "instrument", "recon"})
"""What an operator has no use for the names of; those of other packages say who speaks."""


class LogBridge(logging.Handler):
    """Hands on what is logged, in whatever thread, as a level of the log panel and a text.

    Parameters
    ----------
    callback : callable
        Called with both, in the thread that logs.
    """

    def __init__(self, callback: Callable[[str, str], object]) -> None:
        super().__init__(logging.INFO)
        self._callback = callback

    def emit(self, record: logging.LogRecord) -> None:
        """Hand on a record."""
        level = {logging.WARNING: "warning", logging.ERROR: "error", logging.CRITICAL: "error"}.get(
            record.levelno, "info"
        )
        with contextlib.suppress(RuntimeError):  # the window is gone
            own = record.name.partition(".")[0] in _OWN
            self._callback(level, record.getMessage() if own else f"{record.name}: {record.getMessage()}")
