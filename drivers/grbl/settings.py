"""A GRBL stage's keys in ``bench.toml``, and its controller's ``$$`` settings as the stage needs them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.common.stage_axes import MRAD_PER_DEG, UM_PER_MM, AxisMap, AxisName, AxisOptions
from drivers.device import DriverOptions
from drivers.errors import DeviceError

_USUAL_LETTERS = {
    "x_um": "X",
    "y_um": "Y",
    "z_um": "Z",
    "roll_mrad": "A",
    "pitch_mrad": "B",
    "yaw_mrad": "C",
}


class GrblAxis(AxisOptions):
    """One axis of a GRBL controller, in the unit its name ends in."""

    letter: Literal["X", "Y", "Z", "A", "B", "C", "U", "V", "W", ""] = Field(
        "", description="The controller's axis; left out: X, Y, Z for shifts, A, B, C for rotations."
    )
    scale: float | None = Field(
        None,
        gt=0,
        description=(
            "Bench units in one unit of the controller; left out: 1000 (um in a mm) for shifts, 17.4533 "
            "(mrad in a degree) for rotations."
        ),
    )
    speed_per_s: float | None = Field(
        None, gt=0, description="Speed of moves, units a second; left out: the controller's maximum."
    )

    def axis_map(self, name: str) -> AxisMap:
        """Return how the controller's unit becomes the bench's."""
        scale = self.scale or (UM_PER_MM if name.endswith("_um") else MRAD_PER_DEG)
        letter = self.letter or _USUAL_LETTERS[name]
        return AxisMap(name, f"axis {letter}", -scale if self.reverse else scale)


class GrblOptions(DriverOptions):
    """A stage on a GRBL 1.1 or grblHAL controller."""

    port: str = Field(min_length=1, description='Serial port, e.g. "/dev/ttyUSB0".')
    baud_rate: int = Field(115_200, ge=9600, description="115200 unless the firmware was built otherwise.")
    homing: Literal["switches", "here"] = Field(
        "switches",
        description=(
            '"switches": homing runs to the limit switches; "here": the stage has none, and homing takes '
            "where it stands for zero on every axis (limits must be given then)."
        ),
    )
    homing_timeout_s: float = Field(120.0, gt=0, description="Longest time that homing may take.")
    axes: dict[AxisName, GrblAxis] = Field(
        default_factory=lambda: {name: GrblAxis.model_validate({}) for name in ("x_um", "y_um", "z_um")},
        min_length=1,
        description="[stage.axes.x_um] and so on: which axis is which; left out: X, Y and Z.",
    )

    @model_validator(mode="after")
    def _axes_make_sense(self) -> Self:
        labels: dict[str, str] = {}
        for name, axis in self.axes.items():
            label = axis.axis_map(name).label
            if label in labels:
                raise ValueError(f"axes.{name} and axes.{labels[label]} are both {label}")
            labels[label] = name
            if self.homing == "here" and (axis.lower_limit is None or axis.upper_limit is None):
                raise ValueError(f'axes.{name} needs lower_limit and upper_limit with homing = "here"')
        return self


REPORTED_STEP = 0.001
"""Reports show thousandths of a millimetre or degree."""
_INCHES, _SOFT_LIMITS, _HARD_LIMITS, _HOMING, _HOMING_TOWARDS_NEGATIVE, _PULL_OFF = 13, 20, 21, 22, 23, 27
_STEPS, _RATE, _ACCELERATION, _TRAVEL, _BACKLASH = 100, 110, 120, 130, 160
_HAL_ORIGIN_AT_SWITCH = 8
AXIS_LETTERS = "XYZABCUVW"


@dataclass(frozen=True)
class ControllerSettings:
    """Settings, and what they mean for an axis.

    Attributes
    ----------
    values : mapping of int to float
        By number, as ``$$`` lists them.
    info : mapping of str to str
        Entries of ``$I``.
    """

    values: Mapping[int, float]
    info: Mapping[str, str]

    @property
    def is_hal(self) -> bool:
        """Whether the firmware is grblHAL."""
        return "grblhal" in " ".join((self.info.get("FIRMWARE", ""), self.info.get("VER", ""))).lower()

    @property
    def letters(self) -> str:
        """The axes' letters, in the order of reports; those beyond what a report holds mean nothing."""
        letters = self.info.get("AXS", "").partition(":")[2]
        return letters if letters.isalpha() else AXIS_LETTERS

    @property
    def reports_inches(self) -> bool:
        """Whether positions are reported in inches."""
        return bool(self.values.get(_INCHES, 0))

    @property
    def soft_limits(self) -> bool:
        """Whether the controller itself refuses targets beyond its travel."""
        return bool(self.values.get(_SOFT_LIMITS, 0))

    @property
    def hard_limits(self) -> bool:
        """Whether limit switches stop it."""
        return bool(int(self.values.get(_HARD_LIMITS, 0)) & 1)

    @property
    def homing(self) -> bool:
        """Whether it can home."""
        return bool(int(self.values.get(_HOMING, 0)) & 1)

    @property
    def origin_at_switch(self) -> bool:
        """Whether homing ends at zero, rather than at the travel's end."""
        if self.is_hal:
            return bool(int(self.values.get(_HOMING, 0)) & _HAL_ORIGIN_AT_SWITCH)
        return "Z" in self.info.get("OPT", "").partition(",")[0]

    def steps_per_unit(self, axis: int) -> float:
        """Return the steps in a millimetre (a degree of a rotary axis)."""
        return self.values[_STEPS + axis]

    def rate_per_s(self, axis: int) -> float:
        """Return the highest speed, units a second."""
        return self.values[_RATE + axis] / 60

    def acceleration_per_s2(self, axis: int) -> float:
        """Return the acceleration, units a second squared."""
        return self.values[_ACCELERATION + axis]

    def backlash(self, axis: int) -> float | None:
        """Return the play that grblHAL compensates, units; None where it does not."""
        return self.values.get(_BACKLASH + axis) if self.is_hal else None

    def travel(self, axis: int) -> tuple[float, float]:
        """Return the range of machine positions, lowest and highest.

        GRBL counts from zero at the positive end downwards, wherever its switches are; with the origin at
        the switch, upwards when it homes towards negative. Where switches stop it, the place of the switch
        itself is left out.
        """
        length = abs(self.values[_TRAVEL + axis])
        negative = bool(int(self.values.get(_HOMING_TOWARDS_NEGATIVE, 0)) >> axis & 1)
        if self.origin_at_switch:
            return (0.0, length) if negative else (-length, 0.0)
        margin = self.values.get(_PULL_OFF, 0.0) if self.hard_limits and self.homing else 0.0
        return (margin - length, 0.0) if negative else (-length, -margin)

    def check(self, device: str, axes: int) -> None:
        """Refuse settings under which positions would be wrong.

        Parameters
        ----------
        device : str
            The stage as error messages name it.
        axes : int
            Number of axes in the controller's reports.

        Raises DeviceError when settings of an axis are missing or make no sense, or positions come in inches.
        """
        for axis in range(axes):
            for base, what in (
                (_STEPS, "steps per mm"),
                (_RATE, "maximum rate"),
                (_ACCELERATION, "acceleration"),
                (_TRAVEL, "travel"),
            ):
                value = self.values.get(base + axis)
                if not value:
                    raise DeviceError(
                        device,
                        f"says ${base + axis} ({what} of axis {self.letters[axis]}) is "
                        f"{'missing' if value is None else f'{value:g}'}.",
                        f"Set it: send ${base + axis}=VALUE to the controller.",
                    )
        if self.reports_inches:
            raise DeviceError(device, "reports inches ($13=1).", "Send $13=0 to the controller.")
