"""A dataclass in a line: what it holds, arrays by shape and type."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

LONGEST = 60
"""Letters of one value."""


def brief(self: Any) -> str:
    """Return a dataclass's ``repr`` without what is at its default or empty, arrays by shape and type."""
    said = [
        f"{f.name}={text}"
        for f in dataclasses.fields(self)
        if (text := _in_short(getattr(self, f.name), f.default))
    ]
    return f"{type(self).__name__}({', '.join(said)})"


def _in_short(value: Any, default: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"<{value.dtype} {' x '.join(map(str, value.shape))}>"
    if isinstance(value, Mapping):
        return f"<{', '.join(map(str, value))}>" if value else ""
    if value is None or value is default:
        return ""
    text = repr(value)
    if len(text) <= LONGEST:
        return text
    many = f" of {len(value)}" if isinstance(value, tuple | list) else ""
    return f"<{type(value).__name__}{many}>"
