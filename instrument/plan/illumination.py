"""Plans of active illumination: one frame for each of several groups of LEDs, and one in the dark."""

from __future__ import annotations

from collections.abc import Sequence

from instrument.errors import BenchError
from instrument.plan.model import OFF, Light, Part, Plan


def illumination_plan(
    groups: Sequence[Sequence[int]], *, exposure_ms: float, level: int = 255, average: int = 1
) -> Plan:
    """Return a plan that photographs the scene lit by each group of LEDs in turn.

    The frames of its part ``"pattern"``, less the one of its part ``"dark"``, are what
    :func:`recon.patterned.reconstruct_patterned` takes.

    Parameters
    ----------
    groups : sequence of sequences of int
        LED numbers of each pattern.
    exposure_ms : float
    level : int
        Of every LED, 1 to 255.
    average : int
        Frames averaged for each pattern.

    Raises
    ------
    BenchError
        When there is no group, an empty one, or a level out of range.
    """
    if not groups or not all(len(group) for group in groups):
        raise BenchError("Active illumination needs groups of LEDs, each with one at least.")
    if not 1 <= level <= 255:
        raise BenchError(f"An LED's level lies between 1 and 255, not {level}.")
    lights = tuple(
        Light(
            kind="pattern",
            description=f"group {number}: LEDs {', '.join(map(str, group))}",
            leds=tuple((led, level, level, level) for led in group),
        )
        for number, group in enumerate(groups)
    )
    exposures = (exposure_ms,)
    return Plan(
        label="active illumination",
        parts=(
            Part(label="dark", light=(OFF,), exposures_ms=exposures, average=average),
            Part(label="pattern", light=lights, exposures_ms=exposures, average=average),
        ),
    )
