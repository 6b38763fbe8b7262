"""What was found connected to this computer, and the lines of ``bench.toml`` that use it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

BUSES = ("USB", "HID", "serial", "video", "GenICam", "display")
"""The buses that are looked at, in the order in which they are listed; a driver may bring others."""


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """One device on one bus; the same hardware may be found on several (USB, HID, serial).

    ``driver``, ``kind`` and ``options`` are given by a driver that is sure that it can use the device.
    """

    bus: str
    """One of ``BUSES``, or another word that people know."""
    address: str
    """How the bus names it: ``"/dev/ttyUSB0"``, ``"bus 1 device 4"``, ``"HDMI-1"``."""
    description: str
    vendor: str = ""
    product: str = ""
    serial_number: str = ""
    usb_id: str = ""
    """Vendor and product as ``lsusb`` writes them: ``"0403:faf0"``; empty when it is no USB device."""
    driver: str | None = None
    """Name that ``driver =`` takes in ``bench.toml``; None when no driver claims the device."""
    kind: str | None = None
    """``"camera"``, ``"stage"``, ``"led_array"`` or ``"slm"``, with ``driver``."""
    options: Mapping[str, object] = field(default_factory=dict)
    """The keys of its table in ``bench.toml``, beside ``driver``."""
    note: str = ""
    """What the user must add to these lines, if anything."""

    def bench_lines(self) -> str:
        """Return the table of ``bench.toml`` that uses the device; empty when no driver claims it."""
        if self.driver is None or self.kind is None:
            return ""
        rows = {"driver": self.driver, **self.options}
        lines = [f"[{self.kind}]", *(f"{key} = {_toml(value)}" for key, value in rows.items())]
        return "\n".join([*lines, f"# {self.note}"] if self.note else lines)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    # A TOML basic string escapes as JSON does, and DEL besides.
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
