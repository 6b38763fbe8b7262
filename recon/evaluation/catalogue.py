"""All maps, by name."""

from __future__ import annotations

from recon.errors import InputError
from recon.evaluation import (
    maps_calibration,
    maps_display,
    maps_light,
    maps_scene,
    maps_solver,
    maps_time,
    maps_volume,
)
from recon.verdict.map import StressMap

MAPS: dict[str, StressMap] = {
    stress.name: stress
    for module in (
        maps_light,
        maps_volume,
        maps_scene,
        maps_time,
        maps_calibration,
        maps_solver,
        maps_display,
    )
    for stress in module.MAPS
}


def map_named(name: str) -> StressMap:
    """Return a map by its name."""
    if name not in MAPS:
        raise InputError(f"There is no map {name!r}. Maps: {', '.join(MAPS)}.")
    return MAPS[name]
