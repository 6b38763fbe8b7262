"""Named LED patterns, by which plans, terminal and window light the array.

A new one is a subclass of :class:`instrument.plan.led_shapes.LedShape` in a file of its own and one word in
``_own`` here; or, in an installed package, an entry point of ``diffuserbench.led_patterns``.

They are written ``NAME OPTION=VALUE ...``: ``"half side=left na=0.3"``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from instrument.plan.led_shapes import Annulus, BrightField, DarkField, GridCell, HalfCircle, LedShape, Single
from recon.base.declare import changed, options_of, require, with_overrides
from recon.base.registry import Registry
from recon.errors import InputError


def _own() -> list[type[LedShape]]:
    return [BrightField, DarkField, HalfCircle, Annulus, Single, GridCell]


LED_PATTERNS: Registry[type[LedShape]] = Registry("LED pattern", "diffuserbench.led_patterns", _own)


def led_shape(name: str, options: Mapping[str, Any] | None = None) -> LedShape:
    """Return a named pattern with options.

    Raises
    ------
    InputError
        When nothing has the name, or an option is not known or out of its limits.
    """
    shape = with_overrides(LED_PATTERNS.named(name)(), options or {})
    require(shape)
    return shape


def shape_from_text(text: str) -> tuple[str, dict[str, Any]]:
    """Return name and options of a pattern written ``"half side=left na=0.3"``; not looked up yet.

    Raises
    ------
    InputError
        When it is written otherwise.
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
