"""The maps that come with the program, from which verdicts are made."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("shipped.json")


def shipped_file() -> Path:
    """Return where the shipped maps are: a ``stability.json``."""
    return FILE


@cache
def shipped_maps() -> dict[str, Any]:
    """Return the shipped maps by name."""
    maps: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))["maps"]
    return maps
