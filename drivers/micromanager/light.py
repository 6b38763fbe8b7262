"""Lights that Micro-Manager's shutters, state devices and intensities make, as an LED array."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, Setting, SharedPart
from drivers.errors import DeviceError, LimitError
from drivers.led_array import OFF, LedArray, LedPattern
from drivers.micromanager.core import MicroManagerDevice, Part, PropertyValue

_FULL = 255


class Channel(BaseModel):
    """One colour of one light: how it is switched on, off and dimmed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    shutter: str | None = Field(None, description="Label of the shutter that lets it through.")
    device: str | None = Field(None, description="Label of the device that dims it, or of a state device.")
    intensity: str | None = Field(None, description="Property of ``device`` that is its brightness.")
    full: float = Field(1.0, gt=0, description="Value of ``intensity`` at level 255; 0 is dark.")
    state: str | None = Field(None, description="Label of the position of the state device ``device``.")
    state_off: str | None = Field(None, description="Position when dark; left out: it stays.")

    @model_validator(mode="after")
    def _can_be_dark(self) -> Channel:
        if self.intensity is not None and self.state is not None:
            raise ValueError("intensity and state exclude each other: a device dims, or has positions")
        if (self.intensity is not None or self.state is not None) and self.device is None:
            raise ValueError("device is needed: the one whose intensity or state this is")
        if self.shutter is None and self.intensity is None and self.state_off is None:
            raise ValueError("shutter, intensity or state_off is needed: else it could never be dark")
        return self


