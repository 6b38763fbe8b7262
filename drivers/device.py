"""What every device has in common: how it is found and told apart, open and close, settings as read back."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict

from drivers.errors import LimitError

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


Setting = str | int | float | bool | tuple[float, ...] | tuple[int, ...] | tuple[str, ...] | None


@dataclass(frozen=True, slots=True)
class OwnSetting:
    """A setting that is one device's own, beyond what all of its kind have."""

    value: Setting
    takes: str
    """What it can be set to, in words."""
    choices: tuple[str, ...] = ()
    """All that it can be set to, where that is a list."""


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Who a device says it is.

    ``simulated`` is true for every device without hardware behind it; windows, logs and files then show
    the word SIMULATED.
    """

    kind: str
    """``"camera"``, ``"stage"``, ``"led_array"`` or ``"slm"``."""
    driver: str
    """Name under which the driver is registered, e.g. ``"simulated"``."""
    vendor: str
    model: str
    serial_number: str
    firmware: str
    simulated: bool

    def __str__(self) -> str:
        mark = " (SIMULATED)" if self.simulated else ""
        return f"{self.vendor} {self.model}, serial {self.serial_number}, firmware {self.firmware}{mark}"


class DriverOptions(BaseModel):
    """The keys that a driver adds to its device's table in ``bench.toml``; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def of(cls, options: DriverOptions) -> Self:
        """Return the options that a driver was given, as its own; those of another one are a TypeError."""
        if not isinstance(options, cls):
            raise TypeError(f"{cls.__name__} are needed, not {type(options).__name__}.")
        return options


class SharedPart(ABC):
    """What several drivers of one bench share, built once: the simulated world, a multi-device controller.

    Its options come from the top-level table ``table`` of ``bench.toml``.
    """

    table: ClassVar[str]
    Options: ClassVar[type[DriverOptions]]

    @abstractmethod
    def __init__(self, options: DriverOptions) -> None: ...


def port_claim(port: str) -> str:
    """Return the claim for a serial port or any other file in ``/dev``, whatever link it is named by."""
    return f"port {Path(port).resolve()}"


class Device(ABC):
    """A device that can be opened, asked who it is, asked for its settings, and closed.

    ``close`` brings the device to its safe state (light off, motion stopped, streaming ended) and never
    raises because it was closed before. A device is a context manager. Constructing one touches no hardware.

    Parameters
    ----------
    options : DriverOptions
        An instance of the driver's own ``Options``: the keys of its table in ``bench.toml``.
    shared : SharedPart, optional
        The bench's instance of the class that the driver names as ``Shared``, if it names one.
    """

    Options: ClassVar[type[DriverOptions]] = DriverOptions
    Shared: ClassVar[type[SharedPart] | None] = None
    longest_call_s: ClassVar[float] = 30.0
    """A call that sets or asks something and has not come back by then hangs, and is given up.

    Opening has four times as long; arming a sequence 20 times; homing and moves 20 times, or three times the
    slowest axis' whole travel. A driver whose device takes longer says so.
    """

    @abstractmethod
    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None: ...

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Return the names of what only one program at a time may hold for a device with these options.

        A driver for a port returns the port (``port_claim``); a simulated one nothing. By default two devices
        are the same when driver and options are.
        """
        return (f"{cls.__module__}.{cls.__qualname__} {options.model_dump_json()}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the devices that this driver is sure it can use, told by what their bus says of them.

        Nothing is opened that another program may be using, and nothing is written to a serial port.

        Raises DeviceError when its bus cannot be looked at: a library that is not installed, with how to
        install it.
        """
        return ()

    @classmethod
    def probe(cls, port: str) -> FoundDevice | None:
        """Ask at a serial port, by writing to it, whether this driver's device is there; None when not.

        Only called on the user's request, with the port claimed.

        Raises DeviceError when the port cannot be opened. Silence and other devices' answers are no error.
        """
        return None

    @property
    @abstractmethod
    def name(self) -> str:
        """The device as error messages name it, e.g. ``"stage (simulated)"``; told without asking it."""

    @abstractmethod
    def open(self) -> None:
        """Connect and bring the device to its safe state. Opening an open device does nothing.

        Raises DeviceError when it is missing, busy or does not answer.
        """

    @abstractmethod
    def close(self) -> None:
        """Bring the device to its safe state and disconnect. Closing a closed device does nothing."""

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether the device is connected, as far as the driver knows: told at once, without asking it."""

    @property
    @abstractmethod
    def identity(self) -> DeviceIdentity:
        """Who the device says it is; needs an open device."""

    @abstractmethod
    def settings(self) -> Mapping[str, Setting]:
        """All settings as the device reports them now, with units in the names; needs an open device."""

    def own_settings(self) -> Mapping[str, OwnSetting]:
        """Return the settings that :meth:`set_own` changes, by the device's own names; needs an open device.

        Those that the driver itself looks after (exposure, gain ...) are not among them.
        """
        return {}

    def set_own(self, name: str, value: str) -> Setting:
        """Set one of :meth:`own_settings`, as a person writes it; returns what it reads afterwards.

        Raises LimitError: no such setting, or a value that it does not take.
        """
        raise LimitError(self.name, f"has no setting {name!r} that can be changed to {value!r}.")

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
