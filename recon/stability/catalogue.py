"""All maps, by name."""

from __future__ import annotations

from recon.errors import InputError
from recon.stability import maps_light
from recon.stability.map import StressMap

MAPS: dict[str, StressMap] = {m.name: m for m in maps_light.MAPS}


def map_named(name: str) -> StressMap:
    """Return a map by its name."""
    if name not in MAPS:
        raise InputError(f"There is no map {name!r}. Maps: {', '.join(MAPS)}.")
    return MAPS[name]
