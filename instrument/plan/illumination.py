"""Plans of active illumination: the scene lit by one group of LEDs after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from instrument.files.errors import BenchError, SettingsError
from instrument.plan.led_shapes import LedPlaces
from instrument.plan.model import Part, Plan
from instrument.plan.patterns import (
    LED_PATTERNS,
    OFF,
    Light,
    group_lights,
    groups_from_text,
    led_shape,
    shape_from_text,
)
from recon.base.declare import option

DARK, PATTERN = "dark", "pattern"
"""What the frames of such a plan are called."""


def illumination_plan(lights: Sequence[Light], *, exposure_ms: float, average: int = 1) -> Plan:
    """Return a plan that photographs the scene in each light in turn, and once in the dark.

    The frames of its part ``"pattern"``, less the one of its part ``"dark"``, are what
    :func:`recon.reconstruct` takes with patterns; :mod:`instrument.reconstruction.patterned` reads them.

    Raises BenchError when there is no light.
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


@dataclass(frozen=True, kw_only=True)
class IlluminationOptions:
    """Which LEDs light each frame, and how it is exposed."""

    exposure_ms: float | None = option(
        None,
        help="Of every frame.",
        default_words="found for the present scene",
        unit="ms",
        least=1e-3,
    )
    groups: list[list[int]] | None = option(
        None,
        help="LEDs of each pattern: '0-3,8;4;5,6'.",
        default_words="none",
        metavar="LEDS",
        parse=groups_from_text,
    )
    lattice: int | None = option(
        None,
        help="The array's LEDs in N x N groups by place; short for --pattern 'grid side=N'.",
        default_words="none",
        metavar="N",
        least=1,
    )
    pattern: str | None = option(
        None,
        help=f"A named pattern and all that belong to it: {', '.join(LED_PATTERNS)}. With options: "
        "'half na=0.3'. diffuserbench plan patterns lists them.",
        default_words="none",
        metavar="NAME",
    )
    level: int = option(255, help="Of every LED.", least=1, most=255)
    average: int = option(1, help="Exposures averaged into a frame.", least=1)

    def __post_init__(self) -> None:
        if sum(given is not None for given in (self.groups, self.lattice, self.pattern)) != 1:
            either = "Give the patterns as one of --groups, --lattice and --pattern"
            raise SettingsError([("groups", either)])

    @property
    def needs_bench(self) -> bool:
        """Whether the bench must say where its LEDs are, or find the exposure."""
        return self.groups is None or self.exposure_ms is None

    def plan(self, array: LedPlaces | None, exposure_ms: float | None = None) -> Plan:
        """Return the plan; ``array``: the bench's LEDs; ``exposure_ms``: where none was asked for.

        Raises BenchError where there is no array and places are needed, or a pattern is not known; ValueError
        without an exposure.
        """
        exposed_ms = self.exposure_ms or exposure_ms
        if exposed_ms is None:
            raise ValueError("The frames of a plan have an exposure.")
        return illumination_plan(self.lights(array), exposure_ms=exposed_ms, average=self.average)

    def lights(self, array: LedPlaces | None) -> Sequence[Light]:
        """Return the lights in turn; errors as :meth:`plan`."""
        if self.groups is not None:
            return group_lights(self.groups, self.level)
        shape = led_shape(*shape_from_text(self.pattern or f"grid side={self.lattice}"))
        if array is None:
            raise BenchError(
                "Patterns by place need the bench's LED array, and this bench has none. Give --groups."
            )
        rgb = None if self.level == 255 else (self.level, self.level, self.level)
        return [Light.named(one, rgb) for one in shape.series(array)]
