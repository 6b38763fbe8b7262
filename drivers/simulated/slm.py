"""The simulated spatial light modulator."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.device import DriverOptions, Setting, SharedPart
from drivers.simulated.surroundings import SimulatedDevice, Surroundings
from drivers.simulated.world import SimulatedWorld
from drivers.slm import Slm, read_only

Side = Annotated[int, Field(ge=1, le=8192)]


class PanelOptions(DriverOptions):
    """Options of whatever shows grey levels."""

    shape: tuple[Side, Side] = Field((1080, 1920), description="[height, width] in pixels.")
    pixel_pitch_um: float = Field(8.0, gt=0, description="Pixel pitch.")
    settle_ms: float = Field(30.0, ge=0, description="From a confirmed image to settled optics.")


class SlmOptions(PanelOptions):
    """Options of the simulated SLM in ``bench.toml``."""

    phase_at_full_level_rad: float = Field(
        2 * np.pi * 255 / 256, gt=0, description="Phase at grey level 255."
    )
    lut_gamma: float = Field(
        1.0, gt=0, description="Phase follows (level / 255)^gamma; 1: linear, as it should be."
    )


class SimulatedPanel(SimulatedDevice, Slm):
    """Shows grey levels; what light makes of them is up to each kind."""

    kind = "slm"
    Shared: ClassVar[type[Surroundings]] = SimulatedWorld
    Options: ClassVar[type[PanelOptions]]
    options: PanelOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self._join(shared)
        self.options = options = self.Options.of(options)
        self._closing = threading.Event()
        self._displayed = np.zeros(options.shape, np.uint8)

    def open(self) -> None:
        """Connect; the SLM is blank."""
        self.world.check_plugged(self.kind, self.name)
        if not self._is_open:
            self._is_open = True
            self._closing.clear()
            self._displayed = np.zeros(self.options.shape, np.uint8)

    def close(self) -> None:
        """Blank and disconnect."""
        if self._is_open:
            self._closing.set()
            self._displayed = np.zeros(self.options.shape, np.uint8)
            self._is_open = False

    def settings(self) -> Mapping[str, Setting]:
        """Read shape, pitch, and timing."""
        self._require()
        return {
            "shape": self.options.shape,
            "pixel_pitch_um": self.options.pixel_pitch_um,
            "settle_ms": self.options.settle_ms,
            "blank": not self._displayed.any(),
        }

    @property
    def shape(self) -> tuple[int, int]:
        """``(height, width)`` in pixels."""
        return self.options.shape

    @property
    def pixel_pitch_um(self) -> float:
        """Pixel pitch, micrometres."""
        return self.options.pixel_pitch_um

    @property
    def settle_ms(self) -> float:
        """Time from a confirmed image to settled optics."""
        return self.options.settle_ms

    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        """Show grey levels and wait until the optics have settled."""
        self._require()
        self._check(levels)
        self._displayed = levels.copy()
        self.world.clock.wait(self.options.settle_ms * 1e-3, self._closing)

    @property
    def displayed(self) -> npt.NDArray[np.uint8]:
        """The grey levels shown now, read only."""
        return read_only(self._displayed)


class SimulatedSlm(SimulatedPanel):
    """A phase SLM whose grey levels turn into phase by a look-up table that may be off."""

    model = "phase SLM"
    Options = SlmOptions
    options: SlmOptions

    @property
    def phase_rad(self) -> npt.NDArray[np.float32]:
        """The phase that light truly gains at each pixel now; what no real SLM would tell."""
        table = self.options.phase_at_full_level_rad * (np.arange(256) / 255) ** self.options.lut_gamma
        return table.astype(np.float32)[self._displayed]
