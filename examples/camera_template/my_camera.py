"""A camera behind its maker's library: copy this, change the calls, run the tests."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping

import my_camera_sdk as sdk  # the maker's library in its place
import numpy as np
from pydantic import Field

from drivers.camera import Roi, TriggerMode
from drivers.common.buffered_camera import BufferedCamera, RawFrame
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels
from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, Setting, SharedPart
from drivers.errors import DeviceError, DeviceLostError

_BITS = {"Mono12": 12, "Mono8": 8}
_STEP = 4
"""The camera's regions begin and end on multiples of this many pixels."""


class MyCameraOptions(DriverOptions):
    """The keys of [camera] in bench.toml, beside driver = "my_camera"; units are in their names."""

    serial_number: str = Field(min_length=1, description='On its label, e.g. "MC100-0042".')


class MyCamera(BufferedCamera):
    """What is particular to this library; ``BufferedCamera`` snaps, streams, counts lost frames and stops."""

    Options = MyCameraOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = MyCameraOptions.of(options)
        self._camera: sdk.Camera | None = None

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Only one program at a time may have the camera."""
        return (f"my camera {MyCameraOptions.of(options).serial_number}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """List the connected cameras for ``diffuserbench devices``."""
        return tuple(
            FoundDevice(
                "usb",
                serial_number,
                "my camera",
                serial_number=serial_number,
                driver="my_camera",
                kind="camera",
                options={"serial_number": serial_number},
            )
            for serial_number in sdk.cameras()
        )

    @property
    def name(self) -> str:
        """How errors name it: the kind, the driver, which one."""
        return f"camera (my_camera, {self.options.serial_number})"

    # Opening ---------------------------------------------------------------------------------------
    @property
    def _connected(self) -> bool:
        return self._camera is not None

    def _connect(self) -> None:
        try:
            self._camera = sdk.Camera(self.options.serial_number)
        except sdk.SdkError as error:
            listed = ", ".join(sdk.cameras()) or "none"
            raise DeviceError(
                self.name, f"cannot be opened: {error}; connected: {listed}.", "Check its cable."
            ) from error
        self._identity = DeviceIdentity(
            kind="camera",
            driver="my_camera",
            vendor="me",
            model=self._camera.model,
            serial_number=self.options.serial_number,
            firmware=self._camera.firmware,
            simulated=False,
        )
        try:  # its safe state, and what it is like in it
            self._write_trigger("free_run")
            self._trigger_mode = "free_run"
            self._write("bits", 12)
            self.set_roi(None)
            self._exposure_ms = self._read("exposure_us") / 1e3
            self._gain = 10 ** (self._read("gain_db10") / 200)
        except BaseException:
            self._disconnect()
            raise

    def _disconnect(self) -> None:
        camera, self._camera = self._camera, None
        assert camera is not None
        with contextlib.suppress(sdk.SdkError):  # of a camera that is gone
            camera.close()

    @contextlib.contextmanager
    def _calling(self) -> Iterator[sdk.Camera]:
        """Call the library: its errors in words, and a camera that is gone is given up."""
        assert self._camera is not None
        try:
            yield self._camera
        except sdk.UnpluggedError as error:
            lost = DeviceLostError(self.name, f"is gone: {error}.", "Plug it in, then open it again.")
            self._note_lost(lost)
            raise lost from error
        except sdk.SdkError as error:
            raise DeviceError(self.name, f"refuses: {error}.", "Switch it off and on.") from error

    def _read(self, register: str) -> int:
        with self._calling() as camera:
            return camera.read(register)

    def _write(self, register: str, value: int) -> int:
        with self._calling() as camera:
            camera.write(register, value)
            return camera.read(register)

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings."""
        self._require()
        return self._common_settings()

    # What the sensor is ----------------------------------------------------------------------------
    @property
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)``."""
        return sdk.HEIGHT, sdk.WIDTH

    @property
    def pixel_pitch_um(self) -> float:
        """From the data sheet."""
        return 3.45

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """The best for measuring first."""
        return tuple(_BITS)

    @property
    def exposure_limits_ms(self) -> tuple[float, float]:
        """From the data sheet; where the library knows, ask it."""
        self._require()
        return 0.05, 1000.0

    @property
    def gain_limits(self) -> tuple[float, float]:
        """0 to 24 dB, as factors."""
        self._require()
        return 1.0, 10 ** (24 / 20)

    # Settings: limits are kept by then, what is returned is what the device made of them -------------
    def _write_exposure(self, exposure_ms: float) -> float:
        return self._write("exposure_us", round(exposure_ms * 1e3)) / 1e3

    def _write_gain(self, gain: float) -> float:
        return float(10 ** (self._write("gain_db10", round(200 * np.log10(gain))) / 200))

    @property
    def black_level(self) -> float:
        """Offset in counts."""
        self._require()
        return float(self._read("offset"))

    @property
    def _black_limits(self) -> tuple[float, float]:
        return 0.0, 100.0

    def _write_black(self, black_level: float) -> None:
        self._write("offset", round(black_level))

    def _write_trigger(self, mode: TriggerMode) -> None:
        self._write("trigger", int(mode == "software"))

    @property
    def pixel_format(self) -> str:
        """By its GenICam name."""
        self._require()
        bits = self._read("bits")
        return next(name for name, has in _BITS.items() if has == bits)

    @property
    def significant_bits(self) -> int:
        """Bits that carry signal."""
        return _BITS[self.pixel_format]

    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format."""
        self._require_idle("pixel format")
        self._require_offered("pixel format", pixel_format, self.pixel_formats)
        self._write("bits", _BITS[pixel_format])
        self._remember("pixel_format", lambda: self.set_pixel_format(pixel_format))
        return self.pixel_format

    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region: the largest inside it that the camera can read."""
        self._require_idle("region of interest")
        whole = Roi(0, 0, *self.sensor_shape)
        wanted = whole if roi is None else roi.inside(_STEP)
        if not (whole.contains(roi or whole) and whole.contains(wanted)):
            raise self._no_region(roi or whole, f"The sensor has {whole.height} x {whole.width} pixels.")
        for name in ("x", "y"):  # a camera refuses a region that sticks out, also on the way to another
            self._write(name, 0)
        width, height = self._write("width", wanted.width), self._write("height", wanted.height)
        left, top = self._write("x", wanted.left), self._write("y", wanted.top)
        self._roi = Roi(top, left, height, width)
        self._remember("roi", lambda: self.set_roi(roi))
        return self._roi

    # Streaming -------------------------------------------------------------------------------------
    @property
    def _period_s(self) -> float:
        return self._exposure_ms / 1e3

    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        with self._calling() as camera:
            camera.start(n_buffers)
        # Triggered frames come when they are asked for: none is lost between them.
        return None if self._trigger_mode == "software" else FrameNumberCounter()

    def _take(self, timeout_s: float) -> RawFrame | None:
        with self._calling() as camera:
            buffer = camera.wait(round(timeout_s * 1e3))
        if buffer is None:
            return None
        return RawFrame(buffer.data, buffer.number, buffer.time_ns, buffer.complete, buffer)

    def _give_back(self, raw: RawFrame) -> None:
        assert isinstance(raw.buffer, sdk.Buffer)
        with self._calling() as camera:
            camera.queue(raw.buffer)

    def _wake(self) -> None:
        if (camera := self._camera) is not None:
            with contextlib.suppress(sdk.SdkError):  # the sequence is ended all the same
                camera.abort()

    def _end(self) -> None:
        if self._camera is not None:
            with contextlib.suppress(sdk.SdkError):
                self._camera.stop()

    def _decode(self, data: Bytes, out: Pixels) -> bool:
        if data.size != out.nbytes:
            return False  # damaged: counted as lost
        np.copyto(out, data.view("<u2" if out.itemsize == 2 else "u1").reshape(out.shape))
        return True

    def _fire(self) -> None:
        with self._calling() as camera:
            camera.fire()
