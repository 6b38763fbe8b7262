"""What is lit while a photograph is taken: the scene, the point source, LEDs, or nothing."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drivers.led_array import LedPattern
from instrument.bench.photograph import SPOILT
from recon.base.checks import many_saturated

if TYPE_CHECKING:
    from instrument.bench.bench import Bench


class LightState(enum.StrEnum):
    """What is lit while a photograph is taken."""

    SCENE = "scene"
    SOURCE = "source"
    DARK = "dark"
    AS_IS = "as-is"


def spoilt(saturated_share: float, n_pixels: int, light: LightState) -> bool:
    """Whether so large a share of saturated pixels spoils a photograph of so many pixels in this light.

    Of the point source as a PSF is judged, whose brightest pixels explain every later photograph.
    """
    if light is LightState.SOURCE:
        return many_saturated(saturated_share, n_pixels)
    return saturated_share > SPOILT


def switch_light(bench: Bench, light: LightState) -> None:
    """Light the scene, the point source, or nothing; ``AS_IS`` changes nothing.

    What is darkened is darkened as far as it can be: the scene also where the point source has failed.

    Raises DeviceError or BenchError when a light cannot be switched.
    """
    if light is LightState.AS_IS:
        return
    if light is LightState.DARK:
        try:
            bench.source_off()
        finally:
            bench.scene_off()
        return
    bench.source_on() if light is LightState.SOURCE else bench.source_off()
    bench.scene_on() if light is LightState.SCENE else bench.scene_off()


def light_of(bench: Bench) -> LightState:
    """Return what is lit now, as far as the program knows.

    ``AS_IS`` where no other word is true: another LED pattern than the point source, or LEDs and the scene.
    """
    pattern = led_pattern(bench)
    if pattern is None or pattern.is_dark:
        return LightState.SCENE if bench.scene_lit else LightState.DARK
    return LightState.SOURCE if bench.source_lit and not bench.scene_lit else LightState.AS_IS


def led_pattern(bench: Bench) -> LedPattern | None:
    """Return the pattern that the LED array confirmed last; None where no array is open."""
    leds = bench.led_array
    return leds.pattern if leds is not None and leds.is_open else None


@dataclass(frozen=True, slots=True)
class Lit:
    """What is lit, to the last LED, so that it can be lit again after a run has made the bench safe."""

    pattern: LedPattern | None
    scene: bool

    @classmethod
    def now(cls, bench: Bench) -> Lit:
        """Return what is lit, as far as the program knows."""
        return cls(led_pattern(bench), bench.scene_lit)

    def put_back(self, bench: Bench) -> None:
        """Light it again.

        Raises DeviceError or BenchError when a light cannot be switched.
        """
        if bench.led_array is not None and self.pattern is not None:
            bench.led_array.set_pattern(self.pattern)
        if bench.scene_lit != self.scene:
            bench.scene_on() if self.scene else bench.scene_off()
