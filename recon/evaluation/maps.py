"""All maps by name, and how one is run: every cell once, the coarse ones first, known cells skipped."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

from recon.errors import InputError
from recon.evaluation import (
    maps_calibration,
    maps_display,
    maps_light,
    maps_scene,
    maps_solver,
    maps_time,
)
from recon.evaluation.trial import VOLUME, own_methods
from recon.verdict.map import Cell, Size, StressMap, cell_of


def cells_of(stress: StressMap, size: Size, methods: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return every cell ``(method, ix, iy)`` of a map, the coarse ones first."""
    n_x, n_y = len(stress.x.at(size)), len(stress.y.at(size))
    order = sorted(
        ((ix, iy) for iy in range(n_y) for ix in range(n_x)), key=lambda c: (c[0] % 2 + c[1] % 2, c[1], c[0])
    )
    return [(m, ix, iy) for ix, iy in order for m in stress.methods if m in methods]


def run_map(
    stress: StressMap,
    size: Size = "full",
    *,
    methods: Sequence[str] | None = None,
    known: Sequence[Cell] = (),
    seed: int = 0,
) -> Iterator[Cell]:
    """Yield the cells of a map that are not known yet, as they are made.

    Parameters
    ----------
    stress : StressMap
    size : "quick" or "full"
    methods : sequence of str, optional
        Of the map's; default all.
    known : sequence of Cell
        Left out.
    seed : int
        Another seed, other scenes and noise.
    """
    done = {(c.method, c.ix, c.iy) for c in known}
    x, y = stress.x.at(size), stress.y.at(size)
    for method, ix, iy in cells_of(stress, size, stress.methods if methods is None else methods):
        if (method, ix, iy) in done:
            continue
        began = time.perf_counter()
        draws = stress.draws if size == "full" else 1
        trials = [stress.trial(method, x[ix], y[iy], seed + k, size) for k in range(draws)]
        yield cell_of(method, ix, iy, trials, time.perf_counter() - began)


MAPS: dict[str, StressMap] = {
    stress.name: stress
    for module in (
        maps_light,
        maps_scene,
        maps_time,
        maps_calibration,
        maps_solver,
        maps_display,
    )
    for stress in module.MAPS
}


_OF_SCENES = {stress.name for module in (maps_light, maps_scene, maps_calibration) for stress in module.MAPS}
"""Maps whose methods are a solver and a prior, which any scene can be reconstructed by."""


def map_named(name: str) -> StressMap:
    """Return a map by its name."""
    if name not in MAPS:
        raise InputError(f"There is no map {name!r}. Maps: {', '.join(MAPS)}.")
    return with_own_methods(MAPS[name])


def with_own_methods(stress: StressMap) -> StressMap:
    """Return a map with the solvers and priors that others' packages, or this program, have registered."""
    first = stress.methods[0]
    if stress.name not in _OF_SCENES or "," in first:
        return stress
    return replace(stress, methods=(*stress.methods, *own_methods(volume=first.startswith(VOLUME))))
