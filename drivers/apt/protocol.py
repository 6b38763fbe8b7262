"""Messages of Thorlabs' APT protocol (Thorlabs Motion Controllers, Host-Controller Communications Protocol).

A header of six bytes: message number, then either two parameters or the length of the data that follow, then
destination (its highest bit set when data follow) and source. Little endian. There are no checksums: bytes
are taken for a message only when number, length and both ends are right.

Then: which actuators and controllers there are, what a count is, and how far they go.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

HOST = 0x01
RACK = 0x11
BAY_1 = 0x21
USB_UNIT = 0x50
_SOURCES = frozenset({RACK, *range(BAY_1, BAY_1 + 10), USB_UNIT})
# Some firmwares send the messages that nobody asked for from, or to, end point zero.
_ENDS_OF_UNASKED = frozenset({0})

HEADER = struct.Struct("<HBBBB")
_LONG_HEADER = struct.Struct("<HHBB")
_DATA_FOLLOW = 0x80

HW_RESPONSE = 0x0080
HW_RICHRESPONSE = 0x0081
HW_REQ_INFO = 0x0005
HW_GET_INFO = 0x0006
HW_STOP_UPDATEMSGS = 0x0012
RACK_REQ_BAYUSED = 0x0060
RACK_GET_BAYUSED = 0x0061
MOD_SET_CHANENABLESTATE = 0x0210
MOD_REQ_CHANENABLESTATE = 0x0211
MOD_GET_CHANENABLESTATE = 0x0212
MOT_SET_VELPARAMS = 0x0413
MOT_REQ_VELPARAMS = 0x0414
MOT_GET_VELPARAMS = 0x0415
MOT_MOVE_HOME = 0x0443
MOT_MOVE_HOMED = 0x0444
MOT_MOVE_ABSOLUTE = 0x0453
MOT_MOVE_COMPLETED = 0x0464
MOT_MOVE_STOP = 0x0465
MOT_MOVE_STOPPED = 0x0466
MOT_REQ_STATUSUPDATE = 0x0480
MOT_GET_STATUSUPDATE = 0x0481
MOT_REQ_DCSTATUSUPDATE = 0x0490
MOT_GET_DCSTATUSUPDATE = 0x0491
MOT_ACK_DCSTATUSUPDATE = 0x0492
PZMOT_SET_PARAMS = 0x08C0
PZMOT_REQ_PARAMS = 0x08C1
PZMOT_GET_PARAMS = 0x08C2
PZMOT_MOVE_ABSOLUTE = 0x08D4
PZMOT_MOVE_COMPLETED = 0x08D6
PZMOT_REQ_STATUSUPDATE = 0x08E0
PZMOT_GET_STATUSUPDATE = 0x08E1
PZMOT_ACK_STATUSUPDATE = 0x08E2

PZMOT_POSITION = 0x05
PZMOT_DRIVE = 0x07
PZMOT_ENABLED = 0x2B

STOP_AT_ONCE = 0x01
ENABLE, DISABLE = 0x01, 0x02

# Data lengths of what a controller may send; several where they depend on firmware or on what was asked for.
_LENGTHS: dict[int, tuple[int, ...]] = {
    HW_RESPONSE: (0,),
    HW_RICHRESPONSE: (68,),
    HW_GET_INFO: (84,),
    RACK_GET_BAYUSED: (0,),
    MOD_GET_CHANENABLESTATE: (0,),
    MOT_GET_VELPARAMS: (14,),
    MOT_MOVE_HOMED: (0,),
    MOT_MOVE_COMPLETED: (0, 14),
    MOT_MOVE_STOPPED: (0, 14),
    MOT_GET_STATUSUPDATE: (14,),
    MOT_GET_DCSTATUSUPDATE: (14,),
    PZMOT_GET_PARAMS: (4, 12, 14),
    PZMOT_MOVE_COMPLETED: (14,),
    PZMOT_GET_STATUSUPDATE: (56,),
}
_TORN_S = 0.1

MOVING = 0x0000_0010 | 0x0000_0020 | 0x0000_0040 | 0x0000_0080 | 0x0000_0200
HOMED = 0x0000_0400
FAULTS = {
    0x0000_4000: "the position error is too great",
    0x0002_0000: "too hot",
    0x0004_0000: "supply voltage fault",
    0x0008_0000: "commutation error",
    0x0100_0000: "motor current limit reached (blocked?)",
    0x0200_0000: "encoder fault",
    0x0400_0000: "overcurrent",
    0x0800_0000: "supply current fault",
    0x4000_0000: "error",
}
"""Status bits after which a move cannot have ended well."""
NOTES = {
    0x0000_0001: "at its forward limit switch",
    0x0000_0002: "at its reverse limit switch",
    0x0000_0004: "at its forward soft limit",
    0x0000_0008: "at its reverse soft limit",
}


@dataclass(frozen=True, slots=True)
class Message:
    """A message; ``first`` and ``second`` are its parameters, zero where it has data."""

    number: int
    first: int
    second: int
    destination: int
    source: int
    data: bytes = b""

    def encode(self) -> bytes:
        """Return the bytes to send."""
        if self.data:
            ends = (self.destination | _DATA_FOLLOW, self.source)
            return _LONG_HEADER.pack(self.number, len(self.data), *ends) + self.data
        return HEADER.pack(self.number, self.first, self.second, self.destination, self.source)


def short(number: int, destination: int, first: int = 0, second: int = 0) -> bytes:
    """Return a message of the host's without data."""
    return Message(number, first, second, destination, HOST).encode()


