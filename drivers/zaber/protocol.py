"""Messages of Zaber's ASCII protocol (Zaber ASCII Protocol Manual, firmware 6.06 to 7).

A command ``/1 2 05 move abs 1000:CS`` (device, axis, message number, checksum) is answered by
``@01 2 05 OK BUSY -- 0:CS``: accepted or rejected, idle or busy, the most serious warning, data. Info
messages begin with ``#``, alerts with ``!``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

SPEED_FACTOR = 1.6384
"""Setting ``maxspeed`` over microsteps a second (protocol manual, "maxspeed")."""

_MESSAGE = re.compile(
    rb"(?P<kind>[@#!])(?P<device>\d\d) (?P<axis>\d)(?: (?P<number>\d\d))?"
    rb"(?: (?P<accepted>OK|RJ))?(?: (?P<status>IDLE|BUSY) (?P<flag>--|[A-Z]{2}))?(?: (?P<data>[ -~]*))?"
)
_CHECKSUM_LENGTH = 3

FAULTS = {
    "FF": "critical system error",
    "FN": "peripheral not supported",
    "FZ": "peripheral inactive: it was plugged in or changed under power",
    "FH": "driver disabled by the hardware emergency stop",
    "FV": "driver disabled by over- or undervoltage",
    "FO": "driver disabled",
    "FC": "current inrush",
    "FM": "motor too hot",
    "FD": "driver disabled by a fault",
    "FQ": "encoder error",
    "FI": "index error",
    "FA": "analogue encoder out of step",
    "FR": "overdrive limit exceeded",
    "FS": "stalled and stopped",
    "FB": "stream bounds error",
    "FP": "interpolated path deviation",
    "FE": "a limit sensor was reached or is faulty",
    "FT": "excessive twist",
    "WL": "ran into a limit sensor where none was expected",
}
"""Flags after which a position is not to be trusted or a move cannot have ended well."""

WARNINGS = {
    "WV": "supply voltage out of range",
    "WT": "controller hot",
    "WS": "stalled and recovered",
    "WM": "was displaced while it stood still",
    "WP": "invalid calibration",
    "WR": "no reference position",
    "WH": "not homed",
    "NC": "moved by hand",
    "NI": "a movement was interrupted by another",
    "ND": "stream discontinuity",
    "NR": "value rounded",
    "NT": "value truncated",
    "NU": "setting update pending",
    "NJ": "joystick calibrating",
    "NB": "in firmware update mode",
}
NO_REFERENCE = frozenset({"WR", "WH"})

REJECTIONS = {
    "AGAIN": "it cannot be done right now",
    "BADAXIS": "there is no such axis",
    "BADCOMMAND": "it does not know this command",
    "BADDATA": "the value is out of its range",
    "BADMESSAGEID": "the message number is out of range",
    "DEVICEONLY": "this goes to a whole device, not to an axis",
    "DRIVERDISABLED": "its driver is disabled",
    "FULL": "its memory is full",
    "INACTIVE": "the axis has no peripheral",
    "LOCKSTEP": "the axis is in a lockstep group",
    "NOACCESS": "its access level does not allow it",
    "NOTSUPPORTED": "its firmware does not support it",
    "PARKED": "it is parked: unpark it with Zaber's software",
    "STATUSBUSY": "it is moving",
}


@dataclass(frozen=True, slots=True)
class Message:
    """A message from a device; fields that its kind does not have are empty."""

    kind: str
    """``"@"`` reply, ``"#"`` info, ``"!"`` alert."""
    device: int
    axis: int
    number: int | None
    accepted: bool
    busy: bool
    flag: str
    data: str


def checksum(content: bytes) -> bytes:
    """Return the two hexadecimal digits that make the sum of all bytes zero modulo 256."""
    return b"%02X" % (-sum(content) & 0xFF)


def command(text: str, device: int = 0, axis: int = 0, number: int | None = None) -> bytes:
    """Return a command as it is sent; device 0 is every device, axis 0 every axis of it."""
    head = f"{device} {axis} " + (f"{number:02d} " if number is not None else "")
    content = f"{head}{text}".encode("ascii")
    return b"/%s:%s\n" % (content, checksum(content))


def parse(line: bytes, *, need_checksum: bool = False) -> Message | None:
    """Return the message in a line, None when it is garbage: torn, garbled, or of another protocol.

    Parameters
    ----------
    line : bytes
        Without its end.
    need_checksum : bool
        Take a message without checksum for a torn one: its data may lack digits.
    """
    content, mark, found = line[:-_CHECKSUM_LENGTH], line[-_CHECKSUM_LENGTH:-2], line[-2:]
    if mark == b":":
        if checksum(content[1:]) != found:
            return None
        line = content
    elif need_checksum:
        return None
    fields = _MESSAGE.fullmatch(line)
    if fields is None:
        return None
    kind = fields["kind"].decode()
    has_status, has_verdict = fields["status"] is not None, fields["accepted"] is not None
    if (has_verdict, has_status) != {"@": (True, True), "#": (False, False), "!": (False, True)}[kind]:
        return None
    return Message(
        kind=kind,
        device=int(fields["device"]),
        axis=int(fields["axis"]),
        number=None if fields["number"] is None else int(fields["number"]),
        accepted=fields["accepted"] == b"OK",
        busy=fields["status"] == b"BUSY",
        flag=(fields["flag"] or b"--").decode(),
        data=(fields["data"] or b"").decode("ascii"),
    )


def flag_words(flag: str) -> str:
    """Return a flag in words, with its two letters, which Zaber's manuals list."""
    return f"{FAULTS.get(flag) or WARNINGS.get(flag) or 'unknown warning'} ({flag})"
