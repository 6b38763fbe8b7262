"""The camera of a Raspberry Pi: raw frames of its sensor, with what each was exposed with."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

from pydantic import Field

from drivers.camera import Roi
from drivers.common.buffered_camera import RawFrame
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels
from drivers.common.running_camera import RunningCamera
from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, OwnSetting, Setting, SharedPart
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError
from drivers.raspberry.modes import (
    RawFormat,
    ask_for,
    decode,
    found_cameras,
    offered_formats,
    picamera2,
    sizes,
)

_MANUAL: Mapping[str, Any] = {"AeEnable": False, "AwbEnable": False, "AfMode": 0}
"""What would change pictures by itself, switched off where the camera has it."""
_LOOKED_AFTER = frozenset(
    (*_MANUAL, "ExposureTime", "ExposureTimeMode", "AnalogueGain", "AnalogueGainMode", "FrameDurationLimits")
)
_ARRAYS = frozenset(("ColourGains", "ColourCorrectionMatrix"))
"""Controls of several numbers, for whose limits libcamera names one."""
_READ_BACK_MS = 500.0
"""Exposures up to this are read back from a frame; a line more or less is nothing to longer ones."""
_SAME = 0.02
_SAME_US = 100.0
_START_S = 5.0


class RaspberryOptions(DriverOptions):
    """Options of a Raspberry Pi's camera in ``bench.toml``."""

    index: int = Field(0, ge=0, description="Which camera, as rpicam-hello --list-cameras numbers them.")
    size: tuple[int, int] | None = Field(
        None,
        description="[height, width] of the sensor mode, before a region; left out: the largest.",
    )
    pixel_pitch_um: float | None = Field(
        None, gt=0, description="Pitch of the pixels that are sent; left out: as libcamera knows the sensor."
    )
    frames_per_s: float | None = Field(
        None, gt=0, description="Frames a second; left out: as many as the exposure allows."
    )
    controls: dict[str, bool | int | float] = Field(
        default_factory=dict,
        description="Further libcamera controls, by their names, e.g. { LensPosition = 0.0 }.",
    )


