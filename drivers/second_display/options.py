"""The keys of an SLM's table in ``bench.toml`` when it is a second display."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from drivers.device import DriverOptions

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

    @model_validator(mode="after")
    def _names_an_output(self) -> Self:
        if self.output is None and self.model is None and self.serial_number is None and self.index is None:
            raise ValueError("name the output by output, model, serial_number or index")
        return self
