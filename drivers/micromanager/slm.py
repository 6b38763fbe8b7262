"""A spatial light modulator that one of Micro-Manager's adapters serves."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, Setting, SharedPart
from drivers.errors import DeviceError
from drivers.micromanager.core import MicroManagerDevice, Part, PropertyValue
from drivers.slm import Slm, read_only


class MicroManagerSlmOptions(DriverOptions):
    """Options of an SLM of Micro-Manager's in ``bench.toml``."""

    device: str | None = Field(
        None, min_length=1, description="Its label; left out: the SLM of Micro-Manager's configuration."
    )
    pixel_pitch_um: float = Field(gt=0, description="Pixel pitch, micrometres.")
    settle_ms: float = Field(
        50.0, ge=0, description="Time from a shown image to settled optics, milliseconds."
    )
    properties: dict[str, PropertyValue] = Field(
        default_factory=dict, description="Properties to set on opening, in this order."
    )


class MicroManagerSlm(MicroManagerDevice, Slm):
    """An SLM of 8-bit grey levels; what it shows cannot be read back, only that its adapter took it."""

    Options = MicroManagerSlmOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self.options = MicroManagerSlmOptions.of(options)
        self._share(shared)
        self._slm: Part | None = None
        self._shown: npt.NDArray[np.uint8] | None = None

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the SLM by its label."""
        return (f"Micro-Manager SLM {MicroManagerSlmOptions.of(options).device or '(its default)'}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return nothing: the camera's driver lists the installation."""
        return ()

    @property
    def name(self) -> str:
        """The SLM as error messages name it."""
        return f"slm (micromanager {self.options.device or 'default'})"

    @property
    def is_open(self) -> bool:
        """Whether the SLM is connected."""
        return self._slm is not None

    def open(self) -> None:
        """Load Micro-Manager's devices and show a blank image."""
        if self._slm is not None:
            return
        core = self._acquire()
        try:
            slm = self._part(self.options.device, "SLM")
            slm.set_all(self.options.properties)
            if core.getSLMBytesPerPixel(slm.label) != 1:
                raise DeviceError(
                    self.name, "takes no 8-bit grey levels.", "Choose another mode of the device."
                )
            self._shape = (int(core.getSLMHeight(slm.label)), int(core.getSLMWidth(slm.label)))
            self._slm = slm
            self.blank()
        except BaseException:
            self._slm = None
            self._release()
            raise

    def close(self) -> None:
        """Show a blank image and let go of the device."""
        if self._slm is None:
            return
        try:
            self.blank()
        finally:
            self._slm = None
            self._release()

    @property
    def identity(self) -> DeviceIdentity:
        """Who the device is."""
        return self._part_now().identity("slm")

    def settings(self) -> Mapping[str, Setting]:
        """Read every property."""
        part = self._part_now()
        made: dict[str, Setting] = {
            "shape": self._shape,
            "pixel_pitch_um": self.pixel_pitch_um,
            "settle_ms": self.settle_ms,
        }
        return made | part.settings()

    @property
    def shape(self) -> tuple[int, int]:
        """``(height, width)`` in pixels."""
        self._part_now()
        return self._shape

    @property
    def pixel_pitch_um(self) -> float:
        """Pixel pitch, as configured."""
        return self.options.pixel_pitch_um

    @property
    def settle_ms(self) -> float:
        """Settling time, as configured."""
        return self.options.settle_ms

    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        """Show grey levels; see the interface."""
        part = self._part_now()
        self._check(levels)
        self._shown = None
        part.call("take an image", "setSLMImage", np.ascontiguousarray(levels))
        part.call("show its image", "displaySLMImage")
        self._shown = levels.copy()
        time.sleep(self.settle_ms / 1e3)

    @property
    def displayed(self) -> npt.NDArray[np.uint8]:
        """The grey levels shown last; after an image that failed an error until the next one."""
        self._part_now()
        if self._shown is None:
            raise DeviceError(self.name, "what it shows is unknown after a failure.", "Display again.")
        return read_only(self._shown)

    def _part_now(self) -> Part:
        self._require_core()
        assert self._slm is not None
        return self._slm
