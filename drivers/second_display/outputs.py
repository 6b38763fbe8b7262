"""The options of a second display, the outputs that a desktop has, and which of them is meant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import Field, model_validator

from drivers.device import DriverOptions
from drivers.errors import DeviceError

Side = Annotated[int, Field(ge=1, le=16384)]


class SecondDisplayOptions(DriverOptions):
    """Options of an SLM connected as a second display; the output is named by what is given, all of it."""

    output: str | None = Field(
        None, min_length=1, description='Name of the output, e.g. "HDMI-1" (diffuserbench devices).'
    )
    model: str | None = Field(None, min_length=1, description="Model that the display reports (EDID).")
    serial_number: str | None = Field(
        None, min_length=1, description="Serial number that the display reports (EDID)."
    )
    index: int | None = Field(
        None, ge=0, description="Number in the list of outputs; changes with what is plugged in."
    )
    shape: tuple[Side, Side] | None = Field(
        None, description="Expected [height, width]; an output in another mode is refused."
    )
    pixel_pitch_um: float = Field(gt=0, description="Pixel pitch, from the SLM's data sheet.")
    settle_ms: float = Field(
        50.0, ge=0, description="From the pattern sent to settled optics: the liquid crystal's response."
    )
    refreshes_to_wait: int = Field(
        2,
        ge=0,
        le=20,
        description=(
            "Refreshes of the output until a drawn pattern was sent whole, waited for before settle_ms: "
            "2 without, 3 with a desktop that composites."
        ),
    )
    check_by_screenshot: bool = Field(
        False, description="Compare a screenshot with each pattern; not possible under Wayland."
    )
    allow_primary: bool = Field(
        False, description="Whether the desktop's primary output may be covered, too."
    )

    @property
    def wanted(self) -> dict[str, str | int]:
        """What names the output: all that is given."""
        return self.model_dump(include={"output", "model", "serial_number", "index"}, exclude_none=True)

    @model_validator(mode="after")
    def _names_an_output(self) -> Self:
        if not self.wanted:
            raise ValueError("name the output by output, model, serial_number or index")
        return self


_EXACT_DEPTHS = (24, 32)


@dataclass(frozen=True, slots=True)
class Output:
    """One output, in the pixels that are sent to it: never those of a scaled desktop."""

    index: int
    name: str
    manufacturer: str
    model: str
    serial_number: str
    width: int
    height: int
    refresh_hz: float
    depth: int
    """Bits a pixel; 24 or 32 have 8 for each colour."""
    primary: bool

    def __str__(self) -> str:
        who = " ".join(word for word in (self.manufacturer, self.model) if word)
        return (
            f"{self.name} (index {self.index}, {who or 'unnamed display'}, {self.width} x {self.height}"
            f"{', primary' if self.primary else ''})"
        )


def choose(outputs: Sequence[Output], options: SecondDisplayOptions, device: str) -> Output:
    """Return the one output that is meant and that can show 8-bit levels exactly.

    Raises DeviceError when none or several fit what was given, or the one that fits is the desktop's primary
    output, has another shape than expected, or too few bits a pixel.
    """
    wanted = options.wanted
    fitting = [
        output
        for output in outputs
        if all(getattr(output, "name" if key == "output" else key) == value for key, value in wanted.items())
    ]
    asked = ", ".join(f"{key} = {value!r}" for key, value in wanted.items())
    there = f"Outputs there are: {'; '.join(map(str, outputs)) or 'none'}."
    if not fitting:
        raise DeviceError(
            device, f"there is no output with {asked}.", f"{there} Is it plugged in and switched on?"
        )
    if len(fitting) > 1:
        raise DeviceError(device, f"several outputs have {asked}.", f"{there} Name one by output or index.")
    output = fitting[0]
    if output.primary and not options.allow_primary:
        raise DeviceError(
            device,
            f"{output.name} is the desktop's primary output, which the pattern would cover.",
            "Make another output the primary one, or set allow_primary = true.",
        )
    if options.shape is not None and (output.height, output.width) != options.shape:
        height, width = options.shape
        swapped = (output.width, output.height) == (height, width)
        raise DeviceError(
            device,
            f"{output.name} is in mode {output.width} x {output.height} (width x height), "
            f"not {width} x {height} as shape = [{height}, {width}] says ([height, width]).",
            f"Write shape = [{output.height}, {output.width}], or turn the output back if it was rotated."
            if swapped
            else "Choose the SLM's own resolution, without scaling, in the desktop's display settings.",
        )
    if output.depth not in _EXACT_DEPTHS:
        raise DeviceError(
            device,
            f"{output.name} has {output.depth} bits a pixel; 8-bit levels are exact with 24 or 32.",
            "Set the display server's colour depth to 24.",
        )
    return output
