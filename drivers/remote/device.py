"""What every device on another computer has in common; its calls are filled in from its interface."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, TypeVar, cast

from drivers.device import Device, DeviceIdentity, DriverOptions, SharedPart
from drivers.remote.link import Link
from drivers.remote.options import RemoteOptions
from drivers.remote.wire import Call, Kind, calls, facts

_D = TypeVar("_D", bound=type["RemoteDevice"])


class RemoteDevice(Device):
    """A device that ``diffuserbench serve`` offers on another computer, or on this one.

    Opening it has the server open the device; it is this program's until it is closed. When the connection
    ends in any other way the server puts the light off, stops motion and closes its devices.
    """

    Options = RemoteOptions
    kind: ClassVar[Kind]

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self.options = RemoteOptions.of(options)
        self._link = Link(self.options, self.kind, self.name)

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim nothing on this computer: the server has one operator at a time."""
        return ()

    @property
    def name(self) -> str:
        """The device as error messages name it."""
        return f"{self.kind} (remote {self.options.url})"

    def open(self) -> None:
        """Have the server open the device, and learn what it is."""
        if self._link.is_held:
            return
        self.close()
        said = self._link.open()
        for name, values in facts(self.kind).items():
            if name in said:
                setattr(self, name, values.load(said[name]))

    def close(self) -> None:
        """Have the server bring the device to its safe state and close it."""
        self._link.close()

    @property
    def is_open(self) -> bool:
        """Whether the server holds the device for this program."""
        return self._link.is_held

    @property
    def identity(self) -> DeviceIdentity:
        """Who the device says it is; its driver is the server's, after the word remote."""
        said = cast(DeviceIdentity, self._ask("identity"))
        return replace(said, driver=f"remote {said.driver}")

    def _ask(self, name: str, *args: Any, **named: Any) -> Any:
        call = calls(self.kind)[name]
        return self._link.call(call, call.named(self, args, named))


def filled_in(driver: _D) -> _D:
    """Give a class what its interface declares and it does not say itself: calls of the device afar."""
    own = {name for base in driver.__mro__ if issubclass(base, RemoteDevice) for name in vars(base)}
    for name, call in calls(driver.kind).items():
        if name not in own:
            setattr(driver, name, _read(call) if call.signature is None else _method(call))
    abc.update_abstractmethods(driver)
    return driver


def _method(call: Call) -> Callable[..., Any]:
    @functools.wraps(call.function)
    def ask(self: RemoteDevice, *args: Any, **named: Any) -> Any:
        return self._ask(call.name, *args, **named)

    ask.__isabstractmethod__ = False  # type: ignore[attr-defined]  # as wraps has taken it over
    return ask


def _read(call: Call) -> property:
    def ask(self: RemoteDevice) -> Any:
        return self._ask(call.name)

    return property(ask, doc=call.function.__doc__)


def said_facts(device: Device, kind: Kind) -> Mapping[str, Any]:
    """Return what a device declares of itself, as JSON has it, for who opens it from afar."""
    return {name: values.dump(getattr(device, name)) for name, values in facts(kind).items()}
