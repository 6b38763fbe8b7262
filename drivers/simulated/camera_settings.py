"""The settings of the simulated camera: what its sensor is, what it was told, what it refuses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from drivers.camera import Roi, TriggerEdge, TriggerMode
from drivers.common.camera_settings import KeptSettings
from drivers.device import DriverOptions, Setting, SharedPart
from drivers.errors import DeviceError
from drivers.simulated.surroundings import SimulatedDevice, Surroundings
from drivers.simulated.wire import LED_LINE, SLM_LINE
from drivers.simulated.world import SimulatedWorld

ROI_STEP = 4
BINNINGS = (1, 2, 4)
GAIN_LIMITS = (1.0, 16.0)


class CameraOptions(DriverOptions):
    """Options of the simulated camera in ``bench.toml``."""

    color: bool = Field(
        False, description="A Bayer (RGGB) mosaic over the pixels instead of a monochrome sensor."
    )
    crosstalk: float = Field(
        0.05,
        ge=0,
        le=0.3,
        description="Fraction of a band that each of the other colours' filters lets through.",
    )
    frames_per_s: float | None = Field(
        None, gt=0, description="Highest frame rate of a sequence; left out: the sensor's."
    )
    start_ms: float = Field(
        0.0,
        ge=0,
        description="From the start of a snap or a sequence to the first exposure: none by default.",
    )
    replay_frames: int = Field(
        0,
        ge=0,
        le=1000,
        description=(
            "Frames rendered beforehand for each state of light and settings, then shown in turn: the full "
            "rate on a slow computer. 0: every frame is rendered with noise of its own."
        ),
    )


class SimulatedCameraSettings(SimulatedDevice, KeptSettings):
    """The part of the simulated camera that takes no images.

    Its plug pulled and put back, it goes on as it was; opened anew, it has its own default settings.
    """

    kind = "camera"
    trigger_modes: tuple[TriggerMode, ...] = ("free_run", "software", "hardware")
    trigger_lines = (LED_LINE, SLM_LINE)
    trigger_edges: tuple[TriggerEdge, ...] = ("rising", "falling")
    Shared: ClassVar[type[Surroundings]] = SimulatedWorld
    Options = CameraOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self._join(shared)
        self.options = options = CameraOptions.of(options)
        self._spec = self.world.sensor
        self._reset_settings()

    def _reset_settings(self) -> None:
        low, high = self._spec.exposure_limits_ms
        self._exposure_ms = min(max(10.0, low), high)
        self._gain = 1.0
        self._roi = Roi(0, 0, *self._spec.shape)
        self._binning = 1
        self._pixel_format = self.pixel_formats[0]
        self._black_fraction = self._spec.black_level
        self._trigger_mode, self._trigger_line, self._trigger_edge = "free_run", LED_LINE, "rising"
        self._remembered.clear()

    def _model(self) -> str:
        return self._spec.name + (" Color" if self.options.color else "")

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings."""
        self._require()
        return self._common_settings()

    # What the sensor is ---
    @property
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the whole sensor in pixels."""
        return self._spec.shape

    @property
    def pixel_pitch_um(self) -> float:
        """Pitch of the unbinned pixels."""
        return self._spec.pitch_um

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """Formats by their GenICam names, the native one first."""
        stem = "BayerRG" if self.options.color else "Mono"
        return tuple(f"{stem}{bits}" for bits in (16, 12, 8) if bits <= self._spec.bits)

    # Settings ---
    @property
    def exposure_limits_ms(self) -> tuple[float, float]:
        """Shortest and longest exposure."""
        return self._spec.exposure_limits_ms

    def _write_exposure(self, exposure_ms: float) -> float:
        self._require()
        return round(exposure_ms * 1e3) / 1e3  # it counts whole microseconds

    @property
    def gain_limits(self) -> tuple[float, float]:
        """Smallest and largest gain factor."""
        return GAIN_LIMITS

    def _write_gain(self, gain: float) -> float:
        self._require()
        return round(gain, 2)

    @property
    def black_level(self) -> float:
        """Offset in counts of the present pixel format."""
        return self._black_fraction * self._full_scale

    @property
    def _black_limits(self) -> tuple[float, float]:
        return 0.0, self._full_scale / 8

    def _write_black(self, black_level: float) -> None:
        self._black_fraction = black_level / self._full_scale

    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region of interest; its borders fall on multiples of 4 pixels inside the one asked for."""
        self._require_idle("region of interest")
        height, width = self._spec.shape
        if roi is None:
            self._roi = Roi(0, 0, height, width)
            return self._roi
        top, left = (-(-start // ROI_STEP) * ROI_STEP for start in (roi.top, roi.left))
        bottom, right = (
            end if end == side else end // ROI_STEP * ROI_STEP
            for end, side in ((roi.top + roi.height, height), (roi.left + roi.width, width))
        )
        whole = Roi(0, 0, height, width)
        if not whole.contains(roi) or bottom - top < ROI_STEP or right - left < ROI_STEP:
            smallest = f"{ROI_STEP} x {ROI_STEP}"
            raise self._no_region(
                roi, f"The sensor has {height} x {width} pixels, the smallest region {smallest}."
            )
        self._roi = Roi(top, left, bottom - top, right - left)
        return self._roi

    @property
    def binning(self) -> int:
        """Sensor pixels summed along each axis."""
        return self._binning

    @property
    def binnings(self) -> tuple[int, ...]:
        """Binning factors on offer (a colour mosaic cannot be summed)."""
        return (1,) if self.options.color else BINNINGS

    def set_binning(self, binning: int) -> int:
        """Set the binning."""
        self._require_idle("binning")
        self._require_offered("binning", binning, self.binnings)
        self._binning = binning
        return binning

    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""
        return self._pixel_format

    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format."""
        self._require_idle("pixel format")
        self._require_offered("pixel format", pixel_format, self.pixel_formats)
        self._pixel_format = pixel_format
        return pixel_format

    @property
    def significant_bits(self) -> int:
        """Bits that carry signal."""
        return int(self._pixel_format.removeprefix("Mono").removeprefix("BayerRG"))

    @property
    def _full_scale(self) -> int:
        return (1 << self.significant_bits) - 1

    @property
    def readout_ms(self) -> float:
        """A frame's time at the highest rate: no exposure while one is read out."""
        return 1e3 / (self.options.frames_per_s or self._spec.frames_per_s)

    def _require_idle(self, what: str) -> None:
        self._require()
        if self.is_streaming:
            raise DeviceError(self.name, f"streams: no new {what} now.", "Stop the sequence first.")
