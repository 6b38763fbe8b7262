"""How a device is doing, and whether an error means that it is gone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from drivers.device import Device
from drivers.errors import DeviceError, DeviceLostError, DeviceNotOpenError, DeviceTimeoutError

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


def is_gone(device: Device, error: DeviceError) -> bool:
    """Whether an error means that a device cannot be used any more."""
    if isinstance(error, DeviceLostError | DeviceNotOpenError | DeviceTimeoutError) or not device.is_open:
        return True
    try:
        _ = device.identity
    except DeviceError:
        return True
    return False
