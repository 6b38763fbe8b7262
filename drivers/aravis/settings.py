"""The settings of a GenICam camera, by the names of the SFNC and those before it."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, cast

from pydantic import Field

from drivers.aravis.features import (
    AUTOMATICS,
    BLACK_LEVEL,
    EXPOSURE,
    FIRMWARE,
    FRAME_RATE,
    FRAME_RATE_ENABLE,
    GAIN,
    Features,
    enable_fake,
    library_error,
    load,
)
from drivers.common.buffered_camera import BufferedCamera
from drivers.common.gain import GainScale, GainUnit
from drivers.device import DeviceIdentity, DriverOptions, SharedPart
from drivers.errors import DeviceError, DeviceLostError, LimitError
from drivers.registry.claim import DeviceBusyError

_MISSING = "Is it on, connected, and in this computer's subnet? arv-tool-0.8 lists what Aravis finds."
_FAKES = {("Aravis", "Fake"), ("vitavision.dev", "VivaCam Fake")}


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


class AravisSettings(BufferedCamera):
    """The part of a GenICam camera that takes no images."""

    Options = AravisOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = options = AravisOptions.of(options)
        self._aravis: Any = None
        self._camera: Any = None
        self._handler = 0

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the camera by its configured id."""
        return (f"GenICam camera {cast(AravisOptions, options).device_id or '(the only one)'}",)

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
        self._camera = self._find_camera()
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

    def _find_camera(self) -> Any:
        aravis, wanted = self._aravis, self.options.device_id
        enable_fake(aravis, wanted)
        if wanted is None:
            aravis.update_device_list()
            ids = [aravis.get_device_id(i) for i in range(aravis.get_n_devices())]
            if len(ids) != 1:
                raise DeviceError(
                    self.name,
                    f"{len(ids)} GenICam cameras were found{': ' if ids else ''}{', '.join(ids)}.",
                    "Name one by device_id." if ids else _MISSING,
                )
            wanted = ids[0]
        try:
            return aravis.Camera.new(wanted)
        except library_error() as error:
            message = error.message  # type: ignore[attr-defined]
            raise DeviceError(self.name, f"was not found: {message}.", _MISSING) from error

    def _prepare(self) -> None:
        """Bring the camera to a state in which nothing happens by itself, and read what it is."""
        features = self._features
        for automatic in AUTOMATICS:
            if features.find(automatic) and "Off" in features.entries(automatic):
                features.choose(automatic, "Off")
        if features.find("AcquisitionMode"):
            features.choose("AcquisitionMode", "Continuous")
        self._identity = self._identify()
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
        self._open_images()
        for name, value in self.options.features.items():
            features.set_any(name, value)
        self._rate = features.number(self._rate_name) if self._rate_name else 0.0
        self._exposure_ms = features.number(self._exposure_name) / 1e3
        self._gain = self._read_gain()
        if self._camera.is_gv_device():
            self._prepare_network()

    @abstractmethod
    def _open_images(self) -> None:
        """Bring format, region, binning and trigger to their state after opening."""

    def _prepare_network(self) -> None:
        camera, options = self._camera, self.options
        with self._features.words("agree on a packet size"):
            if options.packet_size is None:
                camera.gv_auto_packet_size()
            else:
                camera.gv_set_packet_size(options.packet_size)
            if options.packet_delay_ns is not None:
                camera.gv_set_packet_delay(options.packet_delay_ns)

    def _identify(self) -> DeviceIdentity:
        with self._features.words("say who it is"):
            vendor, model = self._camera.get_vendor_name(), self._camera.get_model_name()
            serial = self._camera.get_device_serial_number()
        firmware = self._features.find(*FIRMWARE)
        return DeviceIdentity(
            kind="camera",
            driver="aravis",
            vendor=vendor or "unknown",
            model=model or "unknown",
            serial_number=serial or "",
            firmware=self._features.text(firmware) if firmware else "",
            simulated=(vendor, model) in _FAKES,
        )

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
        self._features = None  # type: ignore[assignment]  # the last reference gives the camera's control back

    def _on_control_lost(self, _device: Any) -> None:
        self._note_lost(
            DeviceLostError(
                self.name,
                "is not controlled by this program any more: unplugged, switched off, or taken over.",
                "Check cable and power, then open it again.",
            )
        )

    @property
    def identity(self) -> DeviceIdentity:
        """Who the camera says it is."""
        self._require()
        return self._identity

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
    def exposure_ms(self) -> float:
        """Exposure time."""
        self._require()
        return self._exposure_ms

    @property
    def exposure_limits_ms(self) -> tuple[float, float]:
        """Shortest and longest exposure that the camera takes now."""
        self._require()
        low, high = self._features.bounds(self._exposure_name)
        return low / 1e3, high / 1e3

    def set_exposure_ms(self, exposure_ms: float) -> float:
        """Set the exposure; returns what the camera made of it."""
        low, high = self.exposure_limits_ms
        if not low <= exposure_ms <= high:
            raise LimitError(
                self.name, f"cannot expose {exposure_ms:g} ms.", f"Its exposure is {low:g} to {high:g} ms."
            )
        self._exposure_ms = self._features.set_number(self._exposure_name, exposure_ms * 1e3) / 1e3
        self._remember("exposure_ms", lambda: self.set_exposure_ms(exposure_ms))
        return self._exposure_ms

    def _scale(self) -> GainScale:
        assert self._gain_name is not None
        unit = self.options.gain_unit
        if unit is None:
            unit = "dB" if self._features.unit(self._gain_name).lower() == "db" else "steps"
        return GainScale(unit, self.options.gain_per_count, self._features.bounds(self._gain_name)[0])

    def _read_gain(self) -> float:
        return self._scale().factor(self._features.number(self._gain_name)) if self._gain_name else 1.0

    @property
    def gain(self) -> float:
        """Gain as a factor (see the options ``gain_unit`` and ``gain_per_count``); 1 without one."""
        self._require()
        return self._gain

    @property
    def gain_limits(self) -> tuple[float, float]:
        """Smallest and largest gain factor."""
        self._require()
        if self._gain_name is None:
            return 1.0, 1.0
        scale, (low, high) = self._scale(), self._features.bounds(self._gain_name)
        return scale.factor(low), scale.factor(high)

    def set_gain(self, gain: float) -> float:
        """Set the gain factor; returns what the camera made of it."""
        low, high = self.gain_limits
        if not low <= gain <= high:
            raise LimitError(self.name, f"has no gain {gain:g}.", f"Its gain is {low:g} to {high:g}.")
        if self._gain_name is not None:
            self._features.set_number(self._gain_name, self._scale().number(gain))
            self._gain = self._read_gain()
        self._remember("gain", lambda: self.set_gain(gain))
        return self._gain

    @property
    def black_level(self) -> float:
        """Offset as the camera counts it; 0 without one."""
        self._require()
        return self._features.number(self._black_name) if self._black_name else 0.0

    def set_black_level(self, black_level: float) -> float:
        """Set the offset; without one only 0 is taken."""
        self._require_idle("black level")
        low, high = self._features.bounds(self._black_name) if self._black_name else (0.0, 0.0)
        if not max(low, 0) <= black_level <= high:
            raise LimitError(
                self.name, f"has no black level {black_level:g}.", f"It is {max(low, 0):g} to {high:g}."
            )
        if self._black_name:
            self._features.set_number(self._black_name, black_level)
        self._remember("black_level", lambda: self.set_black_level(black_level))
        return self.black_level
