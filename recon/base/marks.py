"""Numbers that tell what a reconstruction was made of from anything else, rounding excepted.

A checksum of prepared arrays is one of their last bits, which another processor, library or version of this
program rounds otherwise. Marks are sums of an array's numbers under waves of many frequencies, relative to
its norm: they move about as far as the array does. What moves less than a hundred-thousandth of the norm is
not seen: one pixel of a photograph by a few counts, a plane at 30 mm by 0.2 um; nor which number is none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

_MARKS, _PIECE = 8, 1 << 16
_APART = 1e-5
"""Of an array's norm: other PSFs and photographs are hundreds of times as far apart, rounding a hundredth."""
Marks = dict[str, list[float]]


def marks_of(array: npt.NDArray[Any]) -> Marks:
    """Return an array's shape, norm and marks, as JSON holds them; numbers that are none count as 0."""
    flat = np.ascontiguousarray(array).reshape(-1)
    wave = np.arange(1, _MARKS + 1)
    within = np.cos(np.outer(2 * np.pi * np.modf(wave * 2**0.5)[0], np.arange(_PIECE)) + wave[:, None])
    sums, square = np.zeros(_MARKS), 0.0
    for number, start in enumerate(range(0, flat.size, _PIECE)):
        piece = np.nan_to_num(flat[start : start + _PIECE].astype(np.float64), posinf=0.0, neginf=0.0)
        sums += np.cos(number * wave * 3**0.5 + wave) * (within[:, : piece.size] @ piece)
        square += float(piece @ piece)
    norm = square**0.5
    return {"shape": [*map(float, array.shape)], "norm": [norm], "marks": [*(sums / (norm or 1.0)).tolist()]}


def are_alike(then: object, now: list[Marks]) -> bool | None:
    """Whether marks that a record tells are those of now but for rounding; None where it tells none."""
    if not isinstance(then, list) or not then or not all(isinstance(one, Mapping) for one in then):
        return None
    if len(then) != len(now):
        return False
    told = []
    for one, other in zip(then, now, strict=True):
        for name, values in other.items():
            try:
                known = np.asarray(one.get(name), np.float64)
            except (TypeError, ValueError, OverflowError):
                return None
            if known.ndim != 1 or not np.isfinite(known).all():
                return None
            scale = max(abs(values[0]), 1e-300) if name == "norm" else 1.0
            told.append(
                known.shape == np.shape(values) and bool((abs(known - values) <= _APART * scale).all())
            )
    return all(told)
