"""Micro-Manager's core: loaded once for all devices of a bench, its properties by name, errors in words."""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.common.camera_settings import ONCE
from drivers.device import Device, DeviceIdentity, DriverOptions, FoundDevice, OwnSetting, Setting, SharedPart
from drivers.errors import DeviceError, DeviceNotOpenError, LimitError

DOCS = "docs/how-to/devices/micromanager.md"
_REMEDY = f'pip install "diffuserbench[micromanager]"; see {DOCS}.'
_SIMULATED = ("DemoCamera", "NotificationTester", "SequenceTester")
"""Adapters without hardware behind them."""
_FLOAT, _INTEGER = 2, 3

PropertyValue = str | bool | int | float
"""A property's value as ``bench.toml`` writes it; Micro-Manager's own are texts."""


class LoadedDevice(BaseModel):
    """One device that is loaded by its adapter, in place of a configuration file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    library: str = Field(min_length=1, description='Adapter, e.g. "DemoCamera".')
    device: str = Field(min_length=1, description='Device in the adapter, e.g. "DCam".')
    hub: str | None = Field(None, description="Label of the hub that it hangs on, loaded before it.")
    before: dict[str, PropertyValue] = Field(
        default_factory=dict, description="Properties to set before the device is initialised (port, id)."
    )


class MicroManagerOptions(DriverOptions):
    """Micro-Manager: where it is and which devices it serves."""

    installation: Path | None = Field(
        None,
        description=(
            "Folder of Micro-Manager, which holds the adapters; left out: the one that pymmcore-plus finds "
            "(MICROMANAGER_PATH, or the usual places)."
        ),
    )
    configuration: Path | None = Field(
        None, description="File that Micro-Manager's Hardware Configuration Wizard wrote (.cfg)."
    )
    devices: dict[str, LoadedDevice] = Field(
        default_factory=dict, description="[micromanager.devices.LABEL]: devices without such a file."
    )

    @model_validator(mode="after")
    def _one_of_both(self) -> MicroManagerOptions:
        if self.configuration is not None and self.devices:
            raise ValueError("configuration and devices exclude each other: the file loads its own devices")
        if self.configuration is None and not self.devices:
            raise ValueError("configuration (a .cfg file) or devices is needed")
        return self


class MicroManager(SharedPart):
    """The core that all Micro-Manager devices of a bench share; loaded with the first, let go with the last.

    The core is one library for all its adapters: a call into an adapter waits for another call into the same
    adapter. No call here blocks for longer than the adapter needs to pass a command on.
    """

    table = "micromanager"
    Options = MicroManagerOptions

    def __init__(self, options: DriverOptions) -> None:
        self.options = MicroManagerOptions.of(options)
        self._lock = threading.Lock()
        self._users: set[Device] = set()
        self._core: Any = None

    def acquire(self, user: Device) -> Any:
        """Return the core, with all devices loaded.

        Raises DeviceError when pymmcore, the installation or an adapter is missing, or a device does not
        answer.
        """
        with self._lock:
            if self._core is None:
                self._core = self._loaded(user.name)
            self._users.add(user)
            return self._core

    def release(self, user: Device) -> None:
        """Let go of the core; with its last user every device is unloaded."""
        with self._lock:
            self._users.discard(user)
            if self._users or self._core is None:
                return
            core, self._core = self._core, None
            with suppress(RuntimeError):  # of a device that is gone
                core.unloadAllDevices()

    def _loaded(self, name: str) -> Any:
        try:
            from pymmcore import CMMCore
        except ImportError as error:
            raise DeviceError(name, f"Micro-Manager's core cannot be loaded: {error}.", _REMEDY) from error
        options = self.options
        core = CMMCore()
        core.setDeviceAdapterSearchPaths([str(self._installation(name))])
        try:
            if options.configuration is not None:
                self._load_file(core, name, options.configuration)
            else:
                self._load_devices(core, name)
        except BaseException:
            with suppress(RuntimeError):
                core.unloadAllDevices()
            raise
        return core

    def _installation(self, name: str) -> Path:
        folder = self.options.installation or found_installation()
        if folder is None:
            raise DeviceError(
                name, "no installation of Micro-Manager was found.", f"Install one, and name it; see {DOCS}."
            )
        if not folder.is_dir():
            raise DeviceError(
                name, f"[micromanager] installation = {str(folder)!r} is no folder.", "Correct the path."
            )
        return folder

    def _load_file(self, core: Any, name: str, path: Path) -> None:
        if not path.is_file():
            raise DeviceError(
                name, f"[micromanager] configuration = {str(path)!r} is no file.", "Correct the path."
            )
        with words(name, f"load {path.name}", f"Does Micro-Manager itself load it? {_versions(core)}"):
            core.loadSystemConfiguration(str(path))

    def _load_devices(self, core: Any, name: str) -> None:
        for label, device in self.options.devices.items():
            doing = f"load {device.device} of the adapter {device.library} as {label!r}"
            known = ", ".join(core.getDeviceAdapterNames()) or "none"
            with words(name, doing, f"Adapters there are: {known}. {_versions(core)}"):
                core.loadDevice(label, device.library, device.device)
                if device.hub is not None:
                    core.setParentLabel(label, device.hub)
                for key, value in device.before.items():
                    core.setProperty(label, key, _text(value))
        for label in self.options.devices:
            with words(name, f"initialise {label!r}", "Is it on and connected? Is its port right?"):
                core.initializeDevice(label)


def found_installation() -> Path | None:
    """Return the folder of Micro-Manager that pymmcore-plus finds, None without one."""
    root = logging.getLogger()
    level = root.level
    try:
        from pymmcore_plus import find_micromanager
    except ImportError:
        return None
    finally:
        root.setLevel(level)  # importing it, everybody's messages are wanted down to the smallest
    logging.getLogger("pymmcore-plus").setLevel(logging.WARNING)  # else it prints what it looks at
    found = find_micromanager()
    return Path(found) if found else None


def found_by_installation() -> tuple[FoundDevice, ...]:
    """Return Micro-Manager's installation, for the list of devices: its adapters bring the devices.

    Raises DeviceError when pymmcore-plus is not installed.
    """
    if find_spec("pymmcore_plus") is None:
        raise DeviceError("Micro-Manager", "cannot be looked for: pymmcore-plus is not installed.", _REMEDY)
    folder = found_installation()
    if folder is None:
        return ()
    description = f"Micro-Manager; how to use its devices: {DOCS}"
    return (FoundDevice("Micro-Manager", str(folder), description),)


@contextmanager
def words(name: str, doing: str, remedy: str) -> Iterator[None]:
    """Turn the core's error into one of the device ``name``, which could not do something.

    Raises DeviceError with the adapter's own words.
    """
    try:
        yield
    except (RuntimeError, ValueError, OSError) as error:
        # The core's messages may go on for several lines: the causes of the cause.
        said = "; ".join(line.strip() for line in str(error).splitlines() if line.strip()).rstrip(".")
        raise DeviceError(name, f"cannot {doing}: {said}.", remedy) from error


def _versions(core: Any) -> str:
    return f"This is {core.getVersionInfo()}, {core.getAPIVersionInfo()}: adapters must have the same one."


def _text(value: PropertyValue) -> str:
    """Return a property's value as Micro-Manager writes it: 0 and 1 for truth."""
    return str(int(value)) if isinstance(value, bool) else str(value)


