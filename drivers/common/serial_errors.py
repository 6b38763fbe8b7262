"""Why a serial port does not open."""

from __future__ import annotations

from drivers.device import port_claim
from drivers.errors import DeviceError
from drivers.registry.claim import holder_of


def port_error(device: str, port: str, error: Exception) -> DeviceError:
    """Return the error of a serial port that does not open, in words an operator can act on."""
    text = str(error)
    if "exclusively lock" in text or "busy" in text.lower():
        # This program claims a port before it opens it, so its own claim says nothing of who has the port.
        if holder := holder_of(port_claim(port)):
            return DeviceError(device, f"{port} is in use by {holder}.", "Close that program.")
        return DeviceError(
            device,
            f"{port} is in use by another program, or by another device of this bench.",
            f"Close that program (fuser {port} names it), or give each device its own port.",
        )
    if "No such file" in text or ("could not open port" in text and "Permission" not in text):
        return DeviceError(device, f"there is no port {port}.", "Is it plugged in and switched on?")
    if "Permission" in text:
        return DeviceError(
            device,
            f"{port} may not be used (permission denied).",
            "Join the group that owns it (Debian: sudo adduser $USER dialout) and log in again.",
        )
    return DeviceError(device, f"{port} cannot be opened: {text}.", "Check port and baud rate.")
