"""The simulated LED array."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import partial
from typing import ClassVar

import numpy as np
from pydantic import Field

from drivers.device import DriverOptions, Setting, SharedPart
from drivers.errors import DeviceError, StoppedError
from drivers.led_array import OFF, LedArray, LedPattern
from drivers.sequence import SequenceLimits
from drivers.simulated.scene_light import Lamp, SceneLight
from drivers.simulated.surroundings import SimulatedDevice, Surroundings
from drivers.simulated.wire import LED_LINE
from drivers.simulated.world import SimulatedWorld
from recon.arrays import Float64Array
from recon.optics.grid import BANDS


class LedArrayOptions(DriverOptions):
    """Options of the simulated LED array in ``bench.toml``."""

    leds: int = Field(257, ge=1, le=10_000, description="Number of LEDs.")
    led_pitch_mm: float = Field(4.0, gt=0, description="Spacing of the LEDs.")
    distance_mm: float = Field(60.0, gt=0, description="From the array to its centre of view.")
    command_ms: float = Field(0.0, ge=0, description="What one command takes: none by default.")


class SimulatedLedArray(SimulatedDevice, LedArray):
    """A round, flat array of RGB LEDs on a square grid, the one with index 0 in its middle.

    It lights the pinhole that serves as point source from behind, each LED by the cosine fourth of the angle
    under which the pinhole sees it, so that the middle one counts most. With ``led_light = "scene"`` of
    ``[simulated]`` it lights the scene instead, each place by the same law from every LED.
    """

    kind = "led_array"
    Shared: ClassVar[type[Surroundings]] = SimulatedWorld
    model = "round LED array"
    Options: ClassVar[type[LedArrayOptions]] = LedArrayOptions
    world: SimulatedWorld

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self._join(shared)
        self.options = options = LedArrayOptions.of(options)
        self._positions_mm = _round_array(options.leds, options.led_pitch_mm)
        self._pattern = OFF
        self._armed: tuple[tuple[LedPattern, ...], float] | None = None
        self._darkened = threading.Event()

    def open(self) -> None:
        """Connect; every LED is off."""
        self.world.check_plugged(self.kind, self.name)
        self._is_open = True
        self._show(OFF)

    def close(self) -> None:
        """Turn every LED off and disconnect."""
        if self._is_open:
            self._darkened.set()
            self._show(OFF)
            self._is_open, self._armed = False, None

    def settings(self) -> Mapping[str, Setting]:
        """Read the pattern and the array's build."""
        self._require()
        return {
            "pattern": self._pattern.description,
            "leds": self.options.leds,
            "wavelengths_nm": self.wavelengths_nm,
            "distance_mm": self.options.distance_mm,
        }

    @property
    def led_positions_mm(self) -> Float64Array:
        """``(n_leds, 3)`` positions, millimetres."""
        return self._positions_mm.copy()

    @property
    def led_na(self) -> Float64Array:
        """``(n_leds, 2)`` sines of the illumination angle in x and y."""
        across = self._positions_mm[:, :2]
        distance = np.sqrt((across**2).sum(axis=1) + self.options.distance_mm**2)
        return np.asarray(across / distance[:, None])

    @property
    def wavelengths_nm(self) -> tuple[float, float, float]:
        """Centre wavelengths of red, green and blue."""
        red, green, blue = BANDS
        return red.center_nm, green.center_nm, blue.center_nm

    @property
    def pattern(self) -> LedPattern:
        """The pattern shown now."""
        return self._pattern

    def set_pattern(self, pattern: LedPattern) -> LedPattern:
        """Show a pattern."""
        self._require()
        self.check(pattern)
        self._darkened.clear()
        self._command()
        self._show(pattern)
        return self._pattern

    def off(self) -> None:
        """Turn every LED off."""
        self._require()
        self._darkened.set()
        self._show(OFF)

    @property
    def sequence_limits(self) -> SequenceLimits:
        """As an Illuminate array has them."""
        return SequenceLimits(most=1000, shortest_ms=1.0, outputs=1)

    def arm(self, patterns: Sequence[LedPattern], period_ms: float, output: int = 0) -> float:
        """Store a sequence."""
        self._require()
        self._check_sequence(len(patterns), period_ms, output)
        for pattern in patterns:
            self.check(pattern)
        if self._armed is None or self._armed[0] != tuple(patterns):  # each is a command
            self._darkened.clear()
            self._command(len(patterns))
        self._armed = (tuple(patterns), period_ms)
        return period_ms

    def play(self) -> None:
        """Show the armed sequence once, with a pulse to the camera for each pattern."""
        self._require()
        if self._armed is None:
            raise DeviceError(self.name, "has no sequence to play.", "Arm one first.")
        patterns, period_ms = self._armed
        self._darkened.clear()
        shown = [partial(self._show_unless_darkened, pattern) for pattern in patterns]
        dark = partial(self._show, OFF)
        whole = self.world.wires.play(
            LED_LINE, shown, dark, period_s=1e-3 * period_ms, settle_s=0.0, ended=self._darkened
        )
        self._show(OFF)
        self._require()
        if not whole:
            raise StoppedError(self.name, "the light was turned off during its sequence.")

    def _command(self, count: int = 1) -> None:
        """Take the time of commands; nothing is shown once the light was turned off meanwhile."""
        if not self.world.clock.wait(1e-3 * self.options.command_ms * count, self._darkened):
            raise StoppedError(self.name, "the light was turned off meanwhile.")

    def _show_unless_darkened(self, pattern: LedPattern) -> None:
        self._show(OFF if self._darkened.is_set() else pattern)

    def _show(self, pattern: LedPattern) -> None:
        if self.world.options.led_light == "scene":
            self._pattern = pattern
            lamps = tuple(
                Lamp(
                    1e3 * float(self._positions_mm[index, 0]),
                    1e3 * float(self._positions_mm[index, 1]),
                    (rgb[0] / 255, rgb[1] / 255, rgb[2] / 255),
                )
                for index, rgb in sorted(pattern.levels)
                if any(rgb)
            )
            self.world.light_scene(SceneLight(lamps, 1e3 * self.options.distance_mm) if lamps else None)
            return
        across_mm = np.hypot(self._positions_mm[:, 0], self._positions_mm[:, 1])
        weights = (1 + (across_mm / self.options.distance_mm) ** 2) ** -2
        levels = dict(pattern.levels)
        red, green, blue = (
            float(sum(weights[index] * rgb[band] / 255 for index, rgb in levels.items())) for band in range(3)
        )
        self._pattern = pattern
        self.world.set_emission((red, green, blue))


def _round_array(count: int, pitch_mm: float) -> Float64Array:
    """Return the ``count`` places of a square grid nearest to its middle, from the middle outwards."""
    reach = int(np.ceil(np.sqrt(count)))
    axis = np.arange(-reach, reach + 1)
    y, x = (side.ravel() for side in np.meshgrid(axis, axis, indexing="ij"))
    order = np.lexsort((np.arctan2(y, x), x**2 + y**2))[:count]
    return np.stack([x[order] * pitch_mm, y[order] * pitch_mm, np.zeros(count)], axis=1)
