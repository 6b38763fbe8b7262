"""Messages to and from a DLPC900: 64-byte HID reports (section 1.2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

REPORT_BYTES = 64
_HEADER_BYTES = 4
_READ, _REPLY, _ERROR = 0x80, 0x40, 0x20


@dataclass(frozen=True, slots=True)
class Reply:
    """What the controller answered to the message with the same sequence number."""

    sequence: int
    refused: bool
    """Whether it did not know, or did not carry out, the command."""
    data: bytes


def reports(command: int, data: bytes, sequence: int, *, read: bool) -> Iterator[bytes]:
    """Cut one message into reports of 64 bytes, the last filled up with zeros.

    A reply is asked for to writes, too: it says whether the command was carried out.

    Parameters
    ----------
    command : int
        The guide's USB command, e.g. 0x1A24.
    data : bytes
    sequence : int
        0 to 255; comes back in the reply.
    read : bool
        Whether this is a read.
    """
    flags = _REPLY | (_READ if read else 0)
    length = 2 + len(data)
    message = bytes([flags, sequence]) + length.to_bytes(2, "little") + command.to_bytes(2, "little") + data
    for start in range(0, len(message), REPORT_BYTES):
        yield message[start : start + REPORT_BYTES].ljust(REPORT_BYTES, b"\0")


def parse_reply(report: bytes) -> Reply | None:
    """Return the reply in a report; None when the bytes are none.

    Replies longer than a report are cut off: none that this driver asks for is.
    """
    if len(report) < _HEADER_BYTES or not report[0] & _REPLY:
        return None
    length = int.from_bytes(report[2:4], "little")
    data = report[_HEADER_BYTES : _HEADER_BYTES + length]
    if len(data) < min(length, REPORT_BYTES - _HEADER_BYTES):
        return None
    return Reply(report[1], bool(report[0] & _ERROR), bytes(data))
