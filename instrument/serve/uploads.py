"""Arrays that come ahead of the call that takes them, in pieces, so that no STOP waits for one on its way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.remote.wire import LONGEST_ARRAYS, Call


@dataclass
class _Upload:
    bytes_: memoryview
    missing: int
    places: set[int] = field(default_factory=set)
    """Where pieces have come, so that one that comes twice hides no hole."""


class Uploads:
    """What an operator has sent of arrays, by a name that he gives each, until a call takes it.

    All that wait hold no more than ``LONGEST_ARRAYS`` bytes: of more, those that came first were given up.
    """

    def __init__(self) -> None:
        self._waiting: dict[tuple[str, str], _Upload] = {}

    def add(self, operator: str, name: str, size: int, place: int, piece: bytes) -> None:
        """Keep a piece of an array's file of ``size`` bytes; ValueError when it has no place there."""
        if not 0 < size <= LONGEST_ARRAYS:
            raise ValueError(f"an array of {size} bytes cannot be sent, at most {LONGEST_ARRAYS >> 20} MB")
        upload = self._waiting.get((operator, name))
        if upload is None:
            while self._waiting and size + self._kept > LONGEST_ARRAYS:
                del self._waiting[next(iter(self._waiting))]
            # Memory that was not written to yet takes none, and says nothing of what was there before.
            upload = self._waiting[operator, name] = _Upload(np.zeros(size, np.uint8).data, size)
        if len(upload.bytes_) != size or not 0 <= place <= size - len(piece):
            raise ValueError(f"{len(piece)} bytes from {place} on are no piece of an array of {size} bytes")
        if place in upload.places:
            raise ValueError(f"the piece from {place} on came twice")
        upload.bytes_[place : place + len(piece)] = piece
        upload.places.add(place)
        upload.missing -= len(piece)

    @property
    def _kept(self) -> int:
        return sum(len(upload.bytes_) for upload in self._waiting.values())

    def take(self, operator: str, name: object) -> memoryview:
        """Return an array's file, which is kept no longer; ValueError when it did not come whole."""
        upload = self._waiting.pop((operator, str(name)), None)
        if upload is None or upload.missing:
            raise ValueError("an array did not come whole before the call that takes it")
        return upload.bytes_

    def filled_in(self, operator: str, call: Call, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return a call's arguments with the arrays that came ahead of it."""
        return {
            name: self.take(operator, value.get("upload"))
            if isinstance(value, dict) and name in call.takes and call.takes[name].is_array
            else value
            for name, value in arguments.items()
        }

    def forget(self, operator: str) -> None:
        """Give up what an operator has sent who has left."""
        for key in [key for key in self._waiting if key[0] == operator]:
            del self._waiting[key]
