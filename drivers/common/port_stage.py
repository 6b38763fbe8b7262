"""A stage of axes behind one serial port, each asked and told by itself: what such controllers share."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from pydantic import Field

from drivers.common.polled_stage import PolledStage, StageState
from drivers.common.serial_transport import SerialTransport
from drivers.common.stage_axes import AxisMap, AxisOptions
from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, port_claim
from drivers.errors import DeviceError
from drivers.registry.buses import lasting_name
from drivers.stage import StageAxis

_LEAVING_S = 0.15
"""What an axis may need until it says that it moves."""


class PortOptions(DriverOptions):
    """The port; a driver adds its axes."""

    port: str = Field(min_length=1, description='Serial port, e.g. "/dev/ttyUSB0".')


@dataclass(frozen=True, slots=True)
class AxisState:
    """What one axis says, its place in the controller's unit; ``fault`` in words, empty without one."""

    place: float
    moving: bool
    homed: bool
    fault: str = ""


class PortStage(PolledStage):
    """Moves axes one command each; a driver gives the words of its protocol.

    ``driver`` and ``vendor`` name it; ``axis_options`` are its axes by the bench's names.
    """

    driver: ClassVar[str]
    vendor: ClassVar[str]
    options: PortOptions
    axis_options: Mapping[str, AxisOptions]
    probed_axis: ClassVar[Mapping[str, object]]
    """Options of a first axis, for what is found by asking; the user adds the others."""

    def __init__(self, options: PortOptions, link: SerialTransport) -> None:
        super().__init__()
        self.options = options
        self._link = link
        self._maps: dict[str, AxisMap] = {}
        self._homing: dict[str, float] = {}
        """When axes were sent home that have not arrived, by the monotonic clock."""
        self._left: set[str] = set()
        """Those of them that were seen to move."""
        self._homed: set[str] = set()
        """Axes that came home since the stage was opened, of controllers that do not tell."""

    # What a driver gives ---------------------------------------------------------------------------
    @abstractmethod
    def _identify(self) -> tuple[str, str, str]:
        """Return model, serial number and firmware."""

    @abstractmethod
    def _read_axis(self, name: str) -> tuple[AxisMap, StageAxis]:
        """Ask for an axis' units, limits and speed."""

    @abstractmethod
    def _axis_state(self, name: str) -> AxisState:
        """Ask where an axis is and whether it moves."""

    @abstractmethod
    def _send_move(self, name: str, place: float) -> None:
        """Begin to move an axis to a place in the controller's unit."""

    @abstractmethod
    def _send_home(self, name: str) -> None:
        """Begin to look for an axis' reference."""

    # What is the same ------------------------------------------------------------------------------
    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the serial port."""
        assert isinstance(options, PortOptions)
        return (port_claim(options.port),)

    @classmethod
    def probe(cls, port: str) -> FoundDevice | None:
        """Open the port, and ask the first axis who it is."""
        table = {"port": port, "axes": {"x_um": dict(cls.probed_axis)}}
        stage = cls(cls.Options.model_validate(table), None)  # type: ignore[arg-type]
        link = stage._link
        link.open()
        try:
            model, serial_number, firmware = stage._identify()
        except DeviceError:
            return None
        finally:
            link.close()
        return FoundDevice(
            "serial",
            port,
            f"{cls.vendor} {model}, firmware {firmware}",
            vendor=cls.vendor,
            serial_number=serial_number,
            driver=cls.driver,
            kind="stage",
            options=table | {"port": lasting_name(port)},
            note="add the other axes like this one",
        )

    @property
    def name(self) -> str:
        """The stage as error messages name it."""
        return f"stage ({self.driver}, {self.options.port})"

    @property
    def _is_connected(self) -> bool:
        return self._link.is_open

    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        self._link.open()
        model, serial_number, firmware = self._identify()
        axes = []
        for name in self.axis_options:
            self._maps[name], axis = self._read_axis(name)
            axes.append(axis)
        identity = DeviceIdentity("stage", self.driver, self.vendor, model, serial_number, firmware, False)
        return identity, tuple(axes)

    def _disconnect(self) -> None:
        self._link.close()

    def _state(self) -> StageState:
        position, moving, homed, faults = {}, False, True, []
        for name in self.axis_options:
            state = self._axis_state(name)
            position[name] = self._maps[name].to_bench(state.place)
            moving |= state.moving
            homed &= state.homed
            if state.fault:
                faults.append(f"{name} ({self._maps[name].label}): {state.fault}")
        return StageState(position, moving, homed, tuple(faults))

    def _start(self, target: Mapping[str, float]) -> None:
        for name, place in target.items():
            self._send_move(name, self._maps[name].to_controller(place))

    def _start_homing(self) -> None:
        for name in self.axis_options:
            self._homed.discard(name)
            self._left.discard(name)
            self._homing[name] = math.inf  # from now on a stop, and what the controller says, are of it
            try:
                self._send_home(name)
            except DeviceError:
                self._homing.pop(name, None)
                raise
            if name in self._homing:
                self._homing[name] = time.monotonic()

    def _came_home(self, name: str, *, moving: bool) -> bool:
        """Whether an axis that was sent home has just come to rest, for controllers that do not tell."""
        began_s = self._homing.get(name)
        if began_s is None:
            return False
        if moving:
            self._left.add(name)
            return False
        if name not in self._left and time.monotonic() - began_s < _LEAVING_S:
            return False
        return self._homing.pop(name, None) is not None  # a stop may have come between


def distinct(places: Mapping[str, object], what: str) -> None:
    """Refuse two axes of the bench that are one of the controller's; ValueError names them."""
    seen: dict[object, str] = {}
    for name, place in places.items():
        if place in seen:
            raise ValueError(f"axes.{name} and axes.{seen[place]} are both {what} {place}")
        seen[place] = name
