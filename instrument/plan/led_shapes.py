"""LED patterns by what they are rather than by LED numbers: half circles, annuli, cells of a grid."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np

from drivers.led_array import LedPattern, Rgb
from recon.arrays import BoolArray, Float64Array
from recon.base.declare import option

LitLeds = BoolArray
WHITE: Rgb = (255, 255, 255)


class LedPlaces(Protocol):
    """What a pattern is composed for: an LED array, or its places alone."""

    @property
    def led_positions_mm(self) -> Float64Array:
        """``(n_leds, 3)``: x, y, z."""

    @property
    def led_na(self) -> Float64Array:
        """``(n_leds, 2)``: sines of the illumination angle in x and y."""


@dataclass(frozen=True)
class LedShape(ABC):
    """One named pattern; a subclass declares its options and which LEDs it lights.

    Registered in :mod:`instrument.plan.patterns`, it can be lit by plans, on the terminal and in the window.
    """

    name: ClassVar[str]
    help: ClassVar[str]
    """One line for those who choose."""
    called: ClassVar[str]
    """What logs and metadata call it, with its options in braces: ``"DPC {side} NA {na:g}"``."""
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """What the window offers as buttons: their words, and the options that differ from the defaults."""

    @abstractmethod
    def lit(self, array: LedPlaces) -> LitLeds:
        """Return which LEDs of an array are lit, ``(n_leds,)``."""

    def series(self, array: LedPlaces) -> Sequence[Self]:
        """Return the patterns of this kind that belong together, in order: all halves, all cells."""
        return (self,)

    @property
    def words(self) -> str:
        """What logs and metadata call it."""
        return self.called.format(**vars(self))

    def on(self, array: LedPlaces, rgb: Rgb = WHITE) -> LedPattern:
        """Return the pattern for an array."""
        return LedPattern.of_mask(f"{self.words} rgb {rgb}", self.lit(array), rgb)


def _na(default: float = 0.25) -> Any:
    return option(
        default, help="Numerical aperture: sine of the largest angle.", label="NA", above=0.0, most=1.0
    )


def _radius(array: LedPlaces) -> Float64Array:
    return np.hypot(array.led_na[:, 0], array.led_na[:, 1])


@dataclass(frozen=True)
class BrightField(LedShape):
    """Every LED inside an aperture."""

    name = "bright-field"
    help = "All LEDs inside the numerical aperture"
    called = "bright field NA {na:g}"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"Bright field": {}}
    na: float = _na()

    def lit(self, array: LedPlaces) -> LitLeds:
        """Return which LEDs are lit."""
        return _radius(array) <= self.na


@dataclass(frozen=True)
class DarkField(LedShape):
    """Every LED outside an aperture."""

    name = "dark-field"
    help = "All LEDs outside the numerical aperture"
    called = "dark field NA {na:g}"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"Dark field": {}}
    na: float = _na()

    def lit(self, array: LedPlaces) -> LitLeds:
        """Return which LEDs are lit."""
        return _radius(array) > self.na


SIDES = ("left", "right", "top", "bottom")


@dataclass(frozen=True)
class HalfCircle(LedShape):
    """Half of the bright field, for differential phase contrast (Kuo 2020, A.2); its edge is dark."""

    name = "half"
    help = "One half of the bright field, as for differential phase contrast"
    called = "DPC {side} NA {na:g}"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {f"DPC {side}": {"side": side} for side in SIDES}
    side: str = option("left", help="Which half.", choices=SIDES)
    na: float = _na()

    def lit(self, array: LedPlaces) -> LitLeds:
        """Return which LEDs are lit."""
        x, y = array.led_na[:, 0], array.led_na[:, 1]
        half: LitLeds = {"left": x < 0, "right": x > 0, "top": y > 0, "bottom": y < 0}[self.side]
        return half & (_radius(array) <= self.na)

    def series(self, array: LedPlaces) -> Sequence[Self]:
        """Return the four halves."""
        return [replace(self, side=side) for side in SIDES]


@dataclass(frozen=True)
class Annulus(LedShape):
    """A ring of angles."""

    name = "annulus"
    help = "All LEDs of a ring between two numerical apertures"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"Annulus": {}}
    na: float = _na()
    inner: float = option(0.8, help="Inner aperture as a share of the outer one.", least=0.0, below=1.0)

    def lit(self, array: LedPlaces) -> LitLeds:
        """Return which LEDs are lit."""
        radius = _radius(array)
        return (radius <= self.na) & (radius > self.inner * self.na)

    @property
    def words(self) -> str:
        """What logs and metadata call it."""
        return f"annulus NA {self.inner * self.na:g} to {self.na:g}"


@dataclass(frozen=True)
class Single(LedShape):
    """One LED."""

    name = "single"
    help = "One LED, by its number"
    called = "LED {led}"
    led: int = option(0, help="Its number.", label="LED", least=0)

    def lit(self, array: LedPlaces) -> LitLeds:
        """Return which LEDs are lit."""
        return np.asarray(np.arange(len(array.led_na)) == self.led)

    def series(self, array: LedPlaces) -> Sequence[Self]:
        """Return every LED of the array."""
        return [replace(self, led=led) for led in range(len(array.led_na))]


@dataclass(frozen=True)
class GridCell(LedShape):
    """One of ``side`` x ``side`` square cells of the array, by place."""

    name = "grid"
    help = "The LEDs in one cell of a square grid over the array"
    called = "cell {cell} of {side} x {side}"
    side: int = option(3, help="Cells along each axis.", least=1)
    cell: int = option(0, help="Which one, row by row from the smallest x and y.", least=0)

    def lit(self, array: LedPlaces) -> LitLeds:
        """Return which LEDs are lit."""
        across = np.asarray(array.led_positions_mm, float)[:, :2]
        low, high = across.min(axis=0), across.max(axis=0)
        extent = np.where(high > low, high - low, 1.0)
        at = np.clip(((across - low) / extent * self.side).astype(int), 0, self.side - 1)
        return np.asarray(at[:, 1] * self.side + at[:, 0] == self.cell)

    def series(self, array: LedPlaces) -> Sequence[Self]:
        """Return the cells that hold an LED, row by row."""
        cells = (replace(self, cell=cell) for cell in range(self.side**2))
        return [one for one in cells if one.lit(array).any()]
