"""How the axes of a motion controller are axes of the bench: names, units, directions and limits.

A controller counts in units of its own (microsteps, encoder counts, millimetres); the bench's axes are in the
unit that their name ends in. What is said here once: which names there are, how the two convert, that the
soft limits of ``bench.toml`` lie within the controller's own, and how a target beyond them is refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from drivers.errors import LimitError
from drivers.stage import StageAxis

AXIS_NAMES = ("x_um", "y_um", "z_um", "roll_mrad", "pitch_mrad", "yaw_mrad")
"""The axes that a bench knows: three shifts and the three rotations about x, y and z."""

UM_PER_MM = 1e3
MRAD_PER_DEG = 1e3 * math.pi / 180


def _axis_name(name: str) -> str:
    if name not in AXIS_NAMES:
        raise ValueError(f"must be an axis of the bench ({', '.join(AXIS_NAMES)})")
    return name


AxisName = Annotated[str, AfterValidator(_axis_name)]
"""A key or value in ``bench.toml`` that names an axis of the bench."""


class AxisOptions(BaseModel):
    """One axis, in the unit its name ends in."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    reverse: bool = Field(False, description="Whether the bench counts against the controller's direction.")
    lower_limit: float | None = Field(
        None, description="Lower soft limit, within the controller's own; left out: the controller's."
    )
    upper_limit: float | None = Field(
        None, description="Upper soft limit, within the controller's own; left out: the controller's."
    )

    @field_validator("upper_limit")
    @classmethod
    def _above_the_lower(cls, upper: float | None, info: ValidationInfo) -> float | None:
        lower = info.data.get("lower_limit")
        if upper is not None and lower is not None and not lower < upper:
            raise ValueError(f"must be above lower_limit = {lower:g}")
        return upper


@dataclass(frozen=True, slots=True)
class AxisMap:
    """One axis of a controller as an axis of the bench.

    Attributes
    ----------
    name : str
        As the bench calls it, e.g. ``"x_um"``.
    label : str
        As its controller calls it, for messages: ``"axis X"``, ``"device 1 axis 2"``.
    scale : float
        Bench units in one unit of the controller; negative where the two count in opposite directions.
    """

    name: str
    label: str
    scale: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale):
            raise ValueError(f"{self.label} as {self.name}: {self.scale} is no scale.")

    def to_bench(self, value: float) -> float:
        """Return a position of the controller's in the bench's unit."""
        return value * self.scale + 0.0  # no -0.0 of a reversed axis, which reads as if it meant something

    def to_controller(self, value: float) -> float:
        """Return a position of the bench in the controller's unit; whoever counts in steps rounds it."""
        return value / self.scale

    def stage_axis(
        self,
        device: str,
        options: AxisOptions,
        *,
        ends: tuple[float, float],
        speed_per_s: float,
        resolution: float,
    ) -> StageAxis:
        """Return the bench's axis, with the limits of ``options`` where they narrow the controller's.

        Parameters
        ----------
        device : str
            The stage as error messages name it.
        options : AxisOptions
        ends : (float, float)
            Where the controller lets the axis go, in the controller's unit, in any order.
        speed_per_s, resolution : float
            In the controller's unit; their signs do not matter.

        Raises LimitError when a soft limit lies outside the controller's range (it would be no limit), or
        nothing is left between the two.
        """
        low, high = sorted(self.to_bench(end) for end in ends)
        soft_low = low if options.lower_limit is None else options.lower_limit
        soft_high = high if options.upper_limit is None else options.upper_limit
        step = abs(self.scale * resolution)
        if soft_low < low - step or soft_high > high + step:
            raise LimitError(
                device,
                f"{self.name} ({self.label}): the soft limits {soft_low:g} to {soft_high:g} reach beyond the "
                f"controller's own, {low:g} to {high:g}.",
                "Narrow them in bench.toml, or set the controller's.",
            )
        soft_low, soft_high = max(soft_low, low), min(soft_high, high)
        if not soft_low < soft_high:
            raise LimitError(
                device,
                f"{self.name} ({self.label}): no range is left between {soft_low:g} and {soft_high:g}.",
                f"The controller allows {low:g} to {high:g}; set lower_limit below upper_limit within it.",
            )
        return StageAxis(self.name, soft_low, soft_high, abs(self.scale * speed_per_s), step)


def check_target(device: str, axes: Iterable[StageAxis], target: Mapping[str, float], homed: bool) -> None:
    """Refuse a move that a stage must not make, whole and before anything moves.

    Parameters
    ----------
    device : str
        The stage as error messages name it.
    axes : iterable of StageAxis
    target : mapping of axis name to position
    homed : bool
        Whether the stage's positions mean anything.

    Raises LimitError: naming every axis that is unknown, whose target is no finite number, or lies outside
    its limits.
    """
    if not homed:
        raise LimitError(device, "is not homed: its positions mean nothing yet.", "Home it first.")
    limits = {axis.name: (axis.lower_limit, axis.upper_limit) for axis in axes}
    wrong = []
    for name, position in target.items():
        if name not in limits:
            wrong.append(f"it has no axis {name} (it has {', '.join(limits)})")
        elif not math.isfinite(position):
            wrong.append(f"{name} = {position} is no position")
        elif not limits[name][0] <= position <= limits[name][1]:
            low, high = limits[name]
            wrong.append(f"{name} = {position:g} lies outside {low:g} to {high:g}")
    if wrong:
        raise LimitError(device, f"refuses the move: {'; '.join(wrong)}.", "Nothing moved.")
