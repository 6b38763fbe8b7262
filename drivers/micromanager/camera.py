"""A camera that one of Micro-Manager's adapters serves."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.camera import Roi, TriggerMode
from drivers.common.buffered_camera import BufferedCamera, RawFrame
from drivers.common.camera_settings import GainScale, GainUnit
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels
from drivers.device import DriverOptions, FoundDevice, OwnSetting, Setting, SharedPart
from drivers.errors import DeviceError
from drivers.micromanager.core import (
    MicroManagerDevice,
    PropertyValue,
    found_by_installation,
    words,
)

_POLL_S = 0.001
_MIB = 1 << 20
_SHORTEST_MS = 0.01
"""Shortest exposure of a camera that names no limit, or 0."""
_LONGEST_MS = 3.6e6
_BINNING = re.compile(r"(\d+)(?:\s*x\s*\1)?$")
_MONO = re.compile(
    r"(?:mono|grey|gray)?\s*(8|10|12|14|16)\s*[-_]?(?:bits?)?(?:\s*mono|\s*gr[ae]y)?$", re.IGNORECASE
)
_RGB = re.compile(r"(?:32\s*bit\s*rgb|rgb32|rgb24|rgb8|8bitrgb|rgb|color|colour)$", re.IGNORECASE)


class MicroManagerCameraOptions(DriverOptions):
    """Options of a camera of Micro-Manager's in ``bench.toml``; devices come from ``[micromanager]``."""

    device: str | None = Field(
        None, min_length=1, description="Its label; left out: the camera of Micro-Manager's configuration."
    )
    pixel_pitch_um: float = Field(
        gt=0, description="Pitch of the pixels, micrometres: Micro-Manager does not know it."
    )
    pixel_type_property: str = Field("PixelType", description="Property that chooses the pixel format.")
    gain_property: str = Field("Gain", description="Property that is the gain, where there is one.")
    gain_unit: GainUnit = Field(
        "steps", description='What the gain counts: "dB", "factor", or "steps" of unknown meaning.'
    )
    gain_per_count: float = Field(1.0, gt=0, description="How many of that unit a gain of 1 is.")
    black_level_property: str = Field("Offset", description="Property that is the offset, in counts.")
    properties: dict[str, PropertyValue] = Field(
        default_factory=dict, description="Properties to set on opening, in this order."
    )
    triggers: dict[TriggerMode, dict[str, PropertyValue]] = Field(
        default_factory=dict,
        description="[camera.triggers.hardware] and so on: the properties that make a trigger mode.",
    )
    software_trigger: dict[str, PropertyValue] = Field(
        default_factory=dict, description="Properties whose setting is one software trigger."
    )

    @model_validator(mode="after")
    def _no_trigger_stays_set(self) -> Self:
        free = self.triggers.get("free_run", {})
        for mode, properties in self.triggers.items():
            if missing := [name for name in properties if name not in free]:
                raise ValueError(
                    f"triggers.free_run must say what {', '.join(missing)} is then, which "
                    f"triggers.{mode} sets: else the camera would go on waiting for triggers"
                )
        return self


