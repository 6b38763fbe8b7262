"""The outputs that a desktop has, and which of them is meant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.errors import DeviceError
from drivers.second_display.options import SecondDisplayOptions

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

    Raises
    ------
    DeviceError
        When none or several fit what was given, or the one that fits is the desktop's primary output, has
        another shape than expected, or too few bits a pixel.
    """
    wanted = options.model_dump(include={"output", "model", "serial_number", "index"}, exclude_none=True)
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