class RaspberryCamera(RunningCamera):
    """A camera on the CSI connector: raw Bayer or monochrome frames, 8 to 16 bit, packed or not.

    Exposure, white balance and focus do nothing by themselves. Frames are counted by the receiver's own
    numbers. The shutter rolls: a frame's device time is the end of its first line's exposure.
    """

    Options = RaspberryOptions
    _clock = time.CLOCK_BOOTTIME
    no_binning = "Give a smaller sensor mode by size."
    trigger_modes = ("free_run", "software")

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = RaspberryOptions.of(options)
        self._camera: Any = None
        self._done: deque[Any] = deque()
        self._came = threading.Condition()
        self._waking = False
        self._black = 0.0
        self._own: dict[str, bool | int | float] = dict(self.options.controls)

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the camera by its number."""
        return (f"CSI camera {RaspberryOptions.of(options).index}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the cameras on the CSI connectors, where this is a Raspberry Pi."""
        return found_cameras()

    @property
    def name(self) -> str:
        """The camera as error messages name it."""
        return f"camera (raspberry {self.options.index})"

    # Opening ---------------------------------------------------------------------------------------
    @property
    def _connected(self) -> bool:
        return self._camera is not None

    def _connect(self) -> None:
        library = picamera2(self.name)
        infos = library.global_camera_info()
        if self.options.index >= len(infos):
            listed = ", ".join(f"{n}: {info.get('Model')}" for n, info in enumerate(infos)) or "none"
            raise DeviceError(
                self.name,
                f"there is no such camera; found {listed}.",
                "Check its ribbon cable with the power off, then rpicam-hello --list-cameras.",
            )
        try:
            self._camera = library(self.options.index)
        except RuntimeError as error:
            raise DeviceError(
                self.name, f"cannot be opened: {error}.", "Another program may have it: close that one."
            ) from error
        try:
            self._camera.post_callback = self._completed
            self._learn()
        except BaseException:
            self._disconnect()
            raise

    def _disconnect(self) -> None:
        camera, self._camera = self._camera, None
        with contextlib.suppress(RuntimeError):  # of a camera that does not answer any more
            camera.close()

    def _learn(self) -> None:
        """Read what the sensor is, and bring the camera to a state in which nothing happens by itself."""
        camera = self._camera
        properties = dict(camera.camera_properties)
        modes = [mode for mode in camera.sensor_modes if "size" in mode and "bit_depth" in mode]
        offered = sizes(modes)
        if not offered:
            raise DeviceError(self.name, "sends no raw frames.", "A USB camera is used by driver v4l2.")
        wanted = self.options.size or offered[0]
        self._require_offered("sensor mode", tuple(wanted), offered)
        self._whole = Roi(0, 0, *wanted)
        self._roi = self._whole
        mine = [mode for mode in modes if (mode["size"][1], mode["size"][0]) == tuple(wanted)]
        self._formats = offered_formats(camera, mine, self._whole, self.name)
        cell_nm = properties.get("UnitCellSize")
        crop = mine[0].get("crop_limits") or (0, 0, *mine[0]["size"])
        self._sent_per_cell = crop[2] / mine[0]["size"][0]
        self._pitch_um = self.options.pixel_pitch_um or (
            cell_nm[0] / 1e3 * self._sent_per_cell if cell_nm else 0.0
        )
        if not self._pitch_um:
            raise DeviceError(self.name, "does not say its pixels' pitch.", "Give pixel_pitch_um.")
        self._identity = DeviceIdentity(
            kind="camera",
            driver="raspberry",
            vendor="Raspberry Pi",
            model=str(properties.get("Model", "camera")),
            serial_number="",
            firmware="",
            simulated=False,
        )
        self._trigger_mode = "free_run"
        self._configure(self._formats[0])
        limits = camera.camera_controls
        for name in self.options.controls:
            if name not in limits:
                raise LimitError(self.name, f"has no control {name}.", f"It has {', '.join(sorted(limits))}.")
        least, most = self.exposure_limits_ms
        self._exposure_ms = min(max(10.0, least), most)
        self._gain = self.gain_limits[0]
        self._read_back()

    def _configure(self, wanted: RawFormat, n_buffers: int = 4) -> None:
        ask_for(self._camera, wanted.asked, self._whole, n_buffers, self.name)
        self._format = wanted
        raw = self._camera.camera_configuration()["raw"]
        self._line_bytes = int(raw["stride"])
        if tuple(raw["size"]) != (self._whole.width, self._whole.height):
            raise DeviceError(self.name, f"sends {raw['size']} where {self._whole} was asked for.")

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings, the camera's controls with their ranges under ``control.NAME``."""
        self._require()
        made = self._common_settings() | {"roi_cut_by": "driver", "frames_per_s": self.options.frames_per_s}
        for name, limits in sorted(self._camera.camera_controls.items()):
            made[f"control.{name}"] = ", ".join(map(str, limits))
        return made

    def own_settings(self) -> Mapping[str, OwnSetting]:
        """Return libcamera's controls that are one number or switch, but for what the driver looks after."""
        self._require()
        found = {}
        for name, (least, most, default) in sorted(self._camera.camera_controls.items()):
            if name in _LOOKED_AFTER | _ARRAYS or not isinstance(least, bool | int | float):
                continue
            takes = "0 or 1" if isinstance(least, bool) else f"{least:g} to {most:g}"
            found[name] = OwnSetting(self._own.get(name, default), takes)
        return found

    def set_own(self, name: str, value: str) -> Setting:
        """Set a control by its libcamera name, a number; it holds for the frames from now on.

        Returns the value that was set: libcamera reads back few of them.
        """
        known = self.own_settings().get(name)
        if known is None:
            return super().set_own(name, value)
        least, most, _ = self._camera.camera_controls[name]
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not least <= number <= most or (not isinstance(least, float) and number != round(number)):
            problem = f"control {name} does not take {value!r}."
            raise LimitError(self.name, problem, f"It takes {known.takes}.")
        before = dict(self._own)
        self._own[name] = type(least)(number)
        try:
            self._apply()
        except DeviceError:
            self._own = before
            raise
        return self._own[name]

    # Exposure and gain -----------------------------------------------------------------------------
    @property
    def exposure_limits_ms(self) -> tuple[float, float]:
        """Shortest and longest exposure of the sensor."""
        self._require()
        least, most, _ = self._camera.camera_controls["ExposureTime"]
        longest = most or self._camera.camera_controls["FrameDurationLimits"][1]
        return max(1, least) / 1e3, longest / 1e3

    @property
    def gain_limits(self) -> tuple[float, float]:
        """Smallest and largest analogue gain of the sensor."""
        self._require()
        least, most, _ = self._camera.camera_controls["AnalogueGain"]
        return float(least), float(most)

    def _write_exposure(self, exposure_ms: float) -> float:
        self._exposure_ms = round(exposure_ms * 1e3) / 1e3
        self._apply()
        return self._exposure_ms

    def _write_gain(self, gain: float) -> float:
        self._gain = gain
        self._apply()
        return self._gain

    def _apply(self) -> None:
        """Bring settings to the camera: into a running sequence as they are, else read back from a frame."""
        if self._run is not None:
            self._camera.set_controls(self._controls())
        else:
            self._read_back()

    def _controls(self) -> dict[str, Any]:
        exposure_us = round(self._exposure_ms * 1e3)
        wanted = self.options.frames_per_s
        fastest_us = self._camera.camera_controls["FrameDurationLimits"][0]
        period_us = max(fastest_us, round(1e6 / wanted)) if wanted else fastest_us
        asked: dict[str, Any] = {
            **_MANUAL,
            "ExposureTime": exposure_us,
            "AnalogueGain": self._gain,
            # Up to somewhat more than the exposure: a sensor's frame lasts a few lines longer.
            "FrameDurationLimits": (period_us, max(period_us, exposure_us + exposure_us // 10 + 10_000)),
            **self._own,
        }
        return {name: value for name, value in asked.items() if name in self._camera.camera_controls}

    def _read_back(self) -> None:
        """Take a frame and read what exposure, gain and black level the sensor made of it."""
        if self._exposure_ms > _READ_BACK_MS:
            return
        with self._fetching:
            try:
                self._begin(2)
                until_s = time.monotonic() + _START_S + 4 * self._exposure_ms / 1e3
                raw = self._take(until_s - time.monotonic())
                while raw is not None and not self._is_settled(raw):
                    self._give_back(raw)  # a sensor that never gets there would send for ever
                    raw = self._take(max(0.0, until_s - time.monotonic()))
                    if raw is not None and time.monotonic() > until_s:
                        self._give_back(raw)
                        raw = None
                if raw is None:
                    raise DeviceTimeoutError(
                        self.name, "sends no frame with the exposure it was set to.", "Check its cable."
                    )
                said = raw.facts
                self._exposure_ms, self._gain = said["exposure_ms"], said["gain"]
                self._black = said["black_level"]
                self._give_back(raw)
            finally:
                self._end()

    @property
    def black_level(self) -> float:
        """The sensor's offset in counts, as libcamera knows it; it cannot be set."""
        self._require()
        return self._black

    @property
    def _black_limits(self) -> tuple[float, float]:
        return self._black, self._black

    def _write_black(self, black_level: float) -> None:
        pass  # the only one there is

    # What the sensor is ----------------------------------------------------------------------------
    @property
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the sensor mode."""
        self._require()
        return self._whole.height, self._whole.width

    @property
    def pixel_pitch_um(self) -> float:
        """Pitch of the pixels that are sent: those of modes that bin on the sensor are larger."""
        self._require()
        return self._pitch_um

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """Raw formats, the deepest first."""
        self._require()
        return tuple(offered.name for offered in self._formats)

    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""
        self._require()
        return self._format.name

    @property
    def significant_bits(self) -> int:
        """Bits of the sensor in this format."""
        self._require()
        return self._format.pixels.bits

    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format."""
        self._require_idle("pixel format")
        self._require_offered("pixel format", pixel_format, self.pixel_formats)
        self._configure(self._formats[self.pixel_formats.index(pixel_format)])
        self._read_back()
        self._remember("pixel_format", lambda: self.set_pixel_format(pixel_format))
        return self._format.name

    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region, cut out of each frame by this driver; its borders fall on even pixels."""
        self._require_idle("region of interest")
        wanted = self._whole if roi is None else roi.inside(2 if self._format.pixels.bayer else 1)
        if not (self._whole.contains(roi or wanted) and self._whole.contains(wanted)):
            raise self._no_region(
                roi or wanted, f"Its frames have {self._whole.height} x {self._whole.width} pixels."
            )
        self._roi = wanted
        self._remember("roi", lambda: self.set_roi(roi))
        return wanted

    # Streaming -------------------------------------------------------------------------------------
    @property
    def _period_s(self) -> float:
        return float(self._controls()["FrameDurationLimits"][0]) / 1e6

    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        self._waking = False
        if self._camera.camera_configuration()["buffer_count"] < n_buffers:
            self._configure(self._format, n_buffers)
        self._make_ready((self._whole.height, self._whole.width))
        self._camera.set_controls(self._controls())
        try:
            self._camera.start()
        except RuntimeError as error:
            raise DeviceError(self.name, f"does not start: {error}.", "Check its cable.") from error
        return None if self._trigger_mode == "software" else FrameNumberCounter()

    def _completed(self, request: Any) -> None:
        """Keep a frame that picamera2 has, in its own thread; it gets its buffer back from ``_give_back``."""
        request.acquire()
        with self._came:
            self._done.append(request)
            self._came.notify_all()

    def _take(self, timeout_s: float) -> RawFrame | None:
        with self._came:
            self._came.wait_for(lambda: self._done or self._waking, timeout_s)
            if not self._done or self._waking:
                return None
            request = self._done.popleft()
        said = request.get_metadata()
        stream = self._camera.stream_map["raw"]
        black = said.get("SensorBlackLevels", (0,))[0] / (1 << 16 - self._format.pixels.bits)
        return RawFrame(
            data=request.make_buffer("raw"),
            number=int(request.request.buffers[stream].metadata.sequence),
            device_time_ns=said.get("SensorTimestamp"),
            complete=True,
            buffer=request,
            facts={
                "exposure_ms": said["ExposureTime"] / 1e3,
                "gain": float(said["AnalogueGain"]),
                "black_level": black,
            },
        )

    def _give_back(self, raw: RawFrame) -> None:
        raw.buffer.release()  # type: ignore[attr-defined]

    def _wake(self) -> None:
        with self._came:
            self._waking = True
            self._came.notify_all()

    def _end(self) -> None:
        if self._camera is None:
            return
        with contextlib.suppress(RuntimeError):
            self._camera.stop()
        with self._came:
            left, self._done = list(self._done), deque()
        for request in left:
            request.release()

    def _decode_whole(self, data: Bytes, out: Pixels) -> bool:
        return decode(data, self._format, self._line_bytes, out, self.name)

    def _is_settled(self, raw: RawFrame) -> bool:
        """Whether a frame was exposed with what is set now: settings take some frames to arrive."""
        off_us = 1e3 * abs(raw.facts["exposure_ms"] - self._exposure_ms)
        return bool(
            off_us <= max(_SAME_US, _SAME * 1e3 * self._exposure_ms)
            and abs(raw.facts["gain"] - self._gain) <= 0.1 * self._gain
        )

    def _asked_for(self, raw: RawFrame) -> bool:
        return (self.is_streaming or self._is_settled(raw)) and super()._asked_for(raw)
