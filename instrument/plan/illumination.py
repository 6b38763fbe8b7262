"""Plans of active illumination: one frame for each of several groups of LEDs, and one in the dark."""

from __future__ import annotations

import re
from collections.abc import Sequence

from instrument.files.errors import BenchError
from instrument.plan.model import Part, Plan
from instrument.plan.patterns import OFF, Light

DARK, PATTERN = "dark", "pattern"
"""What the frames of such a plan are called."""

MOST_NAMED = 8
"""LEDs of a group that its description names."""


def illumination_plan(lights: Sequence[Light], *, exposure_ms: float, average: int = 1) -> Plan:
    """Return a plan that photographs the scene in each light in turn, and once in the dark.

    The frames of its part ``"pattern"``, less the one of its part ``"dark"``, are what
    :func:`recon.reconstruction.patterned.reconstruct_patterned` takes;
    :mod:`instrument.reconstruction.patterned` reads them from runs.

    Parameters
    ----------
    lights : sequence of Light
        Patterns by name, or of :func:`group_lights`.
    exposure_ms : float
    average : int
        Frames averaged for each pattern.

    Raises
    ------
    BenchError
        When there is no light.
    """
    if not lights:
        raise BenchError("Active illumination needs patterns, each with one LED at least.")
    exposures = (exposure_ms,)
    return Plan(
        label="active illumination",
        parts=(
            Part(label=DARK, light=(OFF,), exposures_ms=exposures, average=average),
            Part(label=PATTERN, light=tuple(lights), exposures_ms=exposures, average=average),
        ),
    )


def group_lights(groups: Sequence[Sequence[int]], level: int = 255) -> list[Light]:
    """Return the lights of groups of LEDs by number, every LED at one level.

    Raises
    ------
    BenchError
        When a group is empty, or the level out of range.
    """
    if not all(len(group) for group in groups):
        raise BenchError("Active illumination needs groups of LEDs, each with one at least.")
    if not 1 <= level <= 255:
        raise BenchError(f"An LED's level lies between 1 and 255, not {level}.")
    return [
        Light(
            kind="pattern",
            description=f"group {number}: {_in_words(group)}",
            leds=tuple((led, level, level, level) for led in group),
        )
        for number, group in enumerate(groups)
    ]


def _in_words(group: Sequence[int]) -> str:
    if len(group) > MOST_NAMED:
        return f"{len(group)} LEDs"
    return f"LEDs {', '.join(map(str, group))}"


def groups_from_text(text: str) -> list[list[int]]:
    """Return groups of LEDs written as ``"0-3,8;4;5,6"``: semicolons between groups, commas in them.

    Raises
    ------
    BenchError
        When it is something else.
    """
    groups = []
    for group in text.split(";"):
        numbers: list[int] = []
        for item in filter(None, (word.strip() for word in group.split(","))):
            span = re.fullmatch(r"(\d+)(?:\s*-\s*(\d+))?", item)
            if span is None:
                raise BenchError(
                    f"--groups: {item!r} is neither an LED's number nor a span of them; write '0-3,8;4;5,6'."
                )
            first, last = int(span[1]), int(span[2] or span[1])
            if last < first:
                raise BenchError(f"--groups: the span {item!r} ends before it begins.")
            numbers += range(first, last + 1)
        if not numbers:
            raise BenchError("--groups: a group is empty; write '0-3,8;4;5,6'.")
        if len(set(numbers)) < len(numbers):
            raise BenchError(f"--groups: a group names an LED twice: {group.strip()!r}.")
        groups.append(numbers)
    return groups
