"""Actuators and controllers of Thorlabs': what a count is, and how far they go.

Counts a millimetre or degree from the protocol document, "Conversion between position, velocity and
acceleration values in standard physical units and their equivalent APT parameters"; travel from the product
pages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from drivers.apt.protocol import RACK, USB_UNIT

ActuatorName = Literal[
    "MTS25-Z8",
    "MTS50-Z8",
    "Z806",
    "Z812",
    "Z825",
    "PRM1-Z8",
    "DRV001",
    "DRV225",
    "DRV250",
    "NRT100",
    "NRT150",
]
ControllerName = Literal["KDC101", "TDC001", "BSC201", "BSC202", "BSC203", "KIM101"]
Family = Literal["servo", "stepper", "inertia"]


@dataclass(frozen=True, slots=True)
class Actuator:
    """``counts``, ``travel`` and ``fastest`` are in millimetres, or in degrees where it turns."""

    family: Family
    counts: float
    travel: float
    turns: bool = False
    fastest: float | None = None
    """Units a second that its motor can do; None where only the controller sets a limit."""


@dataclass(frozen=True, slots=True)
class Controller:
    """``channels`` counts channels of one unit, or bays of a rack."""

    family: Family
    address: int
    channels: int
    serial_prefix: str
    """The first two digits of the serial numbers of this type."""


Z8_MM_PER_S = 3.0
"""The product pages say 2.4 to 2.6 mm/s; motors differ a little, and a speed that works is not refused."""

ACTUATORS: Mapping[ActuatorName, Actuator] = {
    "MTS25-Z8": Actuator("servo", 34_304, 25, fastest=Z8_MM_PER_S),
    "MTS50-Z8": Actuator("servo", 34_304, 50, fastest=Z8_MM_PER_S),
    "Z806": Actuator("servo", 34_304, 6, fastest=Z8_MM_PER_S),
    "Z812": Actuator("servo", 34_304, 12, fastest=Z8_MM_PER_S),
    "Z825": Actuator("servo", 34_304, 25, fastest=Z8_MM_PER_S),
    "PRM1-Z8": Actuator("servo", 1919.64186, 360, turns=True, fastest=25.0),
    "DRV001": Actuator("stepper", 819_200, 8),
    "DRV225": Actuator("stepper", 409_600, 25),
    "DRV250": Actuator("stepper", 409_600, 50),
    "NRT100": Actuator("stepper", 409_600, 100),
    "NRT150": Actuator("stepper", 409_600, 150),
}

CONTROLLERS: Mapping[ControllerName, Controller] = {
    "KDC101": Controller("servo", USB_UNIT, 1, "27"),
    "TDC001": Controller("servo", USB_UNIT, 1, "83"),
    "BSC201": Controller("stepper", RACK, 1, "40"),
    "BSC202": Controller("stepper", RACK, 2, "50"),
    "BSC203": Controller("stepper", RACK, 3, "70"),
    "KIM101": Controller("inertia", USB_UNIT, 4, "97"),
}

SPEED_SCALE: Mapping[Family, float] = {
    "servo": 65_536 * 2048 / 6e6,  # 65536 times the servo's sampling interval, in seconds
    "stepper": 53.68,
    "inertia": 1.0,
}
"""What the controllers call a velocity, over counts a second."""

_LONG = 2**31 - 1

FASTEST_COUNTS_PER_S: Mapping[Family, float] = {
    "servo": _LONG / SPEED_SCALE["servo"],
    "stepper": 50 * 409_600,  # 3000 turns a minute, of 200 steps with 2048 microsteps each
    "inertia": 2000,
}
"""The fastest a controller takes: what its message can hold, or its manual's limit where that is less."""

SLOWEST_COUNTS_PER_S: Mapping[Family, float] = {family: 1 / scale for family, scale in SPEED_SCALE.items()}
"""The slowest speed that is not sent as zero: velocities are whole numbers."""

SETTLING_COUNTS: Mapping[Family, int] = {"servo": 50, "stepper": 1, "inertia": 1}
"""How far from its target a move may end; a servo holds its place within some of its counts (1.5 um)."""
