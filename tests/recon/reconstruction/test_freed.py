"""What a reconstruction took is free again when it is over, not when Python looks for circles of objects."""

from __future__ import annotations

import gc
from typing import Any

import pytest

from recon import reconstruct
from recon.evaluation.scene import make_scene
from recon.reconstruction.solvers import SOLVERS

VARYING = {"grid": 3, "aberration": 0.5}


@pytest.mark.parametrize(
    ("family", "made", "options"),
    [
        *(("dense-picture", {}, {"solver": solver}) for solver in SOLVERS if SOLVERS.is_own(solver)),
        ("dense-picture", {}, {"prior": "tv-haar"}),
        ("dense-picture", VARYING, {"model": "local"}),
        ("dense-picture", VARYING, {"model": "lowrank", "prior": "l1"}),
        ("sparse-picture", VARYING, {}),
        ("beads", {}, {"prior": "l1"}),
        ("dense-volume", {}, {}),
        ("microscope", {"grid": 3}, {}),
    ],
)
def test_nothing_is_left_in_circles(family: str, made: dict[str, Any], options: dict[str, Any]) -> None:
    scene = make_scene(family, size=32, **made)  # type: ignore[arg-type]
    few = {} if SOLVERS.named(options.get("solver", "admm")).one_step else {"iterations": 3}
    # Once before: what is compiled for it leaves circles of its own.
    reconstruct(scene.measurement, scene.calibration, **few, **options)
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        reconstruct(scene.measurement, scene.calibration, **few, **options)
        gc.collect()
        left = {type(thing).__name__ for thing in gc.garbage if type(thing).__module__.startswith("recon.")}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert left == set()
