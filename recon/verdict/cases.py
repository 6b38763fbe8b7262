"""What is known of reconstructions with a truth: the shipped stability maps, and which methods fail alike."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

SHIPPED = Path(__file__).with_name("shipped.json")
"""The stability maps that come with the program: a ``stability.json``."""

OF_VOLUMES = " of volumes"
"""Behind the solver and the prior in a method's name: where there is more than one depth."""
GROUPS = {
    "picture tv": ("admm tv", "admm-sensor tv", "fista tv"),
    "picture l1": ("admm l1", "fista l1", "admm-sensor l1"),
    "wiener": ("wiener",),
    "volume tv": ("admm tv" + OF_VOLUMES,),
    "volume l1": ("admm l1" + OF_VOLUMES, "admm nonnegative" + OF_VOLUMES),
}
"""Methods that reach the same minimiser, and so fail alike."""


def group_of(method: str) -> str | None:
    """Return the group of a method, or None where no case is of one like it."""
    return next((g for g, methods in GROUPS.items() if method in methods), None)


@cache
def shipped_maps() -> dict[str, Any]:
    """Return the shipped maps by name."""
    maps: dict[str, Any] = json.loads(SHIPPED.read_text(encoding="utf-8"))["maps"]
    return maps
