"""The simulated spatial light modulator."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.device import DriverOptions, Setting, SharedPart
from drivers.errors import DeviceError, StoppedError
from drivers.sequence import SequenceLimits
from drivers.simulated.surroundings import SimulatedDevice, Surroundings
from drivers.simulated.wire import SLM_LINE
from drivers.simulated.world import SimulatedWorld
from drivers.slm import Slm, read_only
from recon.arrays import Float32Array

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

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self._armed: tuple[list[npt.NDArray[np.uint8]], float] | None = None
        self._blanked = threading.Event()

    @property
    def sequence_limits(self) -> SequenceLimits:
        """As many images as a DLPC900 stores, each settled before its pulse."""
        return SequenceLimits(400, max(1.0, self.settle_ms), 1, self.settle_ms)

    def arm(self, patterns: Sequence[npt.NDArray[np.uint8]], period_ms: float, output: int = 0) -> float:
        """Store a sequence."""
        self._require()
        self._check_sequence(len(patterns), period_ms, output)
        for levels in patterns:
            self._check(levels)
        self._armed = ([levels.copy() for levels in patterns], period_ms)
        return period_ms

    def play(self) -> None:
        """Show the armed sequence once, with a pulse to the camera for each; then what was shown before."""
        self._require()
        if self._armed is None:
            raise DeviceError(self.name, "has no sequence to play.", "Arm one first.")
        images, period_ms = self._armed
        before = self._displayed
        self._blanked.clear()
        whole = self.world.wires.play(
            SLM_LINE,
            [partial(setattr, self, "_displayed", levels) for levels in images],
            partial(setattr, self, "_displayed", before),
            period_s=1e-3 * period_ms,
            settle_s=1e-3 * self.settle_ms,
            ended=self._blanked,
        )
        self._displayed = before if whole else np.zeros(self.options.shape, np.uint8)
        self._require()
        if not whole:
            raise StoppedError(self.name, "was blanked or closed during its sequence.")

    def blank(self) -> None:
        """Show all zeros; ends a sequence."""
        self._blanked.set()
        super().blank()

    def close(self) -> None:
        """Blank and disconnect."""
        self._blanked.set()
        self._armed = None
        super().close()

    @property
    def phase_rad(self) -> Float32Array:
        """The phase that light truly gains at each pixel now; what no real SLM would tell."""
        table = self.options.phase_at_full_level_rad * (np.arange(256) / 255) ** self.options.lut_gamma
        return table.astype(np.float32)[self._displayed]
