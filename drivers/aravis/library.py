"""The Aravis library through PyGObject, loaded when the first camera asks for it."""

from __future__ import annotations

import threading
from typing import Any

from drivers.errors import DeviceError

REMEDY = (
    "Debian: sudo apt install gir1.2-aravis-0.8 python3-gi, then .ci/link-gi; see "
    "docs/how-to/devices/aravis.md. "
    'Elsewhere: Aravis 0.8, and pip install "diffuserbench[aravis]".'
)
FAKE_PREFIX = "Fake_"
"""Ids of the cameras that Aravis itself makes up, for tests."""

_lock = threading.Lock()


def load(device: str) -> Any:
    """Return Aravis' namespace.

    Parameters
    ----------
    device : str
        Who asks, for the error.

    Raises
    ------
    DeviceError
        When PyGObject or Aravis is not installed, saying which.
    """
    with _lock:
        try:
            import gi
        except ImportError as error:
            raise DeviceError(device, f"PyGObject cannot be loaded ({error}).", REMEDY) from error
        try:
            gi.require_version("Aravis", "0.8")
            from gi.repository import Aravis
        except (ValueError, ImportError) as error:
            raise DeviceError(device, f"Aravis 0.8 cannot be loaded ({error}).", REMEDY) from error
        return Aravis


def library_error() -> type[Exception]:
    """Return the exception that Aravis' calls end with; only after :func:`load`."""
    from gi.repository import GLib

    error: type[Exception] = GLib.Error
    return error


def enable_fake(aravis: Any, device_id: str | None) -> None:
    """Have Aravis make up a camera when, and only when, its id is asked for."""
    if device_id is not None and device_id.startswith(FAKE_PREFIX):
        aravis.enable_interface("Fake")
