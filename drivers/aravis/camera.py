"""The GenICam camera, through the Aravis library: its settings, and its frames from Aravis' stream."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from drivers.aravis.features import (
    AUTOMATICS,
    BLACK_LEVEL,
    EXPOSURE,
    FRAME_RATE,
    FRAME_RATE_ENABLE,
    GAIN,
    Features,
    Underruns,
    find_camera,
    found_cameras,
    identity_of,
    library_error,
    load,
    stream_statistics,
)
from drivers.aravis.images import Images, set_trigger
from drivers.camera import Roi, TriggerMode
from drivers.common.buffered_camera import BufferedCamera, RawFrame
from drivers.common.camera_settings import GainScale, GainUnit
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels, unpack
from drivers.device import DriverOptions, FoundDevice, Setting, SharedPart
from drivers.errors import DeviceError, DeviceLostError, LimitError
from drivers.registry.claim import DeviceBusyError

_SLICE_S = 0.05
"""A wait in the library cannot be ended from outside: it is cut into pieces of this length."""
_BLOCK_IDS = 1 << 16
"""Frame ids of GigE Vision 1 start again after this many, at 1."""


class AravisOptions(DriverOptions):
    """Options of a GenICam camera in ``bench.toml``."""

    device_id: str | None = Field(
        None,
        min_length=1,
        description=(
            'Which camera: its id as "diffuserbench devices" lists it, or its network address; left out: the '
            'only one there is. "Fake_1": one that Aravis makes up.'
        ),
    )
    pixel_pitch_um: float | None = Field(
        None, gt=0, description="Pitch of the pixels, micrometres, of a camera that does not say it."
    )
    frames_per_s: float | None = Field(
        None, gt=0, description="Frames a second when running free; left out: as the camera has it."
    )
    trigger_line: str = Field(
        "Line1", description="Line of the hardware trigger, by the camera's TriggerSource."
    )
    trigger_activation: str = Field(
        "RisingEdge", description="Edge of the hardware trigger: TriggerActivation."
    )
    gain_unit: GainUnit | None = Field(
        None,
        description=(
            'What the gain counts: "dB", "factor", or "steps" of unknown meaning; left out: as the camera '
            "says."
        ),
    )
    gain_per_count: float = Field(
        1.0, gt=0, description="How many of that unit a gain of 1 is (for GainRaw)."
    )
    packet_size: int | None = Field(
        None,
        ge=220,
        le=16384,
        description="GigE Vision: bytes a packet; left out: the largest that gets through.",
    )
    packet_delay_ns: int | None = Field(
        None, ge=0, description="GigE Vision: pause between packets, nanoseconds, for busy networks."
    )
    packet_resend: bool = Field(True, description="GigE Vision: ask for lost packets again.")
    features: dict[str, str | bool | int | float] = Field(
        default_factory=dict, description="Other features to set on opening, by their GenICam names."
    )


class AravisCamera(BufferedCamera):
    """Any GenICam camera that Aravis finds: GigE Vision, USB3 Vision, and the one that Aravis makes up."""

    Options = AravisOptions
    trigger_modes = ("free_run", "software", "hardware")

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = AravisOptions.of(options)
        self._aravis: Any = None
        self._camera: Any = None
        self._handler = 0
        self._stream: Any = None
        self._woken = threading.Event()
        self._statistics: dict[str, int] = {}
        self._line_bytes: int | None = None
        """Bytes from line to line where the camera pads lines."""

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the camera by its configured id."""
        return (f"GenICam camera {AravisOptions.of(options).device_id or '(the only one)'}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the GenICam cameras on the network and on USB."""
        return found_cameras()

    @property
    def name(self) -> str:
        """The camera as error messages name it."""
        return f"camera (aravis {self.options.device_id or 'any'})"

    # Opening ---------------------------------------------------------------------------------------
    @property
    def _connected(self) -> bool:
        return self._camera is not None

    def _connect(self) -> None:
        self._aravis = load(self.name)
        self._camera = find_camera(self._aravis, self.name, self.options.device_id)
        try:
            device = self._camera.get_device()
            if self._camera.is_gv_device() and not device.is_controller():
                raise DeviceBusyError(self.name, "is controlled by another program.", "Close that one.")
            self._features = Features(self._aravis, device, self.name, library_error(), self._note_lost)
            self._handler = device.connect("control-lost", self._on_control_lost)
            self._prepare()
        except BaseException:
            self._disconnect()
            raise

    def _prepare(self) -> None:
        """Bring the camera to a state in which nothing happens by itself, and read what it is."""
        features = self._features
        for automatic in AUTOMATICS:
            if features.find(automatic) and "Off" in features.entries(automatic):
                features.choose(automatic, "Off")
        if features.find("AcquisitionMode"):
            features.choose("AcquisitionMode", "Continuous")
        self._identity = identity_of(self._camera, features)
        self._pitch_um = self._read_pitch()
        exposure = features.find(*EXPOSURE)
        if exposure is None:
            raise DeviceError(
                self.name, f"has no exposure time ({', '.join(EXPOSURE)}).", "Use another camera."
            )
        self._exposure_name = exposure
        self._gain_name = features.find(*GAIN)
        self._black_name = features.find(*BLACK_LEVEL)
        self._rate_name = features.find(*FRAME_RATE)
        self._write_trigger("free_run")
        self._trigger_mode = "free_run"
        self._images = Images(features, self._camera, self.name, self._read_sensor)
        self._roi = self._images.roi
        for name, value in self.options.features.items():
            features.set_any(name, value)
        self._rate = features.number(self._rate_name) if self._rate_name else 0.0
        self._exposure_ms = features.number(self._exposure_name) / 1e3
        self._gain = self._read_gain()
        if self._camera.is_gv_device():
            self._prepare_network()

    def _prepare_network(self) -> None:
        camera, options = self._camera, self.options
        with self._features.words("agree on a packet size"):
            if options.packet_size is None:
                camera.gv_auto_packet_size()
            else:
                camera.gv_set_packet_size(options.packet_size)
            if options.packet_delay_ns is not None:
                camera.gv_set_packet_delay(options.packet_delay_ns)

    def _read_sensor(self) -> tuple[int, int]:
        """Return the sensor's ``(height, width)``."""
        features = self._features
        if features.find("SensorHeight") and features.find("SensorWidth"):
            return int(features.number("SensorHeight")), int(features.number("SensorWidth"))
        features.set_number("OffsetX", 0)
        features.set_number("OffsetY", 0)
        return int(features.bounds("Height")[1]), int(features.bounds("Width")[1])

    def _read_pitch(self) -> float:
        if self.options.pixel_pitch_um is not None:
            return self.options.pixel_pitch_um
        if self._features.find("SensorPixelWidth"):
            return self._features.number("SensorPixelWidth")
        raise DeviceError(
            self.name, "does not say the pitch of its pixels.", "Give pixel_pitch_um, from its data sheet."
        )

    def _disconnect(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None and self._handler:
            camera.get_device().disconnect(self._handler)
        self._handler = 0
        # The last reference gives the camera's control back.
        self._features = self._images = None  # type: ignore[assignment]

    def _on_control_lost(self, _device: Any) -> None:
        self._note_lost(
            DeviceLostError(
                self.name,
                "is not controlled by this program any more: unplugged, switched off, or taken over.",
                "Check cable and power, then open it again.",
            )
        )

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings from the camera."""
        self._require()
        features = self._features
        made = self._common_settings() | {
            "exposure_ms": features.number(self._exposure_name) / 1e3,
            "gain": self._read_gain(),
            "pixel_format": features.text("PixelFormat"),
            "frames_per_s": features.number(self._rate_name) if self._rate_name else None,
        }
        if self._camera.is_gv_device():
            with features.words("say its packet size"):
                made["packet_size_bytes"] = self._camera.gv_get_packet_size()
                made["packet_delay_ns"] = self._camera.gv_get_packet_delay()
        for name in self.options.features:
            made[f"feature.{name}"] = features.any_text(name)
        return made

    # Exposure, gain, black level -------------------------------------------------------------------
    @property
    def _period_s(self) -> float:
        return 1 / self._rate if self._rate else 0.0

    def _apply_rate(self) -> None:
        """Set the configured frame rate, whose limits depend on region and exposure; note the present one."""
        features, wanted = self._features, self.options.frames_per_s
        if wanted is not None:
            if self._rate_name is None:
                raise DeviceError(self.name, "its frame rate cannot be set.", "Leave frames_per_s out.")
            enable = features.find(*FRAME_RATE_ENABLE)
            if enable:
                features.set_any(enable, True)
            low, high = features.bounds(self._rate_name)
            if not low <= wanted <= high:
                raise LimitError(
                    self.name,
                    f"cannot send {wanted:g} frames/s.",
                    f"With these settings: {low:g} to {high:g}.",
                )
            features.set_number(self._rate_name, wanted)
        self._rate = features.number(self._rate_name) if self._rate_name else 0.0

    @property
    def exposure_limits_ms(self) -> tuple[float, float]:
        """Shortest and longest exposure that the camera takes now."""
        self._require()
        low, high = self._features.bounds(self._exposure_name)
        return low / 1e3, high / 1e3

    def _write_exposure(self, exposure_ms: float) -> float:
        return self._features.set_number(self._exposure_name, exposure_ms * 1e3) / 1e3

    def _scale(self) -> GainScale:
        assert self._gain_name is not None
        unit = self.options.gain_unit
        if unit is None:
            unit = "dB" if self._features.unit(self._gain_name).lower() == "db" else "steps"
        return GainScale(unit, self.options.gain_per_count, self._features.bounds(self._gain_name)[0])

    def _read_gain(self) -> float:
        return self._scale().factor(self._features.number(self._gain_name)) if self._gain_name else 1.0

    @property
    def gain_limits(self) -> tuple[float, float]:
        """Smallest and largest gain factor."""
        self._require()
        if self._gain_name is None:
            return 1.0, 1.0
        scale, (low, high) = self._scale(), self._features.bounds(self._gain_name)
        return scale.factor(low), scale.factor(high)

    def _write_gain(self, gain: float) -> float:
        if self._gain_name is not None:
            self._features.set_number(self._gain_name, self._scale().number(gain))
        return self._read_gain()

    @property
    def black_level(self) -> float:
        """Offset as the camera counts it; 0 without one."""
        self._require()
        return self._features.number(self._black_name) if self._black_name else 0.0

    @property
    def _black_limits(self) -> tuple[float, float]:
        return self._features.bounds(self._black_name) if self._black_name else (0.0, 0.0)

    def _write_black(self, black_level: float) -> None:
        if self._black_name:
            self._features.set_number(self._black_name, black_level)

    # What the sensor is ----------------------------------------------------------------------------
    @property
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the whole sensor."""
        self._require()
        return self._images.sensor

    @property
    def pixel_pitch_um(self) -> float:
        """Pitch of the unbinned pixels, as configured, or as the camera says."""
        self._require()
        return self._pitch_um

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """Formats that can be unpacked, the best for measuring first."""
        self._require()
        return tuple(self._images.formats)

    # Pixel format ----------------------------------------------------------------------------------
    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""
        self._require()
        return self._images.format_name

    @property
    def significant_bits(self) -> int:
        """Bits of the pixel format."""
        self._require()
        return self._images.format.bits

    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format."""
        self._require_idle("pixel format")
        self._require_offered("pixel format", pixel_format, self.pixel_formats)
        self._images.apply_format(pixel_format)
        self._remember("pixel_format", lambda: self.set_pixel_format(pixel_format))
        return self._images.format_name

    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region; its borders fall on the camera's steps inside the one asked for."""
        self._require_idle("region of interest")
        whole = Roi(0, 0, *self._images.sensor)
        asked = whole if roi is None else roi
        if not (whole.contains(asked) and self._images.apply_roi(asked)):
            raise self._no_region(asked, self._images.refused())
        self._roi = self._images.roi
        self._remember("roi", lambda: self.set_roi(roi))
        return self._roi

    @property
    def binning(self) -> int:
        """Sensor pixels binned along each axis."""
        self._require()
        return self._images.binning

    @property
    def binnings(self) -> tuple[int, ...]:
        """The binning factors that the camera's limits allow."""
        self._require()
        if not self._features.find("BinningHorizontal"):
            return (1,)
        highs = [self._features.bounds(f"Binning{axis}")[1] for axis in ("Horizontal", "Vertical")]
        return tuple(n for n in (1, 2, 3, 4, 8, 16) if n <= min(highs))

    def set_binning(self, binning: int) -> int:
        """Set the binning along both axes; the region becomes the whole sensor."""
        self._require_idle("binning")
        self._require_offered("binning", binning, self.binnings)
        self._images.apply_binning(binning)
        self._roi = self._images.roi
        self._forget("roi")
        self._remember("binning", lambda: self.set_binning(binning))
        return self._images.binning

    def _write_trigger(self, mode: TriggerMode) -> None:
        options = self.options
        set_trigger(self._features, self.name, mode, options.trigger_line, options.trigger_activation)

    @property
    def stream_statistics(self) -> Mapping[str, int]:
        """Aravis' counts of the running or last sequence: ``n_missing_packets``, ``n_resent_packets`` ..."""
        stream = self._stream
        return dict(self._statistics) if stream is None else stream_statistics(stream)

    # Streaming -------------------------------------------------------------------------------------
    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        features, aravis, camera = self._features, self._aravis, self._camera
        self._woken.clear()
        self._apply_rate()
        with features.words("start streaming"):
            self._stream = camera.create_stream(None, None)
            if self._stream is None:
                raise DeviceError(
                    self.name, "did not open a stream.", "Is another program streaming from it?"
                )
            if camera.is_gv_device() and not self.options.packet_resend:
                self._stream.set_property("packet-resend", aravis.GvStreamPacketResend.NEVER)
            payload = camera.get_payload()
            for _ in range(n_buffers):
                self._stream.push_buffer(aravis.Buffer.new_allocate(payload))
            camera.start_acquisition()
        if camera.is_gv_device():
            return FrameNumberCounter(_BLOCK_IDS, 1)
        return FrameNumberCounter() if camera.is_uv_device() else Underruns(self._stream, _BLOCK_IDS)

    def _take(self, timeout_s: float) -> RawFrame | None:
        deadline_s = time.monotonic() + timeout_s
        while True:
            self._require()  # the control may have been lost meanwhile
            left_s = deadline_s - time.monotonic()
            buffer = self._stream.timeout_pop_buffer(round(max(0.0, min(left_s, _SLICE_S)) * 1e6))
            if buffer is not None:
                return self._raw(buffer)
            if left_s <= 0 or self._woken.is_set():
                return None

    def _raw(self, buffer: Any) -> RawFrame:
        complete = buffer.get_status() == self._aravis.BufferStatus.SUCCESS
        if complete:
            width, height = buffer.get_image_width(), buffer.get_image_height()
            padding, _ = buffer.get_image_padding()
            pixels = self._images.format
            self._line_bytes = pixels.line_bytes(width) + padding if padding else None
            complete = (height, width) == self.image_shape
        data = np.frombuffer(buffer.get_data() if complete else b"", np.uint8)
        return RawFrame(
            data=data,
            number=buffer.get_frame_id(),
            device_time_ns=buffer.get_timestamp() or None,
            complete=complete,
            buffer=buffer,
        )

    def _give_back(self, raw: RawFrame) -> None:
        self._stream.push_buffer(raw.buffer)

    def _wake(self) -> None:
        self._woken.set()

    def _end(self) -> None:
        stream, self._stream = self._stream, None
        if stream is None:
            return
        with contextlib.suppress(library_error()):  # of a camera that is gone
            self._camera.stop_acquisition()
        self._statistics = stream_statistics(stream)

    def _decode(self, data: Bytes, out: Pixels) -> bool:
        return unpack(data, self._images.format.packing, out, self._line_bytes)

    def _fire(self) -> None:
        self._features.execute("TriggerSoftware")
