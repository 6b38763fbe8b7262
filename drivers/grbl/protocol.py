"""What GRBL and grblHAL say, and what it means: pure functions of bytes.

The protocol's documents are the GRBL 1.1 wiki (Interface, Commands, Jogging, Configuration) and grblHAL's.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from drivers.common.framing import Belongs, Matcher, reply_between, reply_until

STATUS = b"?"
JOG_CANCEL = b"\x85"
FEED_HOLD = b"!"
SOFT_RESET = b"\x18"

MOVING_STATES = frozenset({"Jog", "Run", "Home", "Hold:1", "Door:2", "Door:3"})
"""States in which axes may be moving; ``Hold:1`` and ``Door:2`` still slow down."""

_NUMBER = rb"-?\d{1,7}(?:\.\d{1,6})?"
_REPORT = re.compile(rb"<([A-Za-z]{2,10})(?::(\d{1,3}))?((?:\|[^|<>]*)*)>")
_PLACES = re.compile(rb"%s(?:,%s){0,8}" % (_NUMBER, _NUMBER))
_SETTING = re.compile(rb"\$(\d{1,5})=(%s)(?:[ (].*)?" % _NUMBER)
_ERROR = re.compile(rb"error:(\d{1,3})")
_ALARM = re.compile(rb"ALARM:(\d{1,3})")
_BANNER = re.compile(rb"Grbl(?:HAL)? \d.*", re.IGNORECASE)
_INFO = re.compile(rb"\[([A-Z][A-Z ]{1,20}):([^\]]*)\]")

ALARMS = {
    1: "a limit switch was hit: the axis stopped at once and its place is lost",
    2: "a target lay outside the controller's own soft limits",
    3: "the controller was reset while it moved: steps may be lost",
    4: "the probe was not in its initial state",
    5: "the probe touched nothing",
    6: "homing was interrupted by a reset",
    7: "the safety door was opened during homing",
    8: "homing could not move clear of a limit switch (pull-off $27 too short, or a switch stuck)",
    9: "homing found no limit switch (axis blocked, switch or wire broken, travel $130 too short)",
    10: "the emergency stop is pressed",
    11: "homing is required",
    12: "a limit switch is pressed already",
    13: "the probe protection tripped",
    14: "the spindle did not answer",
    15: "homing found no second limit switch (auto squaring)",
    16: "the controller's self test failed",
    17: "a motor driver reports a fault",
    18: "homing failed",
}
"""Alarm codes: 1 to 9 are GRBL's, the others grblHAL's."""

CRITICAL_ALARMS = frozenset({1, 2, 10})
"""After these the controller answers nothing until it is reset."""

ERRORS = {
    1: "a letter was expected",
    2: "a number is malformed",
    3: "the command is unknown",
    5: "homing is not enabled ($22)",
    8: "it takes this only when idle",
    9: "it is locked (alarm, or moving): home first",
    10: "soft limits need homing ($22)",
    11: "the line is too long",
    13: "the safety door is open",
    14: "the line is too long to be kept",
    15: "the target lies outside the controller's travel ($130 and on)",
    16: "it does not take this as a jog",
    20: "it does not know this G-code (an axis it does not have?)",
    33: "the target is invalid",
    45: "a limit switch is pressed",
    46: "homing is required",
    50: "the emergency stop is pressed",
    51: "a motor driver reports a fault",
    79: "not allowed after a critical alarm: reset it",
}
"""Error codes that a stage can meet."""


@dataclass(frozen=True, slots=True)
class Report:
    """A status report.

    Attributes
    ----------
    state : str
        ``"Idle"``, ``"Jog"``, ``"Run"``, ``"Home"``, ``"Alarm"``, ``"Hold:0"``, ``"Door:1"`` ...
    places : tuple of float
        Axis by axis, in the controller's unit (mm, or degrees of rotary axes).
    machine : bool
        Whether these are machine coordinates (``MPos``) or work coordinates (``WPos``).
    offset : tuple of float or None
        ``WCO``, the work coordinates' offset, in reports that carry it: machine = work + offset.
    pins : str
        Letters of the input pins that are active: ``"XZ"`` are limit switches, ``"D"`` the door.
    """

    state: str
    places: tuple[float, ...]
    machine: bool
    offset: tuple[float, ...] | None = None
    pins: str = ""


def parse_report(line: bytes) -> Report | None:
    """Return a status report; None for anything that is not a whole one."""
    match = _REPORT.fullmatch(line.strip())
    if match is None:
        return None
    name, detail, rest = match.groups()
    fields: dict[bytes, bytes] = {}
    for field in rest.split(b"|")[1:]:
        key, _, value = field.partition(b":")
        if key in fields:
            return None  # two reports run together
        fields[key] = value
    if (b"MPos" in fields) == (b"WPos" in fields):
        return None
    machine = b"MPos" in fields
    places = _places(fields[b"MPos" if machine else b"WPos"])
    offset = _places(fields[b"WCO"]) if b"WCO" in fields else None
    if places is None or (b"WCO" in fields and (offset is None or len(offset) != len(places))):
        return None
    state = name.decode()
    # grblHAL adds the alarm's code and homing's phase; what matters is told apart by Hold and Door only.
    if detail is not None and state in ("Hold", "Door"):
        state = f"{state}:{int(detail)}"
    elif state in ("Hold", "Door"):
        state = f"{state}:0"
    return Report(state, places, machine, offset, fields.get(b"Pn", b"").decode(errors="replace"))


def _places(text: bytes) -> tuple[float, ...] | None:
    return tuple(float(number) for number in text.split(b",")) if _PLACES.fullmatch(text) else None


def report_matcher(message: bytes) -> Belongs:
    """Judge a line for ``?``: only a whole report ends it."""
    return Belongs.END if parse_report(message) is not None else Belongs.OTHER


def line_matcher() -> Matcher:
    """Return a matcher for a line command: what it prints, then ``ok`` or ``error:n``."""
    return reply_until(rb"ok|error:\d{1,3}", rb"[\[$].*")


def modes_matcher() -> Matcher:
    """Return a matcher for ``$G`` that no older ``ok`` can end: its own line must have come before."""
    return reply_between(rb"\[GC:.*", rb"ok")


def parse_error(line: bytes) -> int | None:
    """Return the code of ``error:n``; None for other lines."""
    match = _ERROR.fullmatch(line.strip())
    return int(match[1]) if match else None


def parse_alarm(line: bytes) -> int | None:
    """Return the code of ``ALARM:n``; None for other lines."""
    match = _ALARM.fullmatch(line.strip())
    return int(match[1]) if match else None


def is_banner(line: bytes) -> bool:
    """Whether a line is what the controller says after a reset."""
    return _BANNER.fullmatch(line.strip()) is not None


def parse_settings(lines: list[bytes]) -> dict[int, float]:
    """Return the numeric settings of a reply to ``$$``; grblHAL's texts (host names) are left out."""
    found: dict[int, float] = {}
    for line in lines:
        match = _SETTING.fullmatch(line.strip())
        if match:
            found[int(match[1])] = float(match[2])
    return found


def parse_info(lines: list[bytes]) -> dict[str, str]:
    """Return the entries of a reply to ``$I``: ``VER``, ``OPT``, and grblHAL's ``AXS``, ``BOARD`` ..."""
    found: dict[str, str] = {}
    for line in lines:
        match = _INFO.fullmatch(line.strip())
        if match:
            found[match[1].decode()] = match[2].decode(errors="replace")
    return found


def jog(target: dict[str, float], feed_per_min: float) -> bytes:
    """Return the command that moves axes to absolute machine positions.

    Parameters
    ----------
    target : dict
        Axis letter to position, mm or degrees.
    feed_per_min : float
        Speed along the path; the controller holds each axis to its own maximum.
    """
    words = "".join(f"{letter}{place:.5f}" for letter, place in target.items())
    return f"$J=G21G90G53{words}F{max(1.0, math.ceil(feed_per_min * 10) / 10):.1f}\n".encode()
