"""The motion stage interface."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from drivers.device import Device, Setting
from drivers.errors import DeviceError


@dataclass(frozen=True, slots=True)
class StageAxis:
    """One axis of a stage.

    ``name`` ends in the axis' unit: ``x_um``, ``y_um``, ``z_um``, ``roll_mrad``, ``pitch_mrad``,
    ``yaw_mrad``.
    The limits are soft limits in that unit; speed is in units a second; ``resolution`` is the smallest step.
    """

    name: str
    lower_limit: float
    upper_limit: float
    speed_per_s: float
    resolution: float

    @property
    def unit(self) -> str:
        """The part of the name after the last underscore."""
        return self.name.rsplit("_", 1)[-1]


OVER = 1.5
"""So many times its play an axis goes below a place before it comes up to it."""


def approached(
    here: Mapping[str, float],
    target: Mapping[str, float],
    play: Mapping[str, float],
    seated: Collection[str] = (),
) -> list[dict[str, float]]:
    """Return the moves that end at a target with every axis that has play going upwards.

    A nut that trails its screw is then always on the same side of it. One move where every axis goes up far
    enough, else one to below and one to the target.

    Parameters
    ----------
    here, target : mapping of axis name to position
    play : mapping of axis name to play, in the axis' unit
        Axes that are left out have none.
    seated : collection of axis names
        Those that came to where they are upwards.
    """
    below = {}
    for name, value in target.items():
        way = OVER * play.get(name, 0.0)
        least = 0.0 if name in seated else way
        if way > 0 and value - here.get(name, value) < least:
            below[name] = value - way
    return [{**target, **below}, dict(target)] if below else [dict(target)]


class Stage(Device):
    """A motion stage of one to six axes.

    Positions are in the units that the axis names end in. A target outside the soft limits raises
    :class:`~drivers.errors.LimitError` that names every offending axis, and nothing moves: no move is ever
    clipped. ``stop`` may be called from any thread at any time, overtakes a running move and makes the
    call that waits for it raise :class:`~drivers.errors.StoppedError`.
    """

    @property
    @abstractmethod
    def axes(self) -> tuple[StageAxis, ...]:
        """The stage's axes."""

    @abstractmethod
    def position(self) -> dict[str, float]:
        """Where the stage says it is, by axis name."""

    @abstractmethod
    def home(self) -> None:
        """Find the reference of every axis; blocks until done."""

    @property
    @abstractmethod
    def is_homed(self) -> bool:
        """Whether positions refer to a known reference."""

    @property
    def needs_unlocking(self) -> bool:
        """Whether an alarm holds it that nothing but ``unlock`` ends; known from its last report."""
        return False

    def unlock(self) -> None:
        """End an alarm that no homing ends; somebody has looked what it was for. Positions are lost with it.

        Raises DeviceError where there is no such thing.
        """
        raise DeviceError(self.name, "has no lock that an alarm leaves.", "Home it.")

    @abstractmethod
    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        """Move the named axes to absolute positions; the others stay.

        Parameters
        ----------
        target : mapping of axis name to position
        wait : bool
            Block until the move has ended.

        Returns
        -------
        dict
            The position reached (or, without waiting, the position as the move starts).

        Raises LimitError when any target is outside its soft limits or no finite number, an axis is unknown,
        or the stage is not homed; StoppedError when ``stop`` ended the move.
        """

    def move_by(self, delta: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        """Move the named axes by the given amounts from the commanded position; errors as ``move_to``."""
        here = self.commanded_position()
        return self.move_to({axis: here.get(axis, 0.0) + step for axis, step in delta.items()}, wait=wait)

    @abstractmethod
    def commanded_position(self) -> dict[str, float]:
        """Return the last target asked for (after ``stop`` or ``home``: where the stage says it is)."""

    @property
    @abstractmethod
    def is_moving(self) -> bool:
        """Whether any axis moves."""

    @abstractmethod
    def wait(self, timeout_s: float | None = None) -> None:
        """Block until a running move has ended; errors as ``move_to``."""

    @abstractmethod
    def stop(self) -> None:
        """Stop every axis at once. Callable from any thread; without a move it does nothing."""

    def settles_within(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may come to rest, in its unit."""
        return 3 * axis.resolution

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Soft limits by axis name."""
        return {axis.name: (axis.lower_limit, axis.upper_limit) for axis in self.axes}

    def _common_settings(self, position: Mapping[str, float]) -> dict[str, Setting]:
        """Return what every stage's settings say of its axes, for drivers."""
        settings: dict[str, Setting] = {}
        for axis in self.axes:
            settings[f"position_{axis.name}"] = position[axis.name]
            settings[f"limits_{axis.name}"] = (axis.lower_limit, axis.upper_limit)
            settings[f"speed_{axis.name}_per_s"] = axis.speed_per_s
        return settings

    def _acceleration_per_s2(self, name: str) -> float:
        """Return an axis' acceleration in units a second squared; infinite where it is not known."""
        return math.inf

    def move_duration_s(self, start: Mapping[str, float], target: Mapping[str, float]) -> float:
        """Estimated seconds for a move; axes move together, so the slowest counts."""
        durations = (
            trapezoid_duration_s(
                target[axis.name] - start[axis.name], axis.speed_per_s, self._acceleration_per_s2(axis.name)
            )
            for axis in self.axes
            if axis.name in start and axis.name in target
        )
        return max(durations, default=0.0)


def trapezoid_duration_s(distance: float, speed: float, acceleration: float) -> float:
    """Seconds that a move takes from rest to rest."""
    distance = abs(distance)
    ramp = speed**2 / acceleration
    if distance < ramp:
        return 2 * math.sqrt(distance / acceleration)
    return distance / speed + speed / acceleration
