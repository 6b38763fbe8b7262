"""What ``bench.toml`` says of a stage of Thorlabs actuators."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from drivers.apt.actuators import (
    ACTUATORS,
    CONTROLLERS,
    FASTEST_COUNTS_PER_S,
    SLOWEST_COUNTS_PER_S,
    ActuatorName,
    ControllerName,
)
from drivers.common.stage_axes import MRAD_PER_DEG, UM_PER_MM, AxisMap, AxisName, AxisOptions
from drivers.device import DriverOptions


class AptAxis(AxisOptions):
    """One axis: a controller's channel and the actuator on it, in the unit its name ends in."""

    port: str = Field(min_length=1, description='Serial port of its controller, e.g. "/dev/ttyUSB0".')
    controller: ControllerName = Field(description="Type of the controller.")
    channel: int = Field(1, ge=1, le=4, description="Channel of a KIM101, bay of a BSC20x, counted from 1.")
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
        if self.actuator and ACTUATORS[self.actuator].family != controller.family:
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
