"""A GenICam camera, whichever library reaches it: its settings by its features."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field

from drivers.camera import Roi, TriggerEdge, TriggerMode
from drivers.common.buffered_camera import BufferedCamera
from drivers.common.camera_settings import GainScale, GainUnit
from drivers.common.pixels import Bytes, Pixels, unpack
from drivers.device import DriverOptions, OwnSetting, Setting
from drivers.errors import DeviceError, DeviceLostError, LimitError
from drivers.genicam.features import (
    BLACK_LEVEL,
    DRIVERS_OWN,
    EXPOSURE,
    FRAME_RATE,
    FRAME_RATE_ENABLE,
    GAIN,
    STEADY,
    SWITCHED,
    Features,
    FeatureValue,
)
from drivers.genicam.images import TRIGGER_EDGES, Images, set_trigger, trigger_lines

GIGE_BLOCK_IDS = 1 << 16
"""Frame ids of GigE Vision 1 start again after this many, at 1."""


class GenicamOptions(DriverOptions):
    """Options that every GenICam camera has in ``bench.toml``."""

    pixel_pitch_um: float | None = Field(
        None, gt=0, description="Pitch of the pixels, micrometres, of a camera that does not say it."
    )
    frames_per_s: float | None = Field(
        None, gt=0, description="Frames a second when running free; left out: as the camera has it."
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
    features: dict[str, str | bool | int | float] = Field(
        default_factory=dict, description="Other features to set on opening, by their GenICam names."
    )


class GenicamCamera(BufferedCamera):
    """A camera by its GenICam features; a library's own class connects it and takes its frames."""

    trigger_modes = ("free_run", "software", "hardware")
    options: GenicamOptions
    _features: Features
    _images: Images
    _line_bytes: int | None = None
    """None where a frame's lines follow each other without padding, even inside a byte."""

    def _prepare(self) -> None:
        """Bring the camera to a state in which nothing happens by itself, and read what it is."""
        features = self._features
        for name, entry in STEADY:
            if features.find(name) and features.text(name) != entry and entry in features.entries(name):
                features.choose(name, entry)
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
        self._lines = trigger_lines(features)
        self._trigger_line = next((line for line in ("Line1", *self._lines) if line in self._lines), "")
        self._images = Images(features, self._read_sensor)
        for name, value in self.options.features.items():
            features.set_any(name, value)
        enable = features.find(*FRAME_RATE_ENABLE)
        self._found_limited = bool(enable and SWITCHED.get(features.text(enable).lower()))
        self._look_again()

    def _look_again(self) -> None:
        """Read what a feature may have changed with itself: a mosaic's order, region, exposure, gain."""
        features = self._features
        self._images.look_again()
        self._roi = self._images.roi
        self._rate = features.number(self._rate_name) if self._rate_name else 0.0
        self._exposure_ms = features.number(self._exposure_name) / 1e3
        self._gain = self._read_gain()

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
        for name in self.options.features:
            made[f"feature.{name}"] = features.text(name)
        return made

    def own_settings(self) -> Mapping[str, OwnSetting]:
        """Return the features that ``bench.toml`` names, of hundreds, but for those that the driver sets."""
        self._require()
        features, found = self._features, {}
        for name in self.options.features:
            if name in DRIVERS_OWN:
                continue
            kind = features.kind(name)
            if kind == "number":
                low, high = features.bounds(name)
                found[name] = OwnSetting(features.text(name), f"{low:g} to {high:g}")
            elif kind in ("choice", "switch"):
                choices = features.entries(name) if kind == "choice" else ("true", "false")
                found[name] = OwnSetting(features.text(name), ", ".join(choices), choices)
        return found

    def set_own(self, name: str, value: str) -> Setting:
        """Set a feature that ``bench.toml`` names; errors as ``Features.set_any``."""
        known = self.own_settings().get(name)
        if known is None or (self._features.kind(name) == "switch" and value not in known.choices):
            return super().set_own(name, value)
        kind = self._features.kind(name)
        try:
            number = float(value) if kind == "number" else 0.0
        except ValueError:
            raise LimitError(self.name, f"takes no {name} {value!r}.", f"It takes {known.takes}.") from None
        was, before = self._value(name), self._images.format_name
        try:
            self._features.set_any(
                name, number if kind == "number" else value == "true" if kind == "switch" else value
            )
            self._look_again()
        except DeviceLostError:
            raise
        except BaseException as error:  # images that cannot be read, say: it stays as it was
            self._set_back(name, was, error)
            raise
        self._remember_own(name, value, known.choices)
        if (now := self._images.format_name) != before and "pixel_format" in self._remembered:
            self._remember("pixel_format", lambda: self.set_pixel_format(now))
        return self._features.text(name)

    def _value(self, name: str) -> FeatureValue:
        features = self._features
        return features.number(name) if features.kind(name) == "number" else features.text(name)

    def _set_back(self, name: str, was: FeatureValue, error: BaseException) -> None:
        """Undo a feature whose change led to an error; that this fails too becomes a note."""
        try:
            if self._value(name) != was:
                self._features.set_any(name, was)
                self._look_again()
        except DeviceError as another:
            error.add_note(f"Nor could {name} be set back: {another}")

    # Exposure, gain, black level -------------------------------------------------------------------
    @property
    def _period_s(self) -> float:
        return 1 / self._rate if self._rate else 0.0

    def _apply_rate(self) -> None:
        """Set the configured frame rate, whose limits depend on region and exposure; note the present one.

        Triggers are not held to it: of those that come sooner a camera makes no frame, and no number.
        """
        features, wanted = self._features, self.options.frames_per_s
        is_free = self._trigger_mode == "free_run"
        self._limit_rate(is_free and (self._found_limited or wanted is not None))
        if wanted is not None and is_free:
            if self._rate_name is None:
                raise DeviceError(self.name, "its frame rate cannot be set.", "Leave frames_per_s out.")
            low, high = features.bounds(self._rate_name)
            if not low <= wanted <= high:
                raise LimitError(
                    self.name,
                    f"cannot send {wanted:g} frames/s.",
                    f"With these settings: {low:g} to {high:g}.",
                )
            features.set_number(self._rate_name, wanted)
        self._rate = features.number(self._rate_name) if self._rate_name else 0.0

    def _limit_rate(self, limited: bool) -> None:
        """Let the frame rate be held to its number, or not, where the camera has a switch for that."""
        features = self._features
        enable = features.find(*FRAME_RATE_ENABLE)
        if enable is None or features.kind(enable) != "switch":
            return
        if SWITCHED.get(features.text(enable).lower()) != limited:
            features.set_any(enable, limited)

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

    @property
    def trigger_lines(self) -> tuple[str, ...]:
        """What its TriggerSource offers, but for software."""
        self._require()
        return self._lines

    @property
    def trigger_edges(self) -> tuple[TriggerEdge, ...]:
        """The edges that its TriggerActivation offers."""
        self._require()
        if not self._features.find("TriggerActivation"):
            return ()
        offered = self._features.entries("TriggerActivation")
        return tuple(edge for edge, name in TRIGGER_EDGES.items() if name in offered)

    @property
    def readout_ms(self) -> float:
        """Time of a frame at the highest rate of its present settings, which read-out fits into."""
        self._require()
        fastest = self._features.bounds(self._rate_name)[1] if self._rate_name else 0.0
        return 1e3 / fastest if fastest > 0 else super().readout_ms

    def _write_trigger(self, mode: TriggerMode) -> None:
        if mode != "free_run":  # some cameras lock the switch of their rate while TriggerMode is On
            set_trigger(self._features, "free_run", self._trigger_line, self._trigger_edge)
            self._limit_rate(False)
        set_trigger(self._features, mode, self._trigger_line, self._trigger_edge)

    def _fire(self) -> None:
        self._features.execute("TriggerSoftware")

    # Frames ----------------------------------------------------------------------------------------
    def _note_padding(self, n_bytes: int) -> None:
        """Take note of how many bytes follow each line of the frame that comes next."""
        line_bytes = self._images.format.line_bytes(self.image_shape[1])
        self._line_bytes = line_bytes + n_bytes if n_bytes else None

    def _decode(self, data: Bytes, out: Pixels) -> bool:
        return unpack(data, self._images.format.packing, out, self._line_bytes)
