"""Everything that is connected, bus by bus, with the drivers that claim it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from drivers.device import Device, port_claim
from drivers.errors import DeviceError
from drivers.registry.buses import hid_devices, serial_ports, usb_devices, video_devices
from drivers.registry.claim import Claim
from drivers.registry.discovery import FoundDevice
from drivers.registry.registry import KINDS, driver_names, load_driver, registration_mistakes

_BUS_PARTS: Mapping[str, Callable[[], tuple[FoundDevice, ...]]] = {
    "USB": usb_devices,
    "HID": hid_devices,
    "serial": serial_ports,
    "video": video_devices,
}


@dataclass(frozen=True, slots=True)
class Listing:
    """What was found, and which parts could not be looked at."""

    found: tuple[FoundDevice, ...]
    unavailable: tuple[str, ...]
    """A sentence for each part that could not be looked at: which, why, what to do."""


def list_devices(*, probe: bool = False, say: Callable[[str], None] | None = None) -> Listing:
    """Look at every bus, and ask every driver what it finds.

    Parameters
    ----------
    probe : bool
        Ask at serial ports, too, by writing to them what each driver's protocol asks for. A device of another
        kind may take that for a command: only on the user's request.
    say : callable, optional
        Takes a sentence before each port is probed.
    """
    found: dict[tuple[str, str], FoundDevice] = {}
    unavailable: list[str] = []
    for part in _BUS_PARTS.values():
        try:
            found |= {(device.bus, device.address): device for device in part()}
        except DeviceError as error:
            unavailable.append(str(error))
    claimed: list[FoundDevice] = []
    drivers = list(_drivers(unavailable))
    for _, driver in drivers:
        try:
            claimed += driver.discover()
        except DeviceError as error:
            unavailable.append(str(error))
    if probe:
        known = {device.address for device in claimed}
        for (bus, address), port in list(found.items()):
            if bus == "serial" and address not in known:
                claimed += [
                    replace(
                        device, usb_id=port.usb_id, serial_number=device.serial_number or port.serial_number
                    )
                    for device in _probed(address, drivers, unavailable, say)
                ]
    for device in claimed:
        found.pop((device.bus, device.address), None)
    return Listing((*found.values(), *claimed), tuple(dict.fromkeys(unavailable)))


def _drivers(unavailable: list[str]) -> Iterator[tuple[str, type[Device]]]:
    """Load every driver for hardware, with its name; what is wrong with others goes to ``unavailable``."""
    unavailable += registration_mistakes()
    for kind in KINDS:
        for name in driver_names(kind):
            if name.startswith("simulated"):
                continue  # nothing to find, and the slowest to import
            try:
                yield name, load_driver(kind, name)
            except DeviceError as error:
                unavailable.append(str(error))


def _probed(
    port: str,
    drivers: list[tuple[str, type[Device]]],
    unavailable: list[str],
    say: Callable[[str], None] | None,
) -> list[FoundDevice]:
    """Return what the first driver to recognise a port says of it; none when nobody does."""
    try:
        claim = Claim(port_claim(port), f"serial port {port}")
    except DeviceError as error:
        unavailable.append(str(error))
        return []
    try:
        for name, driver in drivers:
            if driver.probe.__func__ is Device.probe.__func__:  # type: ignore[attr-defined]
                continue
            if say is not None:
                say(f"Asking at {port} as driver {name} would.")
            try:
                device = driver.probe(port)
            except DeviceError as error:
                unavailable.append(str(error))
                return []
            if device is not None:
                return [device]
    finally:
        claim.release()
    return []
