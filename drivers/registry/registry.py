"""Find a driver by the name that the configuration gives it.

Drivers register in the entry point group ``diffuserbench.drivers`` under ``NAME.KIND``, where KIND is
``camera``, ``stage``, ``led_array`` or ``slm``: built-in ones in this project's ``pyproject.toml``, others in
the package that brings them. A driver is imported only when it is asked for.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from drivers.device import Device, FoundDevice, port_claim
from drivers.errors import DeviceError
from drivers.registry.buses import hid_devices, serial_ports, usb_devices, video_devices
from drivers.registry.claim import Claim

GROUP = "diffuserbench.drivers"
KINDS = ("camera", "stage", "led_array", "slm")

_INTERFACES: Mapping[str, str] = {
    "camera": "drivers.camera:Camera",
    "stage": "drivers.stage:Stage",
    "led_array": "drivers.led_array:LedArray",
    "slm": "drivers.slm:Slm",
}
"""What a driver of each kind is; imported with the driver, as it does anyway."""
_PACKAGES: Mapping[str, str] = {"serial": "pyserial", "usb": "pyusb", "hidraw": "hidapi", "hid": "hidapi"}
"""Modules that are not called as the package that brings them."""


def driver_names(kind: str) -> tuple[str, ...]:
    """Names of the drivers registered for a kind of device, sorted."""
    suffix = f".{kind}"
    names = {point.name.removesuffix(suffix) for point in _points() if point.name.endswith(suffix)}
    return tuple(sorted(names - {""}))


def registration_mistakes() -> tuple[str, ...]:
    """Return a sentence for each entry point that names no driver, and each name that is taken twice."""
    mistakes = []
    taken: dict[str, list[EntryPoint]] = defaultdict(list)
    for point in _points():
        name, _, kind = point.name.rpartition(".")
        if name and kind in KINDS:
            taken[point.name].append(point)
        else:
            mistakes.append(
                f"Entry point {_words(point)} is no driver's: it must be called NAME.KIND, "
                f"KIND one of {', '.join(KINDS)}."
            )
    for name, points in sorted(taken.items()):
        if len(points) > 1:
            mistakes.append(f"Driver {name} is registered by {_all(points)}: {_ONE_OF_THEM}")
    return tuple(mistakes)


def load_driver(kind: str, name: str) -> type[Device]:
    """Import and return the driver class registered as ``NAME.KIND``.

    Raises DeviceError when no such driver is registered or several are, when it cannot be imported (the text
    says what is missing), and when it is no driver of that kind.
    """
    device = f"{kind} ({name})"
    points = [point for point in _points() if point.name == f"{name}.{kind}"]
    if not points:
        raise DeviceError(
            device,
            "no such driver is registered.",
            " ".join([f"Available: {', '.join(driver_names(kind)) or 'none'}.", *registration_mistakes()]),
        )
    if len(points) > 1:
        raise DeviceError(device, f"it is registered by {_all(points)}.", f"Of these packages {_ONE_OF_THEM}")
    (point,) = points
    driver = _imported(device, point)
    interface = _INTERFACES[kind]
    module, _, wanted = interface.partition(":")
    if not (isinstance(driver, type) and issubclass(driver, getattr(import_module(module), wanted))):
        raise DeviceError(
            device,
            f"{_words(point)} is no driver of this kind: a {kind} is a class made from {interface}.",
            "Correct the entry point, or register it under the kind it is.",
        )
    assert issubclass(driver, Device)
    return driver


def how_to_install(module: str) -> str:
    """Return the sentence that tells how to get a module."""
    name = module.partition(".")[0]
    return f"Install {_PACKAGES.get(name, name)} (pip install {_PACKAGES.get(name, name)})."


def _imported(device: str, point: EntryPoint) -> object:
    """Return what an entry point names; its mistakes, and its module's, in words."""
    try:
        found: object = import_module(point.module)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        own = missing.partition(".")[0] == point.module.partition(".")[0]
        remedy = (
            f"Correct {_words(point)}, or install its package again."
            if own or not missing
            else how_to_install(missing)
        )
        raise DeviceError(device, f"its driver cannot be imported: {error}.", remedy) from error
    except Exception as error:  # a plug-in may fail in any way, and that must not end `check` or `devices`
        problem = f"its driver cannot be imported: {type(error).__name__}: {error}."
        raise DeviceError(
            device, problem, f"This is a mistake in {_words(point)}, or in what it imports."
        ) from error
    for part in point.attr.split(".") if point.attr else ():
        if not hasattr(found, part):
            problem = f"there is no {point.attr} in module {point.module}."
            raise DeviceError(device, problem, f"Correct the entry point {_words(point)}.")
        found = getattr(found, part)
    return found


_ONE_OF_THEM = "uninstall all but one, or let them use different names."


def _words(point: EntryPoint) -> str:
    package = f" of {point.dist.name}" if point.dist is not None else ""
    return f'"{point.name}" = "{point.value}"{package}'


def _all(points: list[EntryPoint]) -> str:
    return " and by ".join(map(_words, points))


_read: dict[object, tuple[EntryPoint, ...]] = {}
"""The entry points, by the folders of packages and when each of these was last changed."""


def _points() -> tuple[EntryPoint, ...]:
    """Return the entry points, those that a package lists twice once.

    They are read again when a package was installed or removed since: reading them opens a file of every
    installed package, and a bench asks twice for each of its devices.
    """
    there = (tuple((folder, _changed_ns(folder)) for folder in sys.path), entry_points)
    found = _read.get(there)
    if found is None:
        points = entry_points(group=GROUP)
        alike = Counter((p.name, p.value) for p in points)
        owners = {p: p.dist and p.dist.name for p in points if alike[p.name, p.value] > 1}  # 1.5 ms each
        found = tuple({(p.name, p.value, owners.get(p)): p for p in points}.values())
        _read.clear()
        _read[there] = found
    return found


def _changed_ns(folder: str) -> int:
    try:
        return Path(folder).stat().st_mtime_ns
    except OSError:
        return 0


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