class MicroManagerCamera(MicroManagerDevice, BufferedCamera):
    """A camera of one of Micro-Manager's adapters; single frames are sequences too, which STOP can end.

    Frames are counted by the core's image numbers: what its buffer lost is known exactly, what the camera
    lost before is not, unless its adapter says so.
    """

    Options = MicroManagerCameraOptions
    drops_counted_by = "Micro-Manager's image numbers (not what the camera itself lost)"

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = MicroManagerCameraOptions.of(options)
        self._share(shared)
        self.trigger_modes = (
            "free_run",
            *(
                mode
                for mode in ("software", "hardware")
                if mode in self.options.triggers and (mode == "hardware" or self.options.software_trigger)
            ),
        )
        self._woken = threading.Event()
        self._streaming = False
        self._binning = 1

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the camera by its label."""
        return (f"Micro-Manager camera {MicroManagerCameraOptions.of(options).device or '(its default)'}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return Micro-Manager's installation."""
        return found_by_installation()

    @property
    def name(self) -> str:
        """The camera as error messages name it."""
        return f"camera (micromanager {self.options.device or 'default'})"

    # Opening ---------------------------------------------------------------------------------------
    @property
    def _connected(self) -> bool:
        return self._core is not None

    def _connect(self) -> None:
        self._acquire()
        try:
            self._camera = self._part(self.options.device, "Camera")
            self._core.setCameraDevice(self._camera.label)
            self._prepare()
        except BaseException:
            self._release()
            raise

    def _prepare(self) -> None:
        camera, options = self._camera, self.options
        self._stop_camera()
        self._identity = camera.identity("camera")
        self._write_trigger("free_run")
        self._trigger_mode = "free_run"
        self._binnings = self._read_binnings()
        self._set_raw_binning(min(self._binnings))
        self._clear_region()
        unit = self._binning
        self._sensor = (self._core.getImageHeight() * unit, self._core.getImageWidth() * unit)
        camera.set_all(options.properties)
        self._binning = self._binning_now()
        self._formats = self._read_formats()
        self._read_shape()
        self._exposure_ms = float(camera.call("say its exposure", "getExposure"))
        self._gain = self._read_gain()

    def _disconnect(self) -> None:
        self._stop_camera()
        self._release()

    def _stop_camera(self) -> None:
        with suppress(RuntimeError):  # of a device that is gone
            if self._core.isSequenceRunning(self._camera.label):
                self._core.stopSequenceAcquisition(self._camera.label)

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings from the camera."""
        self._require()
        return self._common_settings() | self._camera.settings()

    def own_settings(self) -> Mapping[str, OwnSetting]:
        """Return the adapter's properties that the driver leaves alone."""
        self._require()
        told = self.options
        own = (told.pixel_type_property, told.gain_property, told.black_level_property, "Exposure", "Binning")
        modes = [name for mode in told.triggers.values() for name in mode]
        return self._camera.own_settings({*own, *modes})

    def set_own(self, name: str, value: str) -> Setting:
        """Set a property of the adapter; errors as :meth:`Part.set`, and LimitError for the driver's own."""
        known = self.own_settings().get(name)
        if known is None:
            return super().set_own(name, value)
        whole = (self._roi.height, self._roi.width) == self._sensor
        try:
            made = self._camera.set(name, value)
        finally:  # refused as well, the pixels may be others along with it
            self._read_shape()
            if whole:
                self._sensor = self._roi.height, self._roi.width
        self._remember_own(name, value, known.choices)
        return made

    # Exposure, gain, black level -------------------------------------------------------------------
    @property
    def _period_s(self) -> float:
        return self._exposure_ms / 1e3

    @property
    def exposure_limits_ms(self) -> tuple[float, float]:
        """Shortest and longest exposure, by the property ``Exposure`` where there is one."""
        self._require()
        bounds = self._camera.bounds("Exposure") if self._camera.has("Exposure") else None
        low, high = bounds or (0.0, _LONGEST_MS)
        return max(low, _SHORTEST_MS), high

    def _write_exposure(self, exposure_ms: float) -> float:
        self._camera.call(f"expose {exposure_ms:g} ms", "setExposure", exposure_ms)
        return float(self._camera.call("say its exposure", "getExposure"))

    def _scale(self) -> tuple[GainScale, float] | None:
        """Return what the gain means, and its largest number; None of a camera without a gain."""
        name = self.options.gain_property
        bounds = self._camera.bounds(name) if self._camera.has(name) else None
        if bounds is None:
            return None
        return GainScale(self.options.gain_unit, self.options.gain_per_count, bounds[0]), bounds[1]

    def _read_gain(self) -> float:
        scale = self._scale()
        return scale[0].factor(self._camera.number(self.options.gain_property)) if scale else 1.0

    @property
    def gain_limits(self) -> tuple[float, float]:
        """Smallest and largest gain factor."""
        self._require()
        scale = self._scale()
        return (scale[0].factor(scale[0].lowest), scale[0].factor(scale[1])) if scale else (1.0, 1.0)

    def _write_gain(self, gain: float) -> float:
        scale = self._scale()
        if scale:
            self._camera.set(self.options.gain_property, scale[0].number(gain))
        return self._read_gain()

    @property
    def black_level(self) -> float:
        """Offset in counts; 0 without one."""
        self._require()
        name = self.options.black_level_property
        return self._camera.number(name) if self._camera.has(name) else 0.0

    @property
    def _black_limits(self) -> tuple[float, float]:
        name = self.options.black_level_property
        if not self._camera.has(name):
            return 0.0, 0.0
        return self._camera.bounds(name) or (0.0, float((1 << self._bits) - 1))

    def _write_black(self, black_level: float) -> None:
        if self._camera.has(self.options.black_level_property):
            self._camera.set(self.options.black_level_property, black_level)

    # What the sensor is ----------------------------------------------------------------------------
    @property
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the whole sensor."""
        self._require()
        return self._sensor

    @property
    def pixel_pitch_um(self) -> float:
        """Pitch of the unbinned pixels, as configured."""
        return self.options.pixel_pitch_um

    # Pixel format ----------------------------------------------------------------------------------
    def _read_formats(self) -> dict[str, str]:
        """Return the values of the pixel type that can be read, by their GenICam names."""
        name = self.options.pixel_type_property
        values = self._camera.choices(name) if self._camera.has(name) else ()
        named = ((genicam_name(value), value) for value in values)
        return {format_name: value for format_name, value in named if format_name is not None}

    def _read_shape(self) -> None:
        """Note what the camera sends as it is set now."""
        core, name = self._core, self.options.pixel_type_property
        core.setCameraDevice(self._camera.label)  # what follows is asked of the core's camera of the moment
        self._bytes = int(core.getBytesPerPixel())
        self._components = int(core.getNumberOfComponents())
        self._bits = int(core.getImageBitDepth())
        if (self._bytes, self._components) not in ((1, 1), (2, 1), (4, 4)):
            raise DeviceError(
                self.name,
                f"sends pixels of {self._bytes} bytes and {self._components} components.",
                f"Choose 8 to 16 bit grey, or 8 bit RGB (property {name!r}).",
            )
        self._format = "RGB8" if self._components == 4 else f"Mono{8 * self._bytes}"
        if self._camera.has(name):
            self._format = genicam_name(self._camera.text(name)) or self._format
        self._formats.setdefault(self._format, self._camera.text(name) if self._camera.has(name) else "")
        unit = self._binning
        left, top, width, height = (edge * unit for edge in core.getROI(self._camera.label))
        self._roi = Roi(top, left, height, width)

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """Formats that can be read."""
        self._require()
        return tuple(self._formats)

    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""
        self._require()
        return self._format

    @property
    def significant_bits(self) -> int:
        """Bits of the pixel format, as the adapter says."""
        self._require()
        return self._bits

    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format."""
        self._require_idle("pixel format")
        self._require_offered("pixel format", pixel_format, self.pixel_formats)
        if pixel_format != self._format:
            value = self._formats[pixel_format]
            self._as_told(self.options.pixel_type_property, value)
            self._read_shape()
        self._remember("pixel_format", lambda: self.set_pixel_format(pixel_format))
        return self._format

    # Region, binning -------------------------------------------------------------------------------
    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region; its borders fall on binned pixels inside the one asked for."""
        self._require_idle("region of interest")
        whole = Roi(0, 0, *self._sensor)
        asked, unit = whole if roi is None else roi, self._binning
        top, left = -(-asked.top // unit), -(-asked.left // unit)
        height = (asked.top + asked.height) // unit - top
        width = (asked.left + asked.width) // unit - left
        if not whole.contains(asked) or min(height, width) < 1:
            raise self._no_region(asked, f"Regions lie within {whole.as_tuple()}, in steps of {unit}.")
        before = self._roi
        if asked == whole:
            self._clear_region()
        else:
            self._camera.call(f"read the region {asked.as_tuple()}", "setROI", left, top, width, height)
        self._read_shape()
        if not asked.contains(self._roi) and asked != whole:
            made = self._roi
            self._camera.call(
                "go back to its region",
                "setROI",
                *(edge // unit for edge in (before.left, before.top, before.width, before.height)),
            )
            self._read_shape()
            raise self._no_region(
                asked, f"The adapter would make it {made.as_tuple()}; ask for a larger one."
            )
        self._remember("roi", lambda: self.set_roi(roi))
        return self._roi

    def _read_binnings(self) -> dict[int, str]:
        values = self._camera.choices("Binning") if self._camera.has("Binning") else ()
        matches = ((_BINNING.match(value.strip()), value) for value in values)
        return {int(match[1]): value for match, value in matches if match} or {1: ""}

    def _set_raw_binning(self, binning: int) -> None:
        if self._binnings[binning]:
            self._as_told("Binning", self._binnings[binning])
        self._binning = binning

    def _binning_now(self) -> int:
        """Return the binning that the camera says it has."""
        match = _BINNING.match(self._camera.text("Binning").strip()) if self._camera.has("Binning") else None
        return int(match[1]) if match else 1

    def _as_told(self, name: str, value: str) -> None:
        """Set a choice and read it back.

        Raises DeviceError with both values when the camera has another one.
        """
        made = self._camera.set(name, value)
        if made != value:
            raise DeviceError(
                self.name, f"was told {name} = {value!r} and says {made!r}.", "Check its adapter."
            )

    def _clear_region(self) -> None:
        """Read the whole sensor, of this camera, whichever the core has for its own at the moment."""
        with words(self.name, "read its whole sensor", "Does its adapter support regions?"):
            self._core.setCameraDevice(self._camera.label)
            self._core.clearROI()

    @property
    def binning(self) -> int:
        """Sensor pixels binned along each axis."""
        self._require()
        return self._binning

    @property
    def binnings(self) -> tuple[int, ...]:
        """The binning factors that the camera offers."""
        self._require()
        return tuple(sorted(self._binnings))

    def set_binning(self, binning: int) -> int:
        """Set the binning along both axes; the region becomes the whole sensor."""
        self._require_idle("binning")
        self._require_offered("binning", binning, self.binnings)
        self._set_raw_binning(binning)
        self._clear_region()
        self._read_shape()
        self._forget("roi")
        self._remember("binning", lambda: self.set_binning(binning))
        return self._binning

    def _write_trigger(self, mode: TriggerMode) -> None:
        # What another mode has set goes back first: free_run has all of it.
        self._camera.set_all(self.options.triggers.get("free_run", {}))
        if mode != "free_run":
            self._camera.set_all(self.options.triggers[mode])

    # Streaming -------------------------------------------------------------------------------------
    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        core, label = self._core, self._camera.label
        self._woken.clear()
        with words(self.name, "start a sequence", "Is another program using it?"):
            core.setCameraDevice(label)
            frame_bytes = core.getImageBufferSize()
            core.setCircularBufferMemoryFootprint(max(1, -(-n_buffers * frame_bytes // _MIB)))
            core.initializeCircularBuffer()
            core.prepareSequenceAcquisition(label)
            core.startContinuousSequenceAcquisition(0)
        self._streaming = True
        return FrameNumberCounter()

    def _take(self, timeout_s: float) -> RawFrame | None:
        from pymmcore import Metadata

        core, deadline_s = self._core, time.monotonic() + timeout_s
        while not core.getRemainingImageCount():
            if self._woken.is_set() or time.monotonic() >= deadline_s:
                return None
            if not core.isSequenceRunning(self._camera.label) and not core.getRemainingImageCount():
                raise DeviceError(
                    self.name,
                    "ended its sequence by itself.",
                    "Is it still connected? Micro-Manager's log may say more.",
                )
            time.sleep(_POLL_S)
        metadata = Metadata()
        with words(self.name, "hand out a frame", "Micro-Manager's log may say more."):
            image: Any = core.popNextImageMD(metadata)
            number = int(metadata.GetSingleTag("ImageNumber").GetValue())
        data = np.ascontiguousarray(image).view(np.uint8).reshape(-1)
        return RawFrame(data, number, None, data.size == self._frame_bytes(), None)

    def _frame_bytes(self) -> int:
        height, width = self.image_shape
        return height * width * self._bytes

    def _give_back(self, raw: RawFrame) -> None:
        """Do nothing: the core copied the frame."""

    def _wake(self) -> None:
        self._woken.set()

    def _end(self) -> None:
        if self._streaming:
            self._streaming = False
            self._stop_camera()

    def _decode(self, data: Bytes, out: Pixels) -> bool:
        if self._components == 4:  # blue, green, red, nothing
            np.copyto(out, data.reshape(*out.shape[:2], 4)[..., 2::-1])
        else:
            sent = data.view(np.uint8 if self._bytes == 1 else np.uint16).reshape(out.shape)
            np.copyto(out, sent, casting="unsafe")  # 8 bits that are sent in two bytes are 8 bits
        return True

    def _fire(self) -> None:
        self._camera.set_all(self.options.software_trigger)


def genicam_name(pixel_type: str) -> str | None:
    """Return the GenICam name of what an adapter calls a pixel type; None of what cannot be read."""
    text = pixel_type.strip()
    if match := _MONO.match(text):
        return f"Mono{match[1]}"
    return "RGB8" if _RGB.match(text) else None
