"""Named LED patterns, by which plans, terminal and window light the array.

A new one is a subclass of :class:`instrument.plan.led_shapes.LedShape` in a file of its own and one word in
``_own`` here; or, in an installed package, an entry point of ``diffuserbench.led_patterns``.

They are written ``NAME OPTION=VALUE ...``: ``"half side=left na=0.3"``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from drivers.led_array import LedPattern
from instrument.files.errors import BenchError
from instrument.plan.led_shapes import (
    WHITE,
    Annulus,
    BrightField,
    DarkField,
    GridCell,
    HalfCircle,
    LedPlaces,
    LedShape,
    Single,
)
from instrument.plan.positions import PlanData
from recon.base.declare import changed, options_of, require, with_overrides
from recon.base.registry import Registry
from recon.errors import InputError


def _own() -> list[type[LedShape]]:
    return [BrightField, DarkField, HalfCircle, Annulus, Single, GridCell]


LED_PATTERNS: Registry[type[LedShape]] = Registry("LED pattern", "diffuserbench.led_patterns", _own)


def led_shape(name: str, options: Mapping[str, Any] | None = None) -> LedShape:
    """Return a named pattern with options.

    Raises InputError when nothing has the name, or an option is not known or out of its limits.
    """
    shape = with_overrides(LED_PATTERNS.named(name)(), options or {})
    require(shape)
    return shape


def shape_from_text(text: str) -> tuple[str, dict[str, Any]]:
    """Return name and options of a pattern written ``"half side=left na=0.3"``; not looked up yet.

    Raises InputError when it is written otherwise.
    """
    name, *words = text.split()
    options: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not (key and equals and value):
            raise InputError(
                f"{word!r} in {text!r} is no option; write NAME OPTION=VALUE, as in 'half na=0.3'."
            )
        options[key] = _value(value)
    return name, options


def shape_text(shape: LedShape) -> str:
    """Return how a pattern is written; options as by default are left out."""
    return " ".join([shape.name, *(f"{option.name}={value}" for option, value in changed(shape))])


def shape_buttons() -> dict[str, LedShape]:
    """Return what a window offers as buttons: their words, and the pattern.

    A pattern without presets has one button of its name.
    """
    return {
        words: led_shape(shape.name, options)
        for shape in LED_PATTERNS.values()
        for words, options in (shape.presets or {shape.name.replace("-", " ").capitalize(): {}}).items()
    }


def pattern_help() -> str:
    """Return the patterns that there are with their options, one a line."""
    lines = []
    for shape in LED_PATTERNS.values():
        options = ", ".join(f"{o.name} ({o.default})" for o in options_of(shape))
        lines.append(f"{shape.name}: {shape.help}. {options}.")
    return "\n".join(lines)


def _value(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


Level = Annotated[int, Field(ge=0, le=255)]
_WITHOUT_SHAPE = ("off", "source", "pattern")
"""Kinds of light that are no patterns by name."""


class Light(PlanData):
    """What the LED array shows during a step.

    ``off``: dark. ``source``: the bench's point source, as ``bench.toml`` describes it. ``pattern``: the
    listed LEDs, ``leds`` as ``[index, red, green, blue]`` with levels 0 to 255. Any other kind is a pattern
    of :mod:`instrument.plan.patterns` by name, its options beside it, in the colour ``rgb`` (white); the LEDs
    are found by :meth:`on` when the array is known.
    """

    kind: str
    description: str = ""
    leds: tuple[tuple[Annotated[int, Field(ge=0)], Level, Level, Level], ...] = ()
    rgb: tuple[Level, Level, Level] | None = None
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _options_beside(cls, data: Any) -> Any:
        """Take the options of a named pattern from beside its kind, or from a kind with options behind it."""
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        kind = data.get("kind")
        if isinstance(kind, str) and len(kind.split()) > 1:
            data["kind"], written = shape_from_text(kind)
            data = {**written, **data}
        if data.get("kind") not in _WITHOUT_SHAPE:
            given = dict(data.get("options", {}))
            given |= {name: data.pop(name) for name in list(data) if name not in cls.model_fields}
            data["options"] = given
        return data

    @model_validator(mode="after")
    def _kind_and_the_rest_agree(self) -> Light:
        if (self.kind == "pattern") != bool(self.leds):
            raise ValueError('leds belong to kind = "pattern", which needs at least one')
        if self.kind in _WITHOUT_SHAPE and (self.options or self.rgb is not None):
            raise ValueError(f'kind = "{self.kind}" has no options and no rgb')
        if self.is_named and self.kind not in LED_PATTERNS:
            known = ", ".join((*_WITHOUT_SHAPE, *LED_PATTERNS))
            raise ValueError(f"light {self.kind!r} is not known; there are {known}")
        if self.is_named:
            led_shape(self.kind, self.options)
        return self

    @model_serializer(mode="wrap")
    def _with_options_beside(self, dumped: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data: dict[str, Any] = dumped(self)
        options = data.pop("options", {})
        if self.rgb is None:
            data.pop("rgb", None)
        return {**data, **options}

    @classmethod
    def of(cls, pattern: LedPattern) -> Light:
        """Return the light of a pattern that was composed for an LED array."""
        leds = tuple((index, *rgb) for index, rgb in pattern.levels)
        if not leds:
            return OFF
        return cls(kind="pattern", description=pattern.description, leds=leds)

    @classmethod
    def named(cls, shape: LedShape, rgb: tuple[int, int, int] | None = None) -> Light:
        """Return the light of a named pattern."""
        options = {option.name: value for option, value in changed(shape)}
        return cls(kind=shape.name, rgb=rgb, options=options)

    @property
    def is_named(self) -> bool:
        """Whether it is a pattern by name, whose LEDs :meth:`on` finds."""
        return self.kind not in _WITHOUT_SHAPE

    def on(self, array: LedPlaces) -> Light:
        """Return the light with its LEDs listed, for an array; itself where it is no pattern by name."""
        if not self.is_named:
            return self
        return Light.of(led_shape(self.kind, self.options).on(array, self.rgb or WHITE))

    def pattern(self) -> LedPattern:
        """Return the LED pattern of a light of kind ``pattern``."""
        name = self.description or f"LEDs {', '.join(str(led[0]) for led in self.leds)}"
        return LedPattern(name, tuple((led[0], (led[1], led[2], led[3])) for led in self.leds))

    def __str__(self) -> str:
        if self.is_named:
            colour = "" if self.rgb is None else f" rgb {self.rgb}"
            return shape_text(led_shape(self.kind, self.options)) + colour
        return self.kind if self.kind != "pattern" else self.pattern().description


OFF = Light(kind="off")
SOURCE = Light(kind="source")

MOST_NAMED = 8
"""LEDs of a group that its description names."""


def group_lights(groups: Sequence[Sequence[int]], level: int = 255) -> list[Light]:
    """Return the lights of groups of LEDs by number, every LED at one level.

    Raises BenchError when a group is empty, or the level out of range.
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

    Raises BenchError when it is something else.
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