def _same(one: str, other: str) -> bool:
    """Whether two values are the same word, or number: real ones are read back with four decimals."""
    try:
        return one == other or float(one) == float(other)
    except ValueError:
        return False


class Part:
    """One loaded device, by its label.

    Parameters
    ----------
    core : pymmcore.CMMCore
    label : str
    name : str
        The device as error messages name it.
    """

    def __init__(self, core: Any, label: str, name: str) -> None:
        self.core, self.label, self.name = core, label, name
        if label not in core.getLoadedDevices():
            known = ", ".join(other for other in core.getLoadedDevices() if other != "Core") or "none"
            raise DeviceError(name, f"Micro-Manager has no device {label!r}.", f"It has {known}.")

    def call(self, doing: str, function: str, *values: Any) -> Any:
        """Call one of the core's functions on this device.

        Raises DeviceError with the adapter's own words.
        """
        with words(self.name, doing, f"It is the device {self.label!r} of Micro-Manager."):
            return getattr(self.core, function)(self.label, *values)

    @property
    def properties(self) -> tuple[str, ...]:
        """Names of the device's properties."""
        return tuple(self.call("list its properties", "getDevicePropertyNames"))

    def has(self, name: str) -> bool:
        """Whether there is a property of this name."""
        return bool(self.call(f"look for {name!r}", "hasProperty", name))

    def text(self, name: str) -> str:
        """Return a property's value."""
        return str(self.call(f"say {name!r}", "getProperty", name))

    def number(self, name: str) -> float:
        """Return a property's value as a number.

        Raises DeviceError when it is none.
        """
        text = self.text(name)
        try:
            return float(text)
        except ValueError:
            raise DeviceError(
                self.name, f"its property {name!r} is {text!r}; a number is expected."
            ) from None

    def bounds(self, name: str) -> tuple[float, float] | None:
        """Return a numeric property's limits; None without any."""
        if not self.call(f"look at {name!r}", "hasPropertyLimits", name):
            return None
        lowest = self.call(f"say the limits of {name!r}", "getPropertyLowerLimit", name)
        return float(lowest), float(self.call(f"say the limits of {name!r}", "getPropertyUpperLimit", name))

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values that a property takes; empty when it takes any."""
        return tuple(self.call(f"list the values of {name!r}", "getAllowedPropertyValues", name))

    def set(self, name: str, value: PropertyValue) -> str:
        """Set a property; returns what the device made of it.

        Raises LimitError when there is no such property, or the value is none that it takes; DeviceError when
        the adapter refuses, or has another choice afterwards.
        """
        if not self.has(name):
            raise LimitError(
                self.name,
                f"{self.label!r} has no property {name!r}.",
                f"It has {', '.join(self.properties)}.",
            )
        wanted = _text(value)
        if self.call(f"look at {name!r}", "getPropertyType", name) == _INTEGER:
            with suppress(ValueError):
                wanted = str(round(float(wanted)))
        choices, bounds = self.choices(name), self.bounds(name)
        if choices and wanted not in choices:
            raise LimitError(
                self.name, f"has no {name} {wanted!r}.", f"{name} is one of {', '.join(choices)}."
            )
        if bounds is not None and not self._within(wanted, bounds):
            raise LimitError(
                self.name, f"has no {name} {wanted}.", f"{name} is {bounds[0]:g} to {bounds[1]:g}."
            )
        self.call(f"set {name!r} to {wanted!r}", "setProperty", name, wanted)
        said = self.text(name)
        if choices and wanted != ONCE and not _same(said, wanted):
            raise DeviceError(self.name, f"was told {name} = {wanted} and has {said}.", "See its adapter.")
        return said

    def _within(self, wanted: str, bounds: tuple[float, float]) -> bool:
        try:
            return bounds[0] <= float(wanted) <= bounds[1]
        except ValueError:
            return False

    def set_all(self, values: Mapping[str, PropertyValue]) -> None:
        """Set properties in their order; errors as ``set``."""
        for name, value in values.items():
            self.set(name, value)

    def settings(self) -> dict[str, Setting]:
        """Return every property with its value, as ``property.NAME``."""
        return {f"property.{name}": self.text(name) for name in self.properties}

    def own_settings(self, without: Collection[str] = ()) -> dict[str, OwnSetting]:
        """Return every property that can be set, but for some."""
        found = {}
        for name in self.properties:
            if name in without or self.call(f"look at {name!r}", "isPropertyReadOnly", name):
                continue
            choices, bounds = self.choices(name), self.bounds(name)
            takes = f"{bounds[0]:g} to {bounds[1]:g}" if bounds else ", ".join(choices) or "any text"
            found[name] = OwnSetting(self.text(name), takes, choices)
        return found

    def identity(self, kind: str) -> DeviceIdentity:
        """Return who the device is, as far as its adapter says."""
        library = str(self.call("say its adapter", "getDeviceLibrary"))
        serial = next((self.text(name) for name in ("CameraID", "SerialNumber") if self.has(name)), "")
        return DeviceIdentity(
            kind=kind,
            driver="micromanager",
            vendor=f"Micro-Manager {library}",
            model=str(self.call("say its name", "getDeviceName")),
            serial_number=serial or self.label,
            firmware=self.core.getVersionInfo(),
            simulated=library in _SIMULATED,
        )


class MicroManagerDevice(Device):
    """What the drivers of Micro-Manager's devices share: the core, and the claim on their labels."""

    Shared = MicroManager

    def _share(self, shared: SharedPart | None) -> None:
        if not isinstance(shared, MicroManager):
            raise TypeError(f"A Micro-Manager device needs the bench's MicroManager, not {shared!r}.")
        self._manager = shared
        self._core: Any = None

    def _acquire(self) -> Any:
        self._core = self._manager.acquire(self)
        return self._core

    def _release(self) -> None:
        if self._core is not None:
            self._core = None
            self._manager.release(self)

    def _require_core(self) -> Any:
        if self._core is None:
            raise DeviceNotOpenError(self.name)
        return self._core

    def _part(self, label: str | None, role: str) -> Part:
        """Return the device of a label; of None the one that Micro-Manager's configuration has in a role."""
        core = self._require_core()
        label = label or getattr(core, f"get{role}Device")()
        if not label:
            raise DeviceError(
                self.name,
                f"Micro-Manager's configuration names no default {role}.",
                "Name the device by its label in bench.toml.",
            )
        return Part(core, label, self.name)
