"""The keys of a GRBL stage in ``bench.toml``."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.common.stage_axes import MRAD_PER_DEG, UM_PER_MM, AxisMap, AxisName, AxisOptions
from drivers.device import DriverOptions

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
