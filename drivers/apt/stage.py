"""A stage of Thorlabs actuators: one axis a channel, on one or several controllers."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Self

from pydantic import Field, model_validator

from drivers.apt.drives import Drive, InertiaChannel, InertiaUnit, Motor
from drivers.apt.link import Link
from drivers.apt.protocol import (
    ACTUATORS,
    CONTROLLERS,
    FASTEST_COUNTS_PER_S,
    SETTLING_COUNTS,
    SLOWEST_COUNTS_PER_S,
    ActuatorName,
    ControllerName,
    can_drive,
)
from drivers.common.polled_stage import PolledStage, StageState
from drivers.common.stage_axes import MRAD_PER_DEG, UM_PER_MM, AxisMap, AxisName, AxisOptions
from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, SharedPart, port_claim
from drivers.errors import DeviceError
from drivers.registry.buses import lasting_name, serial_ports
from drivers.stage import StageAxis


class AptAxis(AxisOptions):
    """One axis: a controller's channel and the actuator on it, in the unit its name ends in."""

    port: str = Field(min_length=1, description='Serial port of its controller, e.g. "/dev/ttyUSB0".')
    controller: ControllerName = Field(description="Type of the controller.")
    channel: int = Field(1, ge=1, le=4, description="Channel of a KIM101, bay of a BSC20x or BBD20x, from 1.")
    actuator: ActuatorName | None = Field(None, description="Type of the actuator; or say what a count is.")
    counts_per_mm: float | None = Field(
        None, gt=0, description="Encoder counts, microsteps or steps a millimetre of an actuator not listed."
    )
    counts_per_deg: float | None = Field(
        None, gt=0, description="The same a degree, of a rotary actuator not listed."
    )
    speed_per_s: float | None = Field(
        None, gt=0, description="Speed of moves, units a second; left out: as set in the controller."
    )

    @property
    def counts(self) -> float:
        """Counts a millimetre, or a degree where the actuator turns."""
        if self.actuator is not None:
            return ACTUATORS[self.actuator].counts
        return self.counts_per_mm or self.counts_per_deg or 0.0

    @property
    def turns(self) -> bool:
        """Whether the actuator turns."""
        return ACTUATORS[self.actuator].turns if self.actuator else self.counts_per_deg is not None

    def axis_map(self, name: str) -> AxisMap:
        """Return how counts become the bench's unit."""
        size = (MRAD_PER_DEG if self.turns else UM_PER_MM) / self.counts
        label = f"{self.controller} on {self.port}" + (f" channel {self.channel}" if self.channel > 1 else "")
        return AxisMap(name, label, -size if self.reverse else size)

    def ends(self, name: str) -> tuple[float, float]:
        """Return how far the actuator goes, in counts."""
        if self.actuator is not None:
            return 0.0, ACTUATORS[self.actuator].travel * self.counts
        low, high = sorted(self.axis_map(name).to_controller(end or 0.0) for end in self._soft)
        return low, high

    @property
    def _soft(self) -> tuple[float | None, float | None]:
        return self.lower_limit, self.upper_limit

    def mistake(self, name: str) -> str:
        """Return what does not go together, empty if all does."""
        controller, given = (
            CONTROLLERS[self.controller],
            (self.actuator, self.counts_per_mm, self.counts_per_deg),
        )
        if sum(value is not None for value in given) != 1:
            return "needs one of actuator, counts_per_mm and counts_per_deg"
        if self.actuator and not can_drive(self.controller, self.actuator):
            return f"a {self.controller} cannot drive a {self.actuator}"
        if self.turns == name.endswith("_um"):
            return f"an actuator that {'turns' if self.turns else 'shifts'} cannot be {name}"
        if self.actuator is None and None in self._soft:
            return "needs lower_limit and upper_limit: neither controller nor driver knows the travel"
        if self.channel > controller.channels:
            return f"a {self.controller} has {controller.channels} channel{'s' * (controller.channels > 1)}"
        return self._speed_mistake(name)

    def _speed_mistake(self, name: str) -> str:
        """Return why the speed cannot be sent, empty if it can: the message holds a whole number."""
        if self.speed_per_s is None:
            return ""
        family, size = CONTROLLERS[self.controller].family, abs(self.axis_map(name).scale)
        slowest, fastest = SLOWEST_COUNTS_PER_S[family] * size, FASTEST_COUNTS_PER_S[family] * size
        whose: str = self.controller
        motor = ACTUATORS[self.actuator].fastest if self.actuator else None
        if motor is not None and motor * self.counts * size < fastest:
            fastest, whose = motor * self.counts * size, f"{self.actuator} on a {self.controller}"
        if slowest <= self.speed_per_s <= fastest:
            return ""
        return (
            f"speed_per_s = {self.speed_per_s:g}: a {whose} moves at {slowest:.3g} to {fastest:.4g} "
            f"{name.rpartition('_')[2]} a second"
        )


class AptOptions(DriverOptions):
    """Thorlabs controllers over the APT protocol, each on its own port."""

    axes: dict[AxisName, AptAxis] = Field(
        min_length=1, description="[stage.axes.x_um] and so on: which channel of which controller is which."
    )

    @model_validator(mode="after")
    def _axes_make_sense(self) -> Self:
        channels: dict[tuple[str, int], str] = {}
        controllers: dict[str, str] = {}
        for name, axis in self.axes.items():
            if mistake := axis.mistake(name):
                raise ValueError(f"axes.{name}: {mistake}")
            if (other := channels.setdefault((axis.port, axis.channel), name)) != name:
                raise ValueError(
                    f"axes.{name} and axes.{other} are both channel {axis.channel} of {axis.port}"
                )
            if controllers.setdefault(axis.port, axis.controller) != axis.controller:
                raise ValueError(f"axes.{name}: {axis.port} is a {controllers[axis.port]} in another axis")
        return self