def long(number: int, destination: int, layout: str, *values: int | bytes) -> bytes:
    """Return a message of the host's with data."""
    return Message(number, 0, 0, destination, HOST, struct.pack("<" + layout, *values)).encode()


def decode(message: bytes) -> Message:
    """Return a message that the framer cut out."""
    number, first, second, destination, source = HEADER.unpack_from(message)
    data = message[HEADER.size :]
    if destination & _DATA_FOLLOW:
        first = second = 0
    return Message(number, first, second, destination & ~_DATA_FOLLOW, source, data)


class AptFramer:
    """Cuts bytes into messages; bytes that begin none are dropped one by one.

    A message that stops in the middle and goes on later is torn: its rest would come out of the next message,
    and a position be wrong.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._rest = b""
        self._fed_s = 0.0

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they came and return the messages that are whole now."""
        now_s = self._clock()
        if now_s - self._fed_s > _TORN_S:
            self._rest = b""
        self._fed_s = now_s
        self._rest += data
        messages = []
        while len(self._rest) >= HEADER.size:
            length = _message_length(self._rest)
            if length == 0:
                self._rest = self._rest[1:]
            elif len(self._rest) < length:
                break
            else:
                messages.append(self._rest[:length])
                self._rest = self._rest[length:]
        return messages

    def reset(self) -> None:
        """Forget a message that is not whole."""
        self._rest = b""


def _message_length(rest: bytes) -> int:
    """Return the length of the message that begins here, 0 if none can."""
    number, length, destination, source = _LONG_HEADER.unpack_from(rest)
    lengths = _LENGTHS.get(number, ())
    if destination & ~_DATA_FOLLOW not in {HOST, *_ENDS_OF_UNASKED}:
        return 0
    if source not in _SOURCES | _ENDS_OF_UNASKED:
        return 0
    if destination & _DATA_FOLLOW:
        return HEADER.size + length if length and length in lengths else 0
    return HEADER.size if 0 in lengths else 0


def fault_words(bits: int) -> list[str]:
    """Return the faults in status bits, in words, with where the axis stands if it is at an end."""
    faults = [words for bit, words in FAULTS.items() if bits & bit]
    return faults + [words for bit, words in NOTES.items() if bits & bit] if faults else []


# Actuators and controllers: counts a millimetre or degree from the protocol document, "Conversion between
# position, velocity and acceleration values in standard physical units and their equivalent APT parameters";
# travel from the product pages.
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
    "ZST206",
    "ZST213",
    "ZST225",
    "K10CR1",
    "LTS150",
    "LTS300",
    "DDSM50",
    "DDSM100",
    "DDS220",
    "DDS300",
    "DDS600",
]
ControllerName = (
    Literal["KDC101", "TDC001", "BSC201", "BSC202", "BSC203", "KST101", "K10CR1", "LTS", "KIM101"]
    | Literal["KBD101", "BBD201", "BBD202", "BBD203"]
)
Family = Literal["servo", "stepper", "inertia", "brushless"]


