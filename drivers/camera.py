"""The camera interface."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from drivers.common.stream import FrameStream
from drivers.device import Device, Setting
from drivers.errors import DeviceError, LimitError
from drivers.frame import Frame, FrameMetadata

TriggerMode = Literal["free_run", "software", "hardware"]
TriggerEdge = Literal["rising", "falling"]


@dataclass(frozen=True, slots=True)
class Roi:
    """A region of interest in sensor pixels before binning."""

    top: int
    left: int
    height: int
    width: int

    def contains(self, other: Roi) -> bool:
        """Whether another region lies in this one, and is not empty."""
        bottom, right = self.top + self.height, self.left + self.width
        return (
            self.top <= other.top < other.top + other.height <= bottom
            and self.left <= other.left < other.left + other.width <= right
        )

    def inside(self, step: int) -> Roi:
        """Return the largest region inside this one with all borders on multiples of ``step``."""
        top, left = (-(-start // step) * step for start in (self.top, self.left))
        bottom = (self.top + self.height) // step * step
        right = (self.left + self.width) // step * step
        return Roi(top, left, max(0, bottom - top), max(0, right - left))

    def as_tuple(self) -> tuple[int, int, int, int]:
        """Return ``(top, left, height, width)``."""
        return (self.top, self.left, self.height, self.width)


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """What is known of one frame's noise at the camera's present settings."""

    read_noise_counts: float
    """Standard deviation of a pixel in the dark, counts."""
    counts_per_electron: float
    """Slope of the photon-transfer curve: ``n`` counts of light have the variance ``n`` times this."""


class Camera(Device):
    """An area camera.

    Each ``set_...`` asks the device for a value and returns what the device says it now has. A value
    outside the device's limits raises :class:`~drivers.errors.LimitError` and changes nothing.
    Settings may not be changed while a sequence runs, except exposure and gain.
    """

    trigger_modes: tuple[TriggerMode, ...] = ("free_run", "software")
    """What ``set_trigger_mode`` takes; ``"free_run"`` is always among them."""

    # What the sensor is ------------------------------------------------------------------------
    @property
    @abstractmethod
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the whole sensor in pixels, before binning."""

    @property
    @abstractmethod
    def pixel_pitch_um(self) -> float:
        """Pitch of the unbinned pixels, micrometres."""

    @property
    @abstractmethod
    def pixel_formats(self) -> tuple[str, ...]:
        """Pixel formats that the camera offers, by their GenICam names."""

    @property
    def noise(self) -> CameraNoise | None:
        """The camera's noise, where driver and device know it; most do not tell."""
        return None

    # Settings ----------------------------------------------------------------------------------
    @property
    @abstractmethod
    def exposure_ms(self) -> float:
        """Exposure time, milliseconds."""

    @property
    @abstractmethod
    def exposure_limits_ms(self) -> tuple[float, float]:
        """Shortest and longest exposure, milliseconds."""

    @abstractmethod
    def set_exposure_ms(self, exposure_ms: float) -> float:
        """Set the exposure; returns what the device made of it, milliseconds."""

    @property
    @abstractmethod
    def gain(self) -> float:
        """Electronic gain as a factor (1.0 = base gain)."""

    @property
    @abstractmethod
    def gain_limits(self) -> tuple[float, float]:
        """Smallest and largest gain factor."""

    @abstractmethod
    def set_gain(self, gain: float) -> float:
        """Set the gain factor; returns what the device made of it."""

    @property
    @abstractmethod
    def black_level(self) -> float:
        """Offset that the camera adds, counts."""

    @abstractmethod
    def set_black_level(self, black_level: float) -> float:
        """Set the offset in counts; returns what the device made of it."""

    @property
    @abstractmethod
    def roi(self) -> Roi:
        """Region of interest in sensor pixels before binning."""

    @abstractmethod
    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region of interest (None: the whole sensor); returns what the device made of it."""

    @property
    @abstractmethod
    def binning(self) -> int:
        """Sensor pixels summed along each axis."""

    @property
    @abstractmethod
    def binnings(self) -> tuple[int, ...]:
        """The binning factors that the camera offers."""

    @abstractmethod
    def set_binning(self, binning: int) -> int:
        """Set the binning; returns what the device made of it."""

    @property
    @abstractmethod
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""

    @abstractmethod
    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format; returns what the device made of it."""

    @property
    @abstractmethod
    def significant_bits(self) -> int:
        """Bits that carry signal in the present pixel format."""

    @property
    @abstractmethod
    def trigger_mode(self) -> TriggerMode:
        """What starts an exposure."""

    @abstractmethod
    def set_trigger_mode(self, mode: TriggerMode) -> TriggerMode:
        """Choose what starts an exposure; returns what the device made of it."""

    @property
    def trigger_lines(self) -> tuple[str, ...]:
        """Inputs that a hardware trigger may come in on, by the camera's names; empty: there is no choice."""
        return ()

    @property
    def trigger_line(self) -> str:
        """The input that a hardware trigger comes in on; empty where there is no choice."""
        return ""

    def set_trigger_line(self, line: str) -> str:
        """Choose the input of the hardware trigger; returns what the device made of it."""
        self._require_offered("trigger line", line, self.trigger_lines)
        return line

    @property
    def trigger_edges(self) -> tuple[TriggerEdge, ...]:
        """Edges of a pulse that can start an exposure; empty: there is no choice."""
        return ()

    @property
    def trigger_edge(self) -> TriggerEdge:
        """The edge of a pulse that starts an exposure."""
        return "rising"

    def set_trigger_edge(self, edge: TriggerEdge) -> TriggerEdge:
        """Choose the edge that starts an exposure; returns what the device made of it."""
        self._require_offered("trigger edge", edge, self.trigger_edges)
        return edge

    @property
    def readout_ms(self) -> float:
        """From the end of a triggered exposure to the next trigger that is not lost, milliseconds.

        Drivers that cannot know it leave it long.
        """
        return 50.0

    def _common_settings(self) -> dict[str, Setting]:
        """Return what every camera's settings say, for drivers."""
        names = (
            "exposure_ms gain black_level pixel_format significant_bits roi binning trigger_mode "
            "trigger_line trigger_edge sensor_shape pixel_pitch_um"
        )
        made = {name: getattr(self, name) for name in names.split()} | {"roi": self.roi.as_tuple()}
        if not self.trigger_lines:
            del made["trigger_line"]
        if not self.trigger_edges:
            del made["trigger_edge"]
        return made

    def _require_within(
        self, value: float, limits: tuple[float, float], problem: str, what: str, unit: str = ""
    ) -> None:
        """Refuse a value beyond limits, for drivers: ``problem``, then what ``what`` is."""
        low, high = limits
        if not low <= value <= high:
            raise LimitError(self.name, problem, f"{what} is {low:g} to {high:g}{unit}.")

    def _require_offered(self, what: str, value: object, offered: Sequence[object]) -> None:
        """Refuse a value that is not on offer, for drivers."""
        if value not in offered:
            choices = ", ".join(map(str, offered))
            raise LimitError(self.name, f"has no {what} {value!r}.", f"It offers {choices}.")

    def _no_region(self, asked: Roi, remedy: str) -> LimitError:
        """Return the refusal of a region, for drivers."""
        problem = f"cannot read the region (top, left, height, width) = {asked.as_tuple()}."
        return LimitError(self.name, problem, remedy)

    @property
    def image_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the frames that the present ROI and binning give."""
        roi = self.roi
        return (roi.height // self.binning, roi.width // self.binning)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of the frames that the present settings give, colour channels included."""
        colour = self.pixel_format.startswith(("RGB", "BGR"))
        return (*self.image_shape, 3) if colour else self.image_shape

    @property
    def frame_dtype(self) -> np.dtype[np.uint8] | np.dtype[np.uint16]:
        """Type of the counts that the present pixel format gives."""
        return np.dtype(np.uint8) if self.significant_bits <= 8 else np.dtype(np.uint16)

    # Taking images -----------------------------------------------------------------------------
    @abstractmethod
    def snap(self) -> Frame:
        """Take one frame whose exposure begins after this call, and wait for it.

        Raises DeviceTimeoutError when no frame came in the time the exposure and read-out need, with a
        margin; StoppedError when ``stop_sequence`` was called from another thread meanwhile.
        """

    @abstractmethod
    def start_sequence(self, n_buffers: int = 8) -> None:
        """Start continuous acquisition into a fixed ring of ``n_buffers`` frames."""

    @abstractmethod
    def next_frame(self, timeout_s: float) -> Frame:
        """Return the oldest frame of the running sequence not yet fetched; waits up to ``timeout_s``.

        When the ring overflowed, the frames lost are counted in the returned frame's ``dropped_before``.
        """

    def next_frame_into(
        self, buffer: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], timeout_s: float
    ) -> FrameMetadata:
        """Copy the oldest frame not yet fetched into a buffer that fits it; errors as ``next_frame``.

        Drivers whose frames lie in buffers of the device's override this to copy from there, once.
        """
        frame = self.next_frame(timeout_s)
        if frame.image.shape != buffer.shape or frame.image.dtype != buffer.dtype:
            raise DeviceError(
                self.name,
                f"sent a frame {frame.image.dtype} {frame.image.shape}; "
                f"{buffer.dtype} {buffer.shape} was expected.",
            )
        np.copyto(buffer, frame.image)
        return frame.metadata

    def stream(self, n_buffers: int = 16) -> FrameStream:
        """Return a stream of frames, to be started: every frame, the newest, or a callback."""
        return FrameStream(self, n_buffers)

    @abstractmethod
    def trigger(self) -> None:
        """Send one software trigger to a sequence that runs in trigger mode ``"software"``."""

    drops_counted_by: ClassVar[str] = "the driver's own count"
    """How ``dropped_before`` is known; recordings say so: ``"device frame numbers"``, ``"timestamps"`` ..."""

    longest_silence_s: ClassVar[float] = 2.0
    """A free-running camera that sends nothing for this long beyond three exposures has failed."""

    @property
    def longest_wait_s(self) -> float:
        """What a snap, or a free-running sequence's next frame, may take before the camera has failed."""
        return self.longest_silence_s + 3e-3 * self.exposure_ms

    def computed_s(self) -> float:
        """Return how long a simulated camera has computed what it is to see, seconds of the processor.

        While that grows it is slow, and does not hang. A real camera does not compute: 0. Asked while
        another call is waited for: told at once, without asking the device.
        """
        return 0.0

    frames_in_flight: ClassVar[int] = 2
    """Frames that can be between the sensor and the host while the next one is exposed, at most."""

    @abstractmethod
    def stop_sequence(self) -> None:
        """End the running sequence (or a pending ``snap``) at once. Without one it does nothing."""

    @property
    @abstractmethod
    def is_streaming(self) -> bool:
        """Whether a sequence runs."""