_log = logging.getLogger(__name__)
_THORLABS_USB = "0403:faf0"
_SPEED_TOLERANCE = 0.01


class AptStage(PolledStage):
    """Axes on KDC101, TDC001, BSC20x, KST101, KBD101, BBD20x, KIM101, K10CR1 and LTS, moved together.

    Each controller has a port of its own. Limits are the actuator's travel, narrowed by ``bench.toml``: these
    controllers do not know it. An axis of a KIM101 has no reference; homing calls the present place zero, and
    of its channels one moves at a time.
    """

    Options = AptOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = options = AptOptions.of(options)
        self._maps = {name: axis.axis_map(name) for name, axis in options.axes.items()}
        controllers = {axis.port: axis.controller for axis in options.axes.values()}
        self._links = {port: Link(port, self.name, name) for port, name in controllers.items()}
        units = {port: InertiaUnit(link) for port, link in self._links.items()}
        self._drives: dict[str, Drive] = {
            name: InertiaChannel(units[axis.port], axis.channel)
            if CONTROLLERS[axis.controller].family == "inertia"
            else Motor(self._links[axis.port], axis.channel)
            for name, axis in options.axes.items()
        }

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the ports of all controllers."""
        return tuple(sorted({port_claim(axis.port) for axis in AptOptions.of(options).axes.values()}))

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the serial ports whose USB device is one of the controllers, by vendor and serial number."""
        found = []
        for port in serial_ports():
            name = next(
                (
                    n
                    for n, c in CONTROLLERS.items()
                    if c.serial_prefix and port.serial_number.startswith(c.serial_prefix)
                ),
                None,
            )
            if port.usb_id != _THORLABS_USB or name is None:
                continue
            # No controller knows its actuator: checking bench.toml will ask for it.
            axes = {"x_um": {"port": lasting_name(port.address), "controller": name, "actuator": "WHICH?"}}
            found.append(
                replace(
                    port,
                    description=f"Thorlabs {name}",
                    vendor="Thorlabs",
                    product=name,
                    driver="apt",
                    kind="stage",
                    options={"axes": axes},
                    note="fill in actuator: the type on its label, such as Z825",
                )
            )
        return tuple(found)

    @property
    def name(self) -> str:
        """The stage as error messages name it."""
        ports = dict.fromkeys(axis.port for axis in self.options.axes.values())
        return f"stage (apt, {', '.join(ports)})"

    @property
    def is_open(self) -> bool:
        """Whether any controller is connected, so that its axes are stopped when another was lost."""
        return self._identity is not None and any(link.is_open for link in self._links.values())

    # The protocol ----------------------------------------------------------------------------------
    @property
    def _is_connected(self) -> bool:
        return all(link.is_open for link in self._links.values())

    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        for link in self._links.values():
            link.open()
        infos = [link.info() for link in self._links.values()]
        axes = tuple(self._axis(name, axis) for name, axis in self.options.axes.items())
        identity = DeviceIdentity(
            kind="stage",
            driver="apt",
            vendor="Thorlabs",
            model=" + ".join(info.model for info in infos),
            serial_number=" + ".join(info.serial_number for info in infos),
            firmware=" + ".join(info.firmware for info in infos),
            simulated=False,
        )
        return identity, axes

    def _disconnect(self) -> None:
        for link in self._links.values():
            link.close()

    def _axis(self, name: str, axis: AptAxis) -> StageAxis:
        drive, scale = self._drives[name], abs(self._maps[name].scale)
        drive.prepare()
        if axis.speed_per_s is not None:
            drive.set_speed(axis.speed_per_s / scale)
        speed = drive.speed()
        if axis.speed_per_s and not math.isclose(speed * scale, axis.speed_per_s, rel_tol=_SPEED_TOLERANCE):
            _log.warning(
                "%s: %s moves at %g a second, not at the %g of bench.toml: its controller decided",
                self.name, name, speed * scale, axis.speed_per_s,
            )  # fmt: skip
        if not speed > 0:
            raise DeviceError(
                self.name,
                f"{name} ({self._maps[name].label}) has no speed set.",
                f"Set speed_per_s in [stage.axes.{name}].",
            )
        return self._maps[name].stage_axis(
            self.name, axis, ends=axis.ends(name), speed_per_s=speed, resolution=1.0
        )

    def _state(self) -> StageState:
        position, moving, homed, faults = {}, False, True, []
        for name, drive in self._drives.items():
            state = drive.state()
            position[name] = self._maps[name].to_bench(state.counts)
            moving |= state.moving
            homed &= state.homed
            if state.faults:
                faults.append(f"{name} ({self._maps[name].label}): {', '.join(state.faults)}")
        for link in self._links.values():
            link.raise_complaint()
        return StageState(position, moving, homed, tuple(faults))

    def _start(self, target: Mapping[str, float]) -> None:
        for name, place in target.items():
            self._drives[name].move(math.floor(self._maps[name].to_controller(place) + 0.5))

    def _start_homing(self) -> None:
        for drive in self._drives.values():
            drive.home()

    def _halt(self) -> None:
        errors = []
        for drive in self._drives.values():
            try:
                drive.stop()
            except DeviceError as error:  # the others must be stopped all the same
                errors.append(error)
        if errors:
            raise errors[0]

    def _tolerance(self, axis: StageAxis) -> float:
        family = CONTROLLERS[self.options.axes[axis.name].controller].family
        return (SETTLING_COUNTS[family] + 0.01) * axis.resolution
