"""Point source and scene: what lights them, where the source is, and the optics as devices know them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from drivers.camera import Camera
from drivers.device import SharedPart
from drivers.led_array import LedArray, LedPattern
from drivers.stage import Stage
from instrument.bench.config import GeometryTable, SceneTable, SourceTable
from instrument.files.errors import BenchError, OperatorNeededError
from recon.types import Geometry

Ask = Callable[[str], None]
"""Asks the operator to do something by hand and returns when it is done."""


@runtime_checkable
class SceneSwitch(Protocol):
    """A shared part that can light and darken the scene: the simulated world."""

    scene_lit: bool


@runtime_checkable
class LedsOnScene(Protocol):
    """A shared part that says whether the LED array lights the scene, and no point source: the same world."""

    leds_light_scene: bool


class Lights:
    """Switches point source and scene, asking the operator where no device can do it."""

    def __init__(
        self,
        source: SourceTable,
        scene: SceneTable,
        led_array: LedArray | None,
        scene_switch: SceneSwitch | None,
        ask: Ask | None,
    ) -> None:
        self._source = source
        self._led_array = led_array
        self._by_operator = scene.control == "operator"
        self.scene_switch = scene_switch
        self.ask = ask
        self._asked: dict[str, bool] = {}

    @property
    def can_switch_source(self) -> bool:
        """Whether the point source can be lit and darkened: by the LED array, or by asking the operator."""
        return self._led_array is not None or self.ask is not None

    @property
    def no_source(self) -> str:
        """Why the LED array lights no point source here; empty where it does, or there is no array."""
        world: object = self.scene_switch
        if self._led_array is None or not (isinstance(world, LedsOnScene) and world.leds_light_scene):
            return ""
        return (
            'The LED array lights the scene here, and no point source (led_light = "scene" in '
            '[simulated]). Calibrate with led_light = "source", which is the same camera.'
        )

    @property
    def can_switch_scene(self) -> bool:
        """Whether the scene can be lit and darkened: by the simulated world, or by asking the operator."""
        return self.ask is not None if self._by_operator else self.scene_switch is not None

    @property
    def scene_lit(self) -> bool:
        """Whether the scene is lit, as far as is known."""
        if self._by_operator:
            return self._asked.get("the scene", False)
        return self.scene_switch is not None and self.scene_switch.scene_lit

    @property
    def knows_scene(self) -> bool:
        """Whether ``scene_lit`` is known: of a scene that the operator lights, once he was asked."""
        return not self._by_operator or "the scene" in self._asked

    def is_source(self, pattern: LedPattern) -> bool:
        """Whether a pattern is the point source as it is configured: these LEDs so bright, and no others."""
        lit = {led: rgb for led, rgb in pattern.levels if any(rgb)}
        return bool(lit) and lit == dict.fromkeys(self._source.leds, self._source.rgb)

    @property
    def source_pattern(self) -> LedPattern:
        """The point source as it is configured."""
        leds, rgb = self._source.leds, self._source.rgb
        words = f"point source: LED {', '.join(map(str, leds))} rgb {rgb}"
        return LedPattern(words, tuple((led, rgb) for led in leds))

    def switch_source(self, *, lit: bool) -> None:
        """Light or darken the point source; confirmed when this returns.

        Raises BenchError where the simulated world's LED array lights the scene instead: what is taken for a
        PSF would be the scene. OperatorNeededError when nobody can be asked.
        """
        if lit and self.no_source:
            raise BenchError(self.no_source)
        if self._led_array is None:
            self._ask_once("the point source", lit=lit)
        elif lit:
            self._led_array.set_pattern(self.source_pattern)
        else:
            self._led_array.off()

    def switch_scene(self, *, lit: bool) -> None:
        """Light or darken the scene.

        Raises BenchError when the configuration leaves it to a simulated world that is not there;
        OperatorNeededError when nobody can be asked.
        """
        if self._by_operator:
            self._ask_once("the scene", lit=lit)
        elif self.scene_switch is None:
            raise BenchError(
                'bench.toml says [scene] control = "simulated", but no device of this bench is simulated. '
                'Set it to "operator".'
            )
        else:
            self.scene_switch.scene_lit = lit

    def _ask_once(self, what: str, *, lit: bool) -> None:
        if self._asked.get(what) == lit:
            return
        request = f"Please {'light' if lit else 'darken'} {what}."
        if self.ask is None:
            raise OperatorNeededError(
                f"{request} Nobody can be asked here: use a terminal (in Python: open_bench(..., ask=))."
            )
        self.ask(request)
        self._asked[what] = lit


@runtime_checkable
class KnownOptics(Protocol):
    """A shared part that knows the optics between scene and sensor: the simulated world."""

    distance_um: float
    """From the diffuser to the sensor."""
    aperture_mm: tuple[float, float]
    """``(height, width)``."""


def known_geometry(table: GeometryTable, camera: Camera, shared: Iterable[SharedPart]) -> Geometry:
    """Return the geometry for the camera's present binning; what nobody knows stays None."""
    known = next((part for part in shared if isinstance(part, KnownOptics)), None)
    distance_mm, aperture_mm = (known.distance_um / 1e3, known.aperture_mm) if known else (None, None)
    return Geometry(
        pixel_pitch_um=(table.pixel_pitch_um or camera.pixel_pitch_um) * camera.binning,
        diffuser_distance_mm=table.diffuser_distance_mm or distance_mm,
        aperture_mm=table.aperture_mm or aperture_mm,
        wavelength_nm=table.wavelength_nm,
    )


Position = tuple[float, float, float]
AXES = ("x_um", "y_um", "z_um")


@dataclass(frozen=True, slots=True)
class SourceMount:
    """The point source on its stage."""

    stage: Stage
    offset_um: Position
    """Where the source is, from the diffuser's centre, when every axis reads zero."""

    @property
    def position_um(self) -> Position:
        """Where the source is now, as the stage reads."""
        reading = self.stage.position()
        x, y, z = (reading.get(axis, 0.0) + offset for axis, offset in zip(AXES, self.offset_um, strict=True))
        return (x, y, z)

    def target(self, x_um: float | None, y_um: float | None, z_um: float | None) -> dict[str, float]:
        """Return the stage position that brings the source to a place; None leaves a coordinate as it is.

        Raises BenchError when the stage lacks the axis that would have to move.
        """
        axes = {axis.name for axis in self.stage.axes}
        target = {}
        for axis, value, offset in zip(AXES, (x_um, y_um, z_um), self.offset_um, strict=True):
            if value is None:
                continue
            if axis in axes:
                target[axis] = value - offset
            elif abs(value - offset) > 1e-6:
                raise BenchError(
                    f"{self.stage.name} has no axis {axis}, so the source stays at {axis} = {offset:g}; "
                    f"it cannot go to {value:g}. Axes: {', '.join(sorted(axes))}."
                )
        return target