@dataclass(frozen=True, slots=True)
class Actuator:
    """``counts``, ``travel`` and ``fastest`` are in millimetres, or in degrees where it turns."""

    family: Family
    counts: float
    travel: float
    turns: bool = False
    fastest: float | None = None
    """Units a second that its motor can do; None where only the controller sets a limit."""
    built_into: ControllerName | None = None
    """The controller that it is one unit with."""


@dataclass(frozen=True, slots=True)
class Controller:
    """``channels`` counts channels of one unit, or bays of a rack."""

    family: Family
    address: int
    channels: int
    serial_prefix: str
    """The first two digits of the serial numbers of this type; empty where they tell no type."""


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
    # 24 steps of 2048 microsteps a turn, a gear of 40.866 and a thread of a millimetre.
    "ZST206": Actuator("stepper", 2_008_645.63, 6),
    "ZST213": Actuator("stepper", 2_008_645.63, 13),
    "ZST225": Actuator("stepper", 2_008_645.63, 25),
    # 200 steps of 2048 microsteps a turn, a gear of 120.
    "K10CR1": Actuator("stepper", 409_600 * 120 / 360, 360, turns=True, built_into="K10CR1"),
    "LTS150": Actuator("stepper", 409_600, 150, built_into="LTS"),
    "LTS300": Actuator("stepper", 409_600, 300, built_into="LTS"),
    "DDSM50": Actuator("brushless", 2000, 50, fastest=500.0),
    "DDSM100": Actuator("brushless", 2000, 100, fastest=500.0),
    "DDS220": Actuator("brushless", 20_000, 220, fastest=300.0),
    "DDS300": Actuator("brushless", 20_000, 300, fastest=400.0),
    "DDS600": Actuator("brushless", 20_000, 600, fastest=400.0),
}

CONTROLLERS: Mapping[ControllerName, Controller] = {
    "KDC101": Controller("servo", USB_UNIT, 1, "27"),
    "TDC001": Controller("servo", USB_UNIT, 1, "83"),
    "BSC201": Controller("stepper", RACK, 1, "40"),
    "BSC202": Controller("stepper", RACK, 2, "50"),
    "BSC203": Controller("stepper", RACK, 3, "70"),
    "KST101": Controller("stepper", USB_UNIT, 1, "26"),
    "K10CR1": Controller("stepper", USB_UNIT, 1, "55"),
    "LTS": Controller("stepper", USB_UNIT, 1, "45"),
    "KIM101": Controller("inertia", USB_UNIT, 4, "97"),
    "KBD101": Controller("brushless", USB_UNIT, 1, "28"),
    "BBD201": Controller("brushless", RACK, 1, ""),
    "BBD202": Controller("brushless", RACK, 2, ""),
    "BBD203": Controller("brushless", RACK, 3, ""),
}


def can_drive(controller: ControllerName, actuator: ActuatorName) -> bool:
    """Whether an actuator's motor suits a controller, and is its own where one is built into the other."""
    units = {found.built_into for found in ACTUATORS.values()}
    wanted = ACTUATORS[actuator]
    owned = wanted.built_into == controller or (wanted.built_into is None and controller not in units)
    return wanted.family == CONTROLLERS[controller].family and owned


SPEED_SCALE: Mapping[Family, float] = {
    "servo": 65_536 * 2048 / 6e6,  # 65536 times the servo's sampling interval, in seconds
    "stepper": 53.68,
    "inertia": 1.0,
    "brushless": 65_536 * 102.4e-6,
}
"""What the controllers call a velocity, over counts a second."""

_LONG = 2**31 - 1

FASTEST_COUNTS_PER_S: Mapping[Family, float] = {
    "servo": _LONG / SPEED_SCALE["servo"],
    "stepper": 50 * 409_600,  # 3000 turns a minute, of 200 steps with 2048 microsteps each
    "inertia": 2000,
    "brushless": _LONG / SPEED_SCALE["brushless"],
}
"""The fastest a controller takes: what its message can hold, or its manual's limit where that is less."""

SLOWEST_COUNTS_PER_S: Mapping[Family, float] = {family: 1 / scale for family, scale in SPEED_SCALE.items()}
"""The slowest speed that is not sent as zero: velocities are whole numbers."""

SETTLING_COUNTS: Mapping[Family, int] = {"servo": 50, "stepper": 1, "inertia": 1, "brushless": 10}
"""How far from its target a move may end; servos hold it within some counts (1.5 um; 5 or 0.5)."""
