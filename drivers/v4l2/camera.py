"""The V4L2 camera: any video device of the kernel that streams."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import ClassVar

from pydantic import Field, PositiveInt

from drivers.camera import Roi
from drivers.common.buffered_camera import RawFrame
from drivers.common.camera_settings import GainScale, GainUnit
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels
from drivers.common.running_camera import RunningCamera
from drivers.device import DriverOptions, FoundDevice, OwnSetting, Setting, SharedPart, port_claim
from drivers.errors import DeviceError, DeviceLostError, LimitError
from drivers.registry.buses import lasting_name, video_devices
from drivers.v4l2 import api
from drivers.v4l2.controls import Control, Controls, Quantity
from drivers.v4l2.device import FilledBuffer, VideoDevice
from drivers.v4l2.formats import V4l2Format, decode
from drivers.v4l2.images import Images
from drivers.v4l2.node import Node

_SEQUENCE_MODULUS = 1 << 32
_EXPOSURE_COUNT_MS = 0.1
"""Unit of the control exposure_time_absolute: 100 us."""


class V4l2Options(DriverOptions):
    """Options of a V4L2 camera in ``bench.toml``."""

    device: str = Field(
        "/dev/video0",
        min_length=1,
        description="Device node; a link in /dev/v4l/by-id stays the same when cameras are plugged anew.",
    )
    subdevices: tuple[str, ...] = Field(
        (),
        description=(
            'Nodes with controls of the sensor or the lens, e.g. ["/dev/v4l-subdev0"]: camera modules, whose '
            "/dev/video* has none (media-ctl -p names them)."
        ),
    )
    pixel_pitch_um: float = Field(
        gt=0, description="Pitch of the pixels as they are sent, micrometres: no V4L2 driver knows it."
    )
    input: int | None = Field(None, ge=0, description="Number of the input, of a device with several.")
    size: tuple[PositiveInt, PositiveInt] | None = Field(
        None,
        description="Size of the images before a region is chosen: [height, width]; the largest if left out.",
    )
    frames_per_s: float | None = Field(
        None, gt=0, description="Frames a second to ask for; left out: as the driver has it."
    )
    gain_unit: GainUnit = Field(
        "steps",
        description='What the gain control counts: "dB", "factor", or "steps" of unknown meaning.',
    )
    gain_per_count: float = Field(1.0, gt=0, description="How many of that unit one count of the control is.")
    exposure_line_us: float | None = Field(
        None,
        gt=0,
        description=(
            'What one count of the control "exposure" lasts, microseconds, for sensors that have no '
            '"exposure_time_absolute" (their data sheet: time of a line).'
        ),
    )
    frames_to_skip: int = Field(
        2,
        ge=0,
        le=100,
        description="Frames let go at the start of each snap: many cameras apply settings late.",
    )
    controls: dict[str, int] = Field(
        default_factory=dict,
        description="Other controls to set on opening, by the names of v4l2-ctl --list-ctrls.",
    )


class V4l2Camera(RunningCamera):
    """A V4L2 camera; lost frames are counted by the kernel's sequence numbers.

    V4L2 knows no trigger line. In mode ``"software"`` the camera runs on, and the driver hands out, for each
    trigger, the first frame whose exposure began after it: up to a frame's time late.
    """

    Options = V4l2Options
    no_binning = "V4L2 has none: choose a smaller size."
    kernel: ClassVar[api.Kernel] = api.LinuxKernel()
    """What makes the system calls."""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = V4l2Options.of(options)
        self.frames_to_skip = self.options.frames_to_skip
        self._device = VideoDevice(self.options.device, self.name, self.kernel, self._note_lost)
        self._subdevices = [
            Node(path, self.name, self.kernel, self._note_lost) for path in self.options.subdevices
        ]

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the nodes, whatever links they are named by."""
        given = V4l2Options.of(options)
        return tuple(port_claim(node) for node in (given.device, *given.subdevices))

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the video devices that stream images; others may be streaming from them meanwhile."""
        found = []
        for device in video_devices():
            node = VideoDevice(device.address, f"camera (v4l2 {device.address})", cls.kernel)
            try:
                node.open()
            except DeviceError:
                continue  # metadata, a decoder, not permitted: still listed, as its bus has it
            node.close()
            found.append(
                replace(
                    device,
                    driver="v4l2",
                    kind="camera",
                    options={"device": lasting_name(device.address)},
                    note="pixel_pitch_um = (micrometres, from the data sheet of its sensor)",
                )
            )
        return tuple(found)

    @property
    def name(self) -> str:
        """The camera as error messages name it."""
        return f"camera (v4l2 {self.options.device})"

    # Opening ---------------------------------------------------------------------------------------
    @property
    def _connected(self) -> bool:
        return self._device.is_open

    def _connect(self) -> None:
        self._device.open()
        try:
            for node in self._subdevices:
                node.open()
            if self.options.input is not None:
                self._device.call(
                    api.S_INPUT, api.InputNumber(self.options.input), f"take input {self.options.input}"
                )
            self._identity = self._device.identity()
            Controls((self._device, *self._subdevices)).switch_automatics_off()
            self._trigger_mode = "free_run"
            self._images = Images(self._device, self.options.size, self.options.frames_per_s)
            self._roi = self._images.whole
            self._look_at_controls()
            for name, value in self.options.controls.items():
                self.set_control(name, value)
        except BaseException:
            self._disconnect()
            raise

    def _disconnect(self) -> None:
        with ExitStack() as each:  # whether or not the one before it could be closed
            for node in (self._device, *self._subdevices):
                each.callback(node.close)

    def _look_at_controls(self) -> None:
        """Read the controls' ranges, which others change (an exposure fits into a frame), and the values."""
        options, controls = self.options, Controls((self._device, *self._subdevices))
        absolute, lines = controls.find(api.CID_EXPOSURE_ABSOLUTE), controls.find(api.CID_EXPOSURE)
        exposure: Quantity | None = None
        if absolute is not None:
            exposure = Quantity(controls, absolute, GainScale("factor", _EXPOSURE_COUNT_MS, 0))
        elif lines is not None and options.exposure_line_us is not None:
            exposure = Quantity(controls, lines, GainScale("factor", options.exposure_line_us / 1e3, 0))
        self._controls, self._exposure_control = controls, exposure
        gain, black = controls.find(api.CID_ANALOGUE_GAIN, api.CID_GAIN), controls.find(api.CID_BLACK_LEVEL)
        self._gain_control = gain and Quantity(
            controls, gain, GainScale(options.gain_unit, options.gain_per_count, gain.minimum)
        )
        self._black_control = black and Quantity(controls, black, GainScale("factor", 1, 0))
        self._exposure_ms, self._gain = self._read_exposure(), self._read_gain()

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings, the driver's controls under ``control.NAME``."""
        self._require()
        period_s = self._images.period_s
        made = self._common_settings() | {
            "exposure_ms": self._read_exposure(),
            "gain": self._read_gain(),
            "roi_cut_by": "camera" if self._images.cropped else "driver",
            "frames_per_s": 1 / period_s if period_s else None,
        }
        for control in self._controls.by_name.values():
            if control.readable:
                made[f"control.{control.name}"] = self._controls.text(control)
        return made

    # Controls --------------------------------------------------------------------------------------
    @property
    def controls(self) -> tuple[Control, ...]:
        """All controls of the camera with their ranges and menus."""
        self._require()
        return tuple(self._controls.by_name.values())

    def set_control(self, name: str, value: int) -> int:
        """Set a control by its name; returns what it reads afterwards.

        Raises LimitError: no such control, or a value outside its range.
        """
        if not self._connected:
            self._require()
        control = self._controls.named(name)
        if turns := bool(control.flags & api.CTRL_FLAG_MODIFY_LAYOUT):
            self._require_idle(name)
        made = self._controls.set(control, value)
        with suppress(DeviceLostError):  # it was set; what comes next says that the camera has gone since
            if turns:
                self._look_at_images()
            self._look_at_controls()
        return made

    def _look_at_images(self) -> None:
        """Take over what a control has made of format and region: one that turns them moves the mosaic."""
        roi, whole = self._roi, self._images.whole
        self._images.look_again()
        self._roi = self._images.whole
        if roi != whole and self._roi == whole:
            self._roi = self._images.cut(roi)

    def own_settings(self) -> Mapping[str, OwnSetting]:
        """Return the controls that can be set, but for what the driver looks after."""
        self._require()
        own = (self._exposure_control, self._gain_control, self._black_control)
        taken = {quantity.control.name for quantity in own if quantity}
        found = {}
        for control in self._controls.settable():
            if control.name not in taken:
                choices = tuple(f"{value} ({text})" for value, text in control.menu.items())
                found[control.name] = OwnSetting(self._controls.text(control), control.range_text, choices)
        return found

    def set_own(self, name: str, value: str) -> Setting:
        """Set a control by its name: a whole number, of a menu with its text or without."""
        known = self.own_settings().get(name)
        if known is None:
            return super().set_own(name, value)
        try:
            number = int(value.split()[0], 0)
        except (IndexError, ValueError):
            raise LimitError(
                self.name, f"control {name} does not take {value!r}.", f"It takes {known.takes}."
            ) from None
        before, was = self._images.format.name, self._controls.get(self._controls.named(name))
        try:
            self.set_control(name, number)
        except DeviceLostError:
            raise
        except BaseException as error:  # images that cannot be read, say: it stays as it was
            self._set_back(name, was, error)
            raise
        self._remember_own(name, value)
        if (now := self._images.format.name) != before and "pixel_format" in self._remembered:
            self._remember("pixel_format", lambda: self.set_pixel_format(now))
        return self._controls.text(self._controls.named(name))

    def _set_back(self, name: str, was: int, error: BaseException) -> None:
        """Undo a control whose change led to an error; that this fails too becomes a note."""
        try:
            if self._controls.get(self._controls.named(name)) != was:
                self.set_control(name, was)
        except DeviceError as another:
            error.add_note(f"Nor could {name} be set back: {another}")

    # Exposure, gain, black level -------------------------------------------------------------------
    def _read_exposure(self) -> float:
        if self._exposure_control is not None:
            return self._exposure_control.read()
        if self._images.period_s is None:
            raise DeviceError(
                self.name,
                "has no exposure control and no frame rate that tells how long it exposes.",
                'For sensors with the control "exposure", set exposure_line_us.',
            )
        return self._images.period_s * 1e3

    @property
    def exposure_limits_ms(self) -> tuple[float, float]:
        """Shortest and longest exposure; both the frame period of a camera without a control."""
        self._require()
        if self._exposure_control is None:
            return self._exposure_ms, self._exposure_ms
        return self._exposure_control.limits(least=1)

    def set_exposure_ms(self, exposure_ms: float) -> float:
        """Set the exposure; the control counts 100 us, drivers may have coarser steps."""
        if self._exposure_control is None and exposure_ms != self.exposure_ms:
            raise LimitError(
                self.name,
                f"cannot expose {exposure_ms:g} ms.",
                f"Its exposure cannot be set: {self.exposure_ms:g} ms, a frame's period.",
            )
        return super().set_exposure_ms(exposure_ms)

    def _write_exposure(self, exposure_ms: float) -> float:
        return self._exposure_control.write(exposure_ms) if self._exposure_control else exposure_ms

    def _read_gain(self) -> float:
        return self._gain_control.read() if self._gain_control else 1.0

    @property
    def gain_limits(self) -> tuple[float, float]:
        """Smallest and largest gain factor."""
        self._require()
        return self._gain_control.limits() if self._gain_control else (1.0, 1.0)

    def _write_gain(self, gain: float) -> float:
        return self._gain_control.write(gain) if self._gain_control else 1.0

    @property
    def black_level(self) -> float:
        """Offset in counts of the control black_level; 0 without one."""
        self._require()
        return self._black_control.read() if self._black_control else 0.0

    @property
    def _black_limits(self) -> tuple[float, float]:
        return self._black_control.limits() if self._black_control else (0.0, 0.0)

    def _write_black(self, black_level: float) -> None:
        if self._black_control:
            self._black_control.write(black_level)

    # What the sensor is ----------------------------------------------------------------------------
    @property
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the images of the present format without a region."""
        self._require()
        return self._images.whole.height, self._images.whole.width

    @property
    def pixel_pitch_um(self) -> float:
        """Pitch of the pixels, as configured."""
        return self.options.pixel_pitch_um

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """Formats that can be decoded, the best for measuring first."""
        self._require()
        return tuple(offered.name for offered in self._images.formats)

    @property
    def _period_s(self) -> float:
        return self._images.period_s or 0.0

    # Format and region -----------------------------------------------------------------------------
    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name, with the kernel's code where the image is computed from it."""
        self._require()
        return self._images.format.name

    @property
    def significant_bits(self) -> int:
        """Bits of the pixel format."""
        self._require()
        return self._images.format.pixels.bits

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of the frames, with 3 channels for colours."""
        channels = self._images.format.pixels.channels
        return (*self.image_shape, channels) if channels > 1 else self.image_shape

    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format; a region that the new format's images still have stays."""
        self._require_idle("pixel format")
        self._require_offered("pixel format", pixel_format, self.pixel_formats)
        wanted = self._images.formats[self.pixel_formats.index(pixel_format)]
        before, roi, whole = self._images.format, self._roi, self._images.whole
        try:
            self._apply_format(wanted)
        except DeviceLostError:
            raise
        except DeviceError:
            # The driver may have another one now, whose bytes must not pass for the old one's.
            self._apply_format(before)
            if roi != whole:
                self.set_roi(roi)
            raise
        if self._images.whole != whole:
            self._forget("roi")
        elif roi != whole:
            self.set_roi(roi)
        self._remember("pixel_format", lambda: self.set_pixel_format(pixel_format))
        return self._images.format.name

    def _apply_format(self, wanted: V4l2Format) -> None:
        self._images.apply(wanted)
        self._roi = self._images.whole
        self._look_at_controls()

    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region, by the camera where it can, else cut out of each image by this driver.

        Borders of a Bayer mosaic fall on even pixels, inside the region asked for.
        """
        self._require_idle("region of interest")
        images = self._images
        whole = images.whole
        wanted = whole if roi is None else roi.inside(2 if images.format.pixels.bayer else 1)
        if roi is not None and not (whole.contains(roi) and whole.contains(wanted)):
            raise self._no_region(roi, f"Its images have {whole.height} x {whole.width} pixels.")
        self._roi = images.cut(wanted)
        self._look_at_controls()
        self._remember("roi", lambda: self.set_roi(roi))
        return self._roi

    # Streaming -------------------------------------------------------------------------------------
    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        self._make_ready((self._images.made.height, self._images.made.width))
        self._device.start(n_buffers)
        return None if self._trigger_mode == "software" else FrameNumberCounter(_SEQUENCE_MODULUS)

    def _take(self, timeout_s: float) -> RawFrame | None:
        filled = self._device.take(timeout_s)
        if filled is None:
            return None
        return RawFrame(
            data=filled.data,
            number=filled.sequence,
            device_time_ns=self._exposed_ns(filled),
            complete=not filled.flags & api.BUF_FLAG_ERROR,
            buffer=filled,
        )

    def _exposed_ns(self, filled: FilledBuffer) -> int | None:
        """Return the end of the exposure on the kernel's monotonic clock; None when it stamps by another."""
        if filled.flags & api.BUF_FLAG_TIMESTAMP_MASK != api.BUF_FLAG_TIMESTAMP_MONOTONIC:
            return None
        at_start = filled.flags & api.BUF_FLAG_TSTAMP_SRC_MASK == api.BUF_FLAG_TSTAMP_SRC_SOE
        return filled.time_ns + (round(self._exposure_ms * 1e6) if at_start else 0)

    def _give_back(self, raw: RawFrame) -> None:
        assert isinstance(raw.buffer, FilledBuffer)
        self._device.give_back(raw.buffer)

    def _wake(self) -> None:
        self._device.wake()

    def _end(self) -> None:
        self._device.stop()

    def _decode_whole(self, data: Bytes, out: Pixels) -> bool:
        return decode(data, self._images.format, self._images.made.bytesperline, out)
