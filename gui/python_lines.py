"""Objects as the Python that makes them, for "Copy as Python"."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any


def expression(value: Any) -> str:
    """Return Python that makes a value: plain values, paths, sequences of them, and dataclasses.

    Of a dataclass only what differs from its defaults is written. Names (``Path``, the class) must be
    imported by the lines around it.
    """
    if isinstance(value, Path):
        return f"Path({str(value)!r})"
    if is_dataclass(value) and not isinstance(value, type):
        given = []
        for field in fields(value):
            content = getattr(value, field.name)
            made = field.default_factory() if field.default_factory is not MISSING else field.default
            if made is MISSING or content != made:
                given.append(f"{field.name}={expression(content)}")
        return f"{type(value).__name__}({', '.join(given)})"
    if isinstance(value, tuple):
        inside = ", ".join(map(expression, value))
        return f"({inside},)" if len(value) == 1 else f"({inside})"
    if isinstance(value, list):
        return f"[{', '.join(map(expression, value))}]"
    return repr(value)
