"""What Illuminate firmware says, and what it means: pure functions of bytes.

The protocol's documents are the firmware's command list (``?``) and its README
(github.com/sci-microscopy/illuminate). Its traps, met here once:

* A reply ends with ``-==-``, which may stand behind the closing brace of a JSON text on the same line.
* Firmware 2 ends a refusal with ``ERROR[n]: text`` and *no* terminator; firmware 1 prints ``ERROR ...`` or
  ``... is not implemented yet.`` and then the terminator. Who waits for the other's hangs, or is one reply
  behind from then on.
* The JSON of positions is not always JSON (``=`` for ``:``, commas too many or too few).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.common.framing import Belongs, Matcher, reply_between

TERMINATOR = b"-==-"
_REFUSAL = re.compile(rb"ERROR ?\[(\d+)\]: *(.*)")
_OLD_REFUSAL = re.compile(rb"(?:.*\bERROR\b.*|.*is not implemented yet\.?.*)", re.IGNORECASE)
_VERSION = re.compile(rb"r?(\d{1,4})\.(\d{1,6})(?:\.\d{1,6})*")
_ENTRY = re.compile(rb'"(\d{1,5})"\s*:\s*\[([^\[\]]*)\]')
_OUTPUT = re.compile(
    rb'"channel"\s*:\s*(\d{1,3})\s*,\s*"pin"\s*:\s*\d+\s*,\s*"pulse_width_us"\s*:\s*(\d{1,9})\s*,\s*'
    rb'"start_delay_us"\s*:\s*(\d{1,9})'
)


@dataclass(frozen=True, slots=True, order=True)
class Version:
    """A firmware version, compared as numbers: 2.3 is older than 2.26."""

    major: int
    minor: int

    def __str__(self) -> str:
        return f"{self.major}.{self.minor:02d}"


def reply_matcher(message: bytes) -> Belongs:
    """Judge a line for a command whose reply ends as the firmware's replies do."""
    if message.rstrip().endswith(TERMINATOR) or _REFUSAL.match(message):
        return Belongs.END
    return Belongs.PART


def version_matcher() -> Matcher:
    """Return a matcher for the reply to ``version`` that no older reply can be taken for."""
    return reply_between(rb"\s*" + _VERSION.pattern + rb"\s*", rb"\s*" + TERMINATOR + rb"\s*")


def payload(lines: list[bytes]) -> list[bytes]:
    """Return a reply without its terminator."""
    return [text for line in lines if (text := line.rstrip().removesuffix(TERMINATOR).rstrip())]


def refusal(lines: list[bytes]) -> tuple[int | None, str] | None:
    """Return the error's number (firmware 2 has some) and words when a reply refuses its command."""
    for line in payload(lines):
        numbered = _REFUSAL.match(line)
        if numbered:
            return int(numbered[1][:6]), numbered[2].decode(errors="replace")
        if _OLD_REFUSAL.fullmatch(line):
            return None, line.decode(errors="replace")
    return None


def parse_version(lines: list[bytes]) -> Version | None:
    """Return the version out of the reply to ``version``; None when there is none in it."""
    for line in payload(lines):
        match = _VERSION.fullmatch(line.strip())
        if match:
            return Version(int(match[1]), int(match[2]))
    return None


def parse_short(lines: list[bytes], key: str) -> tuple[int, ...] | None:
    """Return the numbers of a machine-mode reply such as ``CO.10.20.30`` or ``NA.25``; None without one."""
    pattern = re.compile(re.escape(key.encode()) + rb"((?:\.\d{1,9})+)")
    for line in payload(lines):
        match = pattern.fullmatch(line.strip())
        if match:
            return tuple(int(number) for number in match[1].split(b".")[1:])
    return None


def parse_properties(lines: list[bytes]) -> Mapping[str, Any] | None:
    """Return what ``pprops`` (``pp`` in firmware 1) says; None when it is no JSON object."""
    try:
        found = json.loads(b"\n".join(payload(lines)))
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def parse_table(lines: list[bytes], columns: int) -> npt.NDArray[np.float64] | None:
    """Return the ``(n_leds, columns)`` table of ``pledpos``, ``pledposna`` or ``pvals``, by LED number.

    None unless every LED from 0 to the last has exactly one row of finite numbers: a reply cut short or
    garbled must not become another geometry.
    """
    rows: dict[int, list[float]] = {}
    for number, text in _ENTRY.findall(b" ".join(payload(lines))):
        try:
            row = [float(value) for value in text.split(b",")]
        except ValueError:
            return None
        if len(row) != columns or int(number) in rows:
            return None
        rows[int(number)] = row
    if not rows or sorted(rows) != list(range(len(rows))):
        return None
    table = np.array([rows[number] for number in range(len(rows))], np.float64)
    return table if bool(np.isfinite(table).all()) else None


def parse_trigger_outputs(lines: list[bytes]) -> dict[int, tuple[int, int]]:
    """Return pulse width and start delay in microseconds of each trigger output, as ``trs`` lists them."""
    return {
        int(channel): (int(width), int(delay))
        for channel, width, delay in _OUTPUT.findall(b" ".join(payload(lines)))
    }