class Light(BaseModel):
    """One light: where its light comes from, and its colours."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    position_mm: tuple[float, float, float] = Field(
        (0.0, 0.0, 100.0), description="Where it stands: x, y, and its distance z, millimetres."
    )
    white: Channel | None = Field(None, description="Its only colour, in place of red, green and blue.")
    red: Channel | None = Field(None, description="Its red.")
    green: Channel | None = Field(None, description="Its green.")
    blue: Channel | None = Field(None, description="Its blue.")

    @model_validator(mode="after")
    def _has_a_colour(self) -> Light:
        colours = [self.red, self.green, self.blue]
        if (self.white is None) == (not any(colours)):
            raise ValueError("white, or at least one of red, green and blue is needed, not both")
        return self

    @property
    def channels(self) -> tuple[Channel | None, ...]:
        """The white one, or red, green and blue."""
        return (self.white,) if self.white else (self.red, self.green, self.blue)


class MicroManagerLightOptions(DriverOptions):
    """Lights of Micro-Manager as an LED array: light 0, light 1, ..."""

    lights: list[Light] = Field(min_length=1, description="[[led_array.lights]]: the lights, in their order.")
    wavelengths_nm: tuple[float, float, float] = Field(
        (630.0, 530.0, 460.0), description="Centre wavelengths of red, green and blue, nanometres."
    )
    properties: dict[str, dict[str, PropertyValue]] = Field(
        default_factory=dict, description="Properties to set on opening, by the device's label."
    )


class MicroManagerLight(MicroManagerDevice, LedArray):
    """Lights by shutters, state devices and intensities; dark by all of them after opening and closing."""

    Options = MicroManagerLightOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self.options = MicroManagerLightOptions.of(options)
        self._share(shared)
        self._parts: dict[str, Part] = {}
        self._pattern = OFF
        self._identity: DeviceIdentity | None = None

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim every device that makes light."""
        return tuple(
            f"Micro-Manager light {label}" for label in sorted(_labels(MicroManagerLightOptions.of(options)))
        )

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return nothing: the camera's driver lists the installation."""
        return ()

    @property
    def name(self) -> str:
        """The lights as error messages name them."""
        return "led_array (micromanager)"

    # Opening ---------------------------------------------------------------------------------------
    @property
    def is_open(self) -> bool:
        """Whether the lights are connected."""
        return self._identity is not None

    def open(self) -> None:
        """Load Micro-Manager's devices and put every light out."""
        if self.is_open:
            return
        core = self._acquire()
        try:
            core.setAutoShutter(False)  # the camera must not open shutters by itself
            self._parts = {label: self._part(label, "Shutter") for label in sorted(_labels(self.options))}
            for label, values in self.options.properties.items():
                self._part(label, "Shutter").set_all(values)
            self._identity = next(iter(self._parts.values())).identity("led_array")
            self.off()
        except BaseException:
            self._identity = None
            self._release()
            raise

    def close(self) -> None:
        """Put every light out and let go of the devices."""
        if not self.is_open:
            return
        try:
            self.off()
        finally:
            self._identity = None
            self._release()

    @property
    def identity(self) -> DeviceIdentity:
        """Who the devices are."""
        self._require_core()
        assert self._identity is not None
        return self._identity

    def settings(self) -> Mapping[str, Setting]:
        """Read the pattern, and every property of every device."""
        self._require_core()
        made: dict[str, Setting] = {"pattern": self._pattern.description, "n_leds": len(self.options.lights)}
        for label, part in self._parts.items():
            made |= {f"{label}.{key}": value for key, value in part.settings().items()}
        return made

    # What the array is -----------------------------------------------------------------------------
    @property
    def led_positions_mm(self) -> npt.NDArray[np.float64]:
        """``(n_leds, 3)`` places of the lights, as configured."""
        return np.array([light.position_mm for light in self.options.lights], np.float64)

    @property
    def led_na(self) -> npt.NDArray[np.float64]:
        """``(n_leds, 2)`` sines of the illumination angle, from the places."""
        places = self.led_positions_mm
        distances: npt.NDArray[np.float64] = np.linalg.norm(places, axis=1, keepdims=True)
        sines: npt.NDArray[np.float64] = places[:, :2] / distances
        return sines

    @property
    def wavelengths_nm(self) -> tuple[float, float, float]:
        """Centre wavelengths, as configured."""
        return self.options.wavelengths_nm

    # Light -----------------------------------------------------------------------------------------
    @property
    def pattern(self) -> LedPattern:
        """The pattern shown now."""
        self._require_core()
        return self._pattern

    def check(self, pattern: LedPattern) -> None:
        """Refuse levels and colours that these lights do not have, and two positions of one state device."""
        super().check(pattern)
        states: dict[str, str] = {}
        for channel, level, what in self._levels(pattern):
            if channel is None:
                raise LimitError(
                    self.name, f"cannot show {what}: it has no such colour.", "Choose another one."
                )
            if channel.intensity is None and level not in (0, _FULL):
                raise LimitError(
                    self.name, f"cannot show {what}: it is on or off.", "Its levels are 0 and 255."
                )
            if level and channel.state is not None:
                assert channel.device is not None
                if states.setdefault(channel.device, channel.state) != channel.state:
                    raise LimitError(
                        self.name,
                        f"cannot show {what}: {channel.device} would have to stand at "
                        f"{states[channel.device]!r} and at {channel.state!r}.",
                        "Light them one after the other.",
                    )

    def set_pattern(self, pattern: LedPattern) -> LedPattern:
        """Show a pattern: what goes out first, then what lights up; read back from the devices."""
        self._require_core()
        self.check(pattern)
        lit = [(channel, level) for channel, level, _ in self._levels(pattern) if channel and level]
        self._darken(keep=[channel for channel, _ in lit])
        self._pattern = pattern
        for channel, level in lit:
            self._light_up(channel, level)
        return pattern

    def off(self) -> None:
        """Put every light out, each even when another fails."""
        self._require_core()
        self._darken(keep=())
        self._pattern = OFF

    # Inside ----------------------------------------------------------------------------------------
    def _levels(self, pattern: LedPattern) -> list[tuple[Channel | None, int, str]]:
        """Return what each channel is to show, and how to call it in an error."""
        wanted: list[tuple[Channel | None, int, str]] = []
        for led, rgb in pattern.levels:
            light = self.options.lights[led]
            if light.white:
                if len(set(rgb)) > 1:
                    raise LimitError(
                        self.name, f"cannot show {rgb} on LED {led}: it is white.", "Give equal levels."
                    )
                wanted.append((light.white, rgb[0], f"level {rgb[0]} on LED {led}"))
                continue
            for channel, level, colour in zip(light.channels, rgb, ("red", "green", "blue"), strict=True):
                if channel or level:
                    wanted.append((channel, level, f"{colour} level {level} on LED {led}"))
        return wanted

    def _all(self) -> list[Channel]:
        return [channel for light in self.options.lights for channel in light.channels if channel]

    def _darken(self, keep: Any) -> None:
        """Put out every channel that is not to be kept; of shutters that one kept shares, only the rest."""
        open_shutters = {channel.shutter for channel in keep}
        dimmed = {(channel.device, channel.intensity) for channel in keep}
        errors: list[DeviceError] = []
        for channel in self._all():
            if channel in keep:
                continue
            try:
                if channel.shutter and channel.shutter not in open_shutters:
                    self._shut(channel.shutter, is_open=False)
                if channel.intensity and (channel.device, channel.intensity) not in dimmed:
                    self._set(channel.device, channel.intensity, 0.0)
                if channel.state_off and channel.device not in {kept.device for kept in keep}:
                    self._state(channel.device, channel.state_off)
            except DeviceError as error:
                errors.append(error)
        if errors:
            for another in errors[1:]:
                errors[0].add_note(f"And: {another}")
            raise errors[0]

    def _light_up(self, channel: Channel, level: int) -> None:
        if channel.state:
            self._state(channel.device, channel.state)
        if channel.intensity:
            self._set(channel.device, channel.intensity, channel.full * level / _FULL)
        if channel.shutter:
            self._shut(channel.shutter, is_open=True)

    def _shut(self, label: str, *, is_open: bool) -> None:
        part, word = self._parts[label], "open" if is_open else "shut"
        part.call(word, "setShutterOpen", is_open)
        part.call(f"wait until it is {word}", "waitForDevice")
        if bool(part.call("say whether it is open", "getShutterOpen")) != is_open:
            raise DeviceError(
                self.name, f"the shutter {label!r} was told to {word} and did not.", "Check it."
            )

    def _set(self, label: str | None, name: str, value: float) -> None:
        assert label is not None
        made = float(self._parts[label].set(name, value))
        if abs(made - value) > 0.01 * max(abs(value), 1e-3) + 0.5 * (
            value != round(value) and made == round(made)
        ):
            raise DeviceError(
                self.name, f"{label} {name} was set to {value:g} and is {made:g}.", "Check ``full``."
            )

    def _state(self, label: str | None, state: str) -> None:
        assert label is not None
        part = self._parts[label]
        part.call(f"go to {state!r}", "setStateLabel", state)
        part.call(f"wait until it is at {state!r}", "waitForDevice")
        if (made := part.call("say where it stands", "getStateLabel")) != state:
            raise DeviceError(
                self.name, f"{label} was sent to {state!r} and stands at {made!r}.", "Check it."
            )


def _labels(options: MicroManagerLightOptions) -> set[str]:
    """Return the labels of all devices that the lights need."""
    channels = [channel for light in options.lights for channel in light.channels if channel]
    return {label for channel in channels for label in (channel.shutter, channel.device) if label}
