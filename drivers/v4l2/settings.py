"""The settings of a V4L2 camera: what its driver offers, set by ioctl, and read back."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, cast

from pydantic import Field, PositiveInt

from drivers.common.buffered_camera import BufferedCamera
from drivers.common.gain import GainScale, GainUnit
from drivers.device import DeviceIdentity, DriverOptions, SharedPart, port_claim
from drivers.errors import DeviceError, LimitError
from drivers.v4l2 import api
from drivers.v4l2.controls import Control, Controls
from drivers.v4l2.device import VideoDevice, usb_strings

_EXPOSURE_COUNT_MS = 0.1
"""Unit of the control exposure_time_absolute: 100 us."""
_AUTOMATICS = {
    api.CID_AUTOGAIN: 0,
    api.CID_EXPOSURE_AUTO_PRIORITY: 0,  # else the frame rate follows the exposure
    api.CID_AUTO_WHITE_BALANCE: 0,
}
_VIRTUAL_DRIVERS = ("vivid", "vimc")


class V4l2Options(DriverOptions):
    """Options of a V4L2 camera in ``bench.toml``."""

    device: str = Field(
        "/dev/video0",
        min_length=1,
        description="Device node; a link in /dev/v4l/by-id stays the same when cameras are plugged anew.",
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


class V4l2Settings(BufferedCamera):
    """The part of a V4L2 camera that takes no images."""

    Options = V4l2Options
    kernel: ClassVar[api.Kernel] = api.LinuxKernel()
    """What makes the system calls."""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = options = V4l2Options.of(options)
        self._device = VideoDevice(options.device, self.name, self.kernel, self._note_lost)
        self._identity: DeviceIdentity | None = None
        self._period: float | None = None
        """From frame to frame, seconds; None when the driver knows no frame rate."""

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the device node, whatever link it is named by."""
        return (port_claim(cast(V4l2Options, options).device),)

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
            if self.options.input is not None:
                self._device.call(
                    api.S_INPUT, api.InputNumber(self.options.input), f"take input {self.options.input}"
                )
            self._identity = self._identify()
            self._controls = Controls(self._device)
            self._exposure_control = self._find_exposure()
            self._gain_control = self._find(api.CID_ANALOGUE_GAIN, api.CID_GAIN)
            self._black_control = self._find(api.CID_BLACK_LEVEL)
            self._switch_automatics_off()
            self._open_images()
            for name, value in self.options.controls.items():
                self.set_control(name, value)
            self._exposure_ms = self._read_exposure()
            self._gain = self._read_gain()
        except BaseException:
            self._device.close()
            raise

    @abstractmethod
    def _open_images(self) -> None:
        """Bring format, region and trigger to their state after opening."""

    def _disconnect(self) -> None:
        self._device.close()

    def _identify(self) -> DeviceIdentity:
        found = self._device.capability()
        driver = found.driver.decode(errors="replace")
        usb = usb_strings(self.options.device)
        version = found.version
        return DeviceIdentity(
            kind="camera",
            driver="v4l2",
            vendor=usb.get("manufacturer") or driver,
            model=found.card.decode(errors="replace"),
            serial_number=usb.get("serial") or found.bus_info.decode(errors="replace"),
            firmware=f"{driver} of Linux {version >> 16}.{version >> 8 & 255}.{version & 255}",
            simulated=driver in _VIRTUAL_DRIVERS,
        )

    def _find(self, *ids: int) -> Control | None:
        return next((self._controls.by_id[i] for i in ids if i in self._controls.by_id), None)

    def _find_exposure(self) -> tuple[Control, float] | None:
        """Return the exposure control and what a count of it lasts, milliseconds."""
        absolute = self._find(api.CID_EXPOSURE_ABSOLUTE)
        if absolute is not None:
            return absolute, _EXPOSURE_COUNT_MS
        lines = self._find(api.CID_EXPOSURE)
        if lines is not None and self.options.exposure_line_us is not None:
            return lines, self.options.exposure_line_us / 1e3
        return None

    def _switch_automatics_off(self) -> None:
        auto = self._find(api.CID_EXPOSURE_AUTO)
        if auto is not None:
            manual = [
                mode for mode in (api.EXPOSURE_MANUAL, api.EXPOSURE_SHUTTER_PRIORITY) if mode in auto.menu
            ]
            if not manual:
                raise DeviceError(
                    self.name,
                    f"its exposure cannot be set by hand: {auto.name} offers {auto.range_text}.",
                    "Use another camera.",
                )
            self._controls.set(auto, manual[0])
        for number, off in _AUTOMATICS.items():
            control = self._find(number)
            if control is not None:
                self._controls.set(control, off)

    @property
    def identity(self) -> DeviceIdentity:
        """Who the kernel says it is."""
        self._require()
        assert self._identity is not None
        return self._identity

    # Controls --------------------------------------------------------------------------------------
    @property
    def controls(self) -> tuple[Control, ...]:
        """All controls of the camera with their ranges and menus."""
        self._require()
        return tuple(self._controls.by_name.values())

    def control_value(self, name: str) -> int:
        """Read a control by its name."""
        return self._controls.get(self._named(name))

    def set_control(self, name: str, value: int) -> int:
        """Set a control by its name; returns what it reads afterwards.

        Raises
        ------
        LimitError
            No such control, or a value outside its range.
        """
        return self._controls.set(self._named(name), value)

    def _named(self, name: str) -> Control:
        if not self._connected:
            self._require()
        try:
            return self._controls.by_name[name]
        except KeyError:
            raise LimitError(
                self.name,
                f"has no control {name!r}.",
                f"It has {', '.join(sorted(self._controls.by_name)) or 'none'}.",
            ) from None

    # Exposure, gain, black level -------------------------------------------------------------------
    @property
    def exposure_ms(self) -> float:
        """Exposure time; of a camera without an exposure control the time from frame to frame."""
        self._require()
        return self._exposure_ms

    def _read_exposure(self) -> float:
        if self._exposure_control is not None:
            control, count_ms = self._exposure_control
            return self._controls.get(control) * count_ms
        if self._period is None:
            raise DeviceError(
                self.name,
                "has no exposure control and no frame rate that tells how long it exposes.",
                'For sensors with the control "exposure", set exposure_line_us.',
            )
        return self._period * 1e3

    @property
    def exposure_limits_ms(self) -> tuple[float, float]:
        """Shortest and longest exposure; both the frame period of a camera without a control."""
        self._require()
        if self._exposure_control is None:
            return self._exposure_ms, self._exposure_ms
        control, count_ms = self._exposure_control
        return max(control.minimum, 1) * count_ms, control.maximum * count_ms

    def set_exposure_ms(self, exposure_ms: float) -> float:
        """Set the exposure; the control counts 100 us, drivers may have coarser steps."""
        self._require()
        low, high = self.exposure_limits_ms
        if not low <= exposure_ms <= high:
            problem = f"cannot expose {exposure_ms:g} ms."
            if self._exposure_control is None:
                raise LimitError(
                    self.name, problem, f"Its exposure cannot be set: {low:g} ms, a frame's period."
                )
            raise LimitError(self.name, problem, f"Its exposure is {low:g} to {high:g} ms.")
        if self._exposure_control is not None:
            control, count_ms = self._exposure_control
            self._controls.set(control, _on_step(control, exposure_ms / count_ms))
            self._exposure_ms = self._read_exposure()
        self._remember("exposure_ms", lambda: self.set_exposure_ms(exposure_ms))
        return self._exposure_ms

    @property
    def gain(self) -> float:
        """Gain as a factor, by the options ``gain_unit`` and ``gain_per_count``; 1 without a control."""
        self._require()
        return self._gain

    def _scale(self, control: Control) -> GainScale:
        return GainScale(self.options.gain_unit, self.options.gain_per_count, control.minimum)

    def _read_gain(self) -> float:
        if self._gain_control is None:
            return 1.0
        return self._scale(self._gain_control).factor(self._controls.get(self._gain_control))

    @property
    def gain_limits(self) -> tuple[float, float]:
        """Smallest and largest gain factor."""
        self._require()
        if self._gain_control is None:
            return 1.0, 1.0
        scale = self._scale(self._gain_control)
        return scale.factor(self._gain_control.minimum), scale.factor(self._gain_control.maximum)

    def set_gain(self, gain: float) -> float:
        """Set the gain factor, in the steps of the control."""
        self._require()
        low, high = self.gain_limits
        if not low <= gain <= high:
            raise LimitError(self.name, f"has no gain {gain:g}.", f"Its gain is {low:g} to {high:g}.")
        if self._gain_control is not None:
            number = self._scale(self._gain_control).number(gain)
            self._controls.set(self._gain_control, _on_step(self._gain_control, number))
            self._gain = self._read_gain()
        self._remember("gain", lambda: self.set_gain(gain))
        return self._gain

    @property
    def black_level(self) -> float:
        """Offset in counts of the control black_level; 0 without one."""
        self._require()
        return float(self._controls.get(self._black_control)) if self._black_control else 0.0

    def set_black_level(self, black_level: float) -> float:
        """Set the offset; without a control only 0 is taken."""
        self._require_idle("black level")
        control = self._black_control
        low, high = (control.minimum, control.maximum) if control else (0, 0)
        if not max(low, 0) <= black_level <= high:
            raise LimitError(
                self.name, f"has no black level {black_level:g}.", f"It is {max(low, 0)} to {high} counts."
            )
        if control:
            self._controls.set(control, _on_step(control, black_level))
        self._remember("black_level", lambda: self.set_black_level(black_level))
        return self.black_level


def _on_step(control: Control, number: float) -> int:
    """Return the value on a control's steps that is nearest to a number, inside its range."""
    step = max(control.step, 1)
    value = control.minimum + round((number - control.minimum) / step) * step
    return min(max(value, control.minimum), control.maximum)
