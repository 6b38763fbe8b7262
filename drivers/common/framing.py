"""Cutting a stream of bytes into messages, and telling which message answers which command."""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import Enum, auto
from typing import Protocol


class Framer(Protocol):
    """Cuts bytes into messages."""

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they came and return the messages that are whole now."""

    def reset(self) -> None:
        """Forget a message that is not whole."""


class LineFramer:
    """Messages are lines; carriage returns, line feeds and empty lines around them are dropped.

    Parameters
    ----------
    longest : int
        A line longer than this is garbage (a wrong baud rate, a torn line) and is dropped.
    """

    def __init__(self, longest: int = 65_536) -> None:
        self._longest = longest
        self._rest = b""
        self._too_long = False

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes as they came and return the lines that are whole now."""
        *whole, self._rest = re.split(rb"[\r\n]", self._rest + data)
        lines: list[bytes] = []
        for line in whole:
            if not self._too_long and line:
                lines.append(line)
            self._too_long = False
        if len(self._rest) > self._longest:
            self._rest, self._too_long = b"", True
        return lines

    def reset(self) -> None:
        """Forget a line that is not whole."""
        self._rest, self._too_long = b"", False


class Belongs(Enum):
    """What a message is to a command that waits for its reply."""

    OTHER = auto()
    """It does not belong to it."""
    PART = auto()
    """It belongs to the reply, and more will come."""
    END = auto()
    """It ends the reply."""


Matcher = Callable[[bytes], Belongs]
"""Judges messages for one command."""


def reply_line(pattern: bytes) -> Matcher:
    """Return a matcher for a reply of one line that matches a regular expression as a whole."""
    compiled = re.compile(pattern)
    return lambda message: Belongs.END if compiled.fullmatch(message) else Belongs.OTHER


def reply_between(start: bytes, end: bytes) -> Matcher:
    """Return a matcher for a reply from a line that matches ``start`` to the next one that matches ``end``.

    No older ``end`` is taken for this reply's.
    """
    starts, ends = re.compile(start), re.compile(end)
    seen = False

    def judge(message: bytes) -> Belongs:
        nonlocal seen
        if starts.fullmatch(message):
            seen = True
            return Belongs.PART
        if seen and ends.fullmatch(message):
            seen = False  # the matcher is used again
            return Belongs.END
        return Belongs.OTHER

    return judge


def reply_until(end: bytes, body: bytes = rb".*") -> Matcher:
    """Return a matcher for a reply of lines that match ``body``, up to one that matches ``end``."""
    ends, belongs = re.compile(end), re.compile(body)

    def judge(message: bytes) -> Belongs:
        if ends.fullmatch(message):
            return Belongs.END
        return Belongs.PART if belongs.fullmatch(message) else Belongs.OTHER

    return judge
