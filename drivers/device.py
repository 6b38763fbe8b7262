"""What every device has in common: identity, open and close, settings as read back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict

from drivers.registry.discovery import FoundDevice

Setting = str | int | float | bool | tuple[float, ...] | tuple[int, ...] | tuple[str, ...] | None


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

        Raises
        ------
        DeviceError
            When its bus cannot be looked at: a library that is not installed, with how to install it.
        """
        return ()

    @classmethod
    def probe(cls, port: str) -> FoundDevice | None:
        """Ask at a serial port, by writing to it, whether this driver's device is there; None when not.

        Only called on the user's request, with the port claimed.

        Raises
        ------
        DeviceError
            When the port cannot be opened. Silence and other devices' answers are no error.
        """
        return None

    @property
    @abstractmethod
    def name(self) -> str:
        """The device as error messages name it, e.g. ``"stage (simulated)"``."""

    @abstractmethod
    def open(self) -> None:
        """Connect and bring the device to its safe state. Opening an open device does nothing.

        Raises
        ------
        DeviceError
            When it is missing, busy or does not answer.
        """

    @abstractmethod
    def close(self) -> None:
        """Bring the device to its safe state and disconnect. Closing a closed device does nothing."""

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether the device is connected."""

    @property
    @abstractmethod
    def identity(self) -> DeviceIdentity:
        """Who the device says it is; needs an open device."""

    @abstractmethod
    def settings(self) -> Mapping[str, Setting]:
        """All settings as the device reports them now, with units in the names; needs an open device."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
