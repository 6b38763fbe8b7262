"""Numbers that tell what a reconstruction was made of from anything else, and to the last bit.

A checksum of prepared arrays is one of their last bits, which another processor, library or version of this
program rounds otherwise. Marks are sums of an array's numbers under waves of many frequencies, relative to
its norm: they move about as far as the array does. What moves less than a hundred-thousandth of the norm is
not told from rounding: one pixel of a photograph by a few counts, a plane at 30 mm by 0.2 um. The checksum
beside them tells whether anything moved at all. Numbers that are none have marks of their own.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np

from recon.arrays import Array

_MARKS, _PIECE = 8, 1 << 16
_APART = 1e-5
"""Of an array's norm: other PSFs and photographs are hundreds of times as far apart, rounding a hundredth."""
_BITS, _GAPS, _NORM = "crc32", "gaps", "norm"
_NO_GAPS = [0.0] * (_MARKS + 1)
"""Of a record of before 2026-12, which counted numbers that are none as 0: none, as far as it tells."""
Marks = dict[str, list[float]]


class Likeness(Enum):
    """How much arrays are those whose marks were noted, the gravest first."""

    OTHER = "others"
    UNKNOWN = "nothing tells"
    NEAR = "as near as rounding, which a small change is not told from, and not to the last bit"
    ALIKE = "as near as rounding; nothing tells whether to the last bit"
    SAME = "to the last bit"


def marks_of(array: Array) -> Marks:
    """Return an array's shape, norm, marks and checksum, as JSON holds them.

    Numbers that are none count as 0 among these; ``gaps`` tells how many they are, and which.
    """
    flat = np.ascontiguousarray(array).reshape(-1)
    norm, marks = _marks(flat)
    gaps = ~np.isfinite(flat) if flat.dtype.kind == "f" else np.zeros(1, bool)
    return {
        "shape": [*map(float, array.shape)],
        _NORM: [norm],
        "marks": marks,
        _GAPS: [float(np.count_nonzero(gaps)), *_marks(gaps)[1]] if gaps.any() else _NO_GAPS,
        _BITS: [float(zlib.crc32(flat.data))],
    }


def _marks(flat: Array) -> tuple[float, list[float]]:
    """Return the norm of numbers in a row, and their marks relative to it."""
    wave, longest = np.arange(1, _MARKS + 1), min(flat.size, _PIECE)
    within = np.cos(np.outer(2 * np.pi * np.modf(wave * 2**0.5)[0], np.arange(longest)) + wave[:, None])
    sums, square = np.zeros(_MARKS), 0.0
    for number, start in enumerate(range(0, flat.size, _PIECE)):
        piece = np.nan_to_num(flat[start : start + _PIECE].astype(np.float64), posinf=0.0, neginf=0.0)
        sums += np.cos(number * wave * 3**0.5 + wave) * (within[:, : piece.size] @ piece)
        square += float(piece @ piece)
    norm = square**0.5
    return norm, (sums / (norm or 1.0)).tolist()


def likeness(then: object, now: list[Marks]) -> Likeness:
    """Return how much arrays are those whose marks a record tells."""
    if not isinstance(then, list) or not then or not all(isinstance(one, Mapping) for one in then):
        return Likeness.UNKNOWN
    if len(then) != len(now):
        return Likeness.OTHER
    found = [_likeness(one, other) for one, other in zip(then, now, strict=True)]
    return min(found, key=[*Likeness].index)


def _likeness(one: Mapping[str, Any], now: Marks) -> Likeness:
    """Return how much one array is that whose marks a record tells."""
    found = [_are_as_then(one, name, values) for name, values in now.items() if name != _BITS]
    if False in found:
        return Likeness.OTHER
    if None in found:
        return Likeness.UNKNOWN
    bits = one.get(_BITS)
    if not isinstance(bits, list) or not all(isinstance(number, float | int) for number in bits):
        return Likeness.ALIKE
    return Likeness.SAME if bits == now[_BITS] else Likeness.NEAR


def _are_as_then(one: Mapping[str, Any], name: str, values: list[float]) -> bool | None:
    """Return whether some of an array's marks are those of a record; None where it does not tell."""
    if name == _GAPS and name not in one:
        return True if values == _NO_GAPS else None
    try:
        known = np.asarray(one.get(name), np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    if known.ndim != 1 or not np.isfinite(known).all():
        return None
    scale = max(abs(values[0]), 1e-300) if name == _NORM else 1.0
    return known.shape == np.shape(values) and bool((abs(known - values) <= _APART * scale).all())
