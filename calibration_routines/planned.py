"""What a checked plan comes to on a bench: its outlook, its places, homing before it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from types import MappingProxyType

import numpy as np

from calibration_routines.procedure import Listener, Outlook
from calibration_routines.scatter import reduction
from instrument.bench.bench import Bench
from instrument.plan import Plan, Step, estimate
from instrument.runs.acquire import abilities_of
from instrument.runs.pace import pace_of
from instrument.runs.timed import TimedSteps

_NOTHING: Mapping[str, tuple[float, float]] = MappingProxyType({})


def outlook_of(
    bench: Bench,
    plan: Plan,
    folder: Path | None,
    reasons: Sequence[str] = (),
    *,
    homes: bool = False,
    computes: Mapping[str, tuple[float, float]] = _NOTHING,
) -> Outlook:
    """Return the outlook of a plan that was checked.

    Where it moves a stage, the reasons say whether that is homed first: always (``homes``), or where it has
    no reference yet. ``computes`` has what its steps compute for each frame (:class:`Outlook`): for each of
    its megapixels as they are compared (:func:`calibration_routines.scatter.reduction`), and for each at all.
    Simulated light is part of it, so that it says nothing of a real bench.
    """
    abilities = abilities_of(bench, folder or bench.config.data_folder)
    path = path_of(plan)
    words = list(reasons)
    if path and bench.stage is not None and (homes or not bench.stage.is_homed):
        words.append("The stage is homed first, every axis to its reference: its way must be free.")
    if bench.trigger_source is not None:
        words.append(TimedSteps(bench, plan).words())
    pace = pace_of(plan, abilities, folder or bench.config.data_folder, bench.config.text)
    if pace is not None:
        words.append(pace.words(plan, abilities))
    cost, shape = estimate(plan, abilities), bench.camera.frame_shape[:2]
    compared = prod(shape) / reduction(np.broadcast_to(np.float32(0), shape)) ** 2
    work = tuple(
        (step, 1e-6 * cost.frames * (by_compared * compared + by_all * prod(shape)))
        for step, (by_compared, by_all) in computes.items()
        if bench.simulated_kinds
    )
    return Outlook(tuple(words), plan, cost, abilities.free_bytes, work=work, path=path)


def path_of(plan: Plan) -> tuple[dict[str, float], ...]:
    """Return the places that a plan visits, one after the other; empty where nothing moves."""
    places: list[dict[str, float]] = []
    for step in plan.steps():
        place = place_of(step)
        if place and (not places or places[-1] != place):
            places.append(place)
    return tuple(places)


def place_of(step: Step) -> dict[str, float]:
    """Return where a step puts the source (``x_um``, ``y_um``, ``z_um``) or the stage; empty: nowhere."""
    if step.source_um is not None:
        return dict(zip(("x_um", "y_um", "z_um"), step.source_um, strict=True))
    return dict(step.stage)


def home_if_needed(bench: Bench, listener: Listener, plan: Plan | None = None) -> None:
    """Home a stage that has no reference yet; for a plan that places nothing, not."""
    needed = plan is None or any(part.positions is not None for part in plan.parts)
    if needed and bench.stage is not None and not bench.stage.is_homed:
        listener.step("homing the stage")
        bench.stage.home()
