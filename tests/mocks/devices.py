"""Devices that record their calls and fail where a test says so. Never used at run time.

Their options take ``fail``: names of methods that raise. All share one ``MockWorld``, whose ``calls`` is the
record: ``"camera.open"``, ``"led_array.off"`` ...
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.camera import Camera, Roi, TriggerMode
from drivers.device import Device, DeviceIdentity, DriverOptions, Setting, SharedPart, port_claim
from drivers.errors import DeviceError, LimitError
from drivers.frame import Frame, FrameMetadata
from drivers.led_array import OFF, LedArray, LedPattern
from drivers.slm import Slm
from drivers.stage import Stage, StageAxis


class MockWorldOptions(DriverOptions):
    level: int = Field(100, ge=0, le=4095, description="Counts of every pixel.")


class MockWorld(SharedPart):
    table = "mock"
    Options = MockWorldOptions

    def __init__(self, options: DriverOptions) -> None:
        assert isinstance(options, MockWorldOptions)
        self.level = options.level
        self.calls: list[str] = []
        self.scene_lit = False


class MockOptions(DriverOptions):
    port: str = Field("none", description="Where it is plugged in.")
    speed_mm_s: float = Field(1.0, gt=0, description="How fast it is.")
    fail: tuple[str, ...] = Field((), description="Methods that raise.")
    interrupt: tuple[str, ...] = Field((), description="Methods that raise KeyboardInterrupt.")


class MockDevice(Device):
    """What the mocks share: open and closed, the record, the faults."""

    Options = MockOptions
    Shared = MockWorld
    kind = ""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        assert isinstance(options, MockOptions)
        assert isinstance(shared, MockWorld)
        self._options = options
        self.world = shared
        self._open = False

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        assert isinstance(options, MockOptions)
        return () if options.port == "none" else (port_claim(options.port),)

    def _call(self, method: str) -> None:
        self.world.calls.append(f"{self.kind}.{method}")
        if method in self._options.interrupt:
            raise KeyboardInterrupt
        if method in self._options.fail:
            raise DeviceError(self.name, f"{method} failed.", "Check the cable.")

    @property
    def name(self) -> str:
        return f"{self.kind} (mock)"

    def open(self) -> None:
        self._call("open")
        self._open = True

    def close(self) -> None:
        self._open = False
        self._call("close")

    @property
    def is_open(self) -> bool:
        return self._open

    @property
    def identity(self) -> DeviceIdentity:
        return DeviceIdentity(self.kind, "mock", "Mock", "M1", "007", "1.0", True)

    def settings(self) -> Mapping[str, Setting]:
        return {"port": self._options.port}


class MockCamera(MockDevice, Camera):
    kind = "camera"
    sensor_shape = (24, 32)
    pixel_pitch_um = 2.0
    pixel_formats = ("Mono8", "Mono12")
    exposure_limits_ms = (0.1, 1000.0)
    gain_limits = (1.0, 16.0)
    binnings = (1, 2)
    significant_bits = 12
    trigger_mode: TriggerMode = "free_run"
    is_streaming = False
    exposure_ms = 10.0
    gain = 1.0
    black_level = 0.0
    binning = 1
    pixel_format = "Mono12"
    roi = Roi(0, 0, 24, 32)

    def set_exposure_ms(self, exposure_ms: float) -> float:
        self._call("set_exposure_ms")
        if not self.exposure_limits_ms[0] <= exposure_ms <= self.exposure_limits_ms[1]:
            raise LimitError(self.name, f"exposure {exposure_ms:g} ms is outside 0.1 to 1000 ms.")
        self.exposure_ms = exposure_ms
        return exposure_ms

    def set_gain(self, gain: float) -> float:
        self._call("set_gain")
        self.gain = gain
        return gain

    def set_black_level(self, black_level: float) -> float:
        self.black_level = black_level
        return black_level

    def set_roi(self, roi: Roi | None) -> Roi:
        self.roi = roi or Roi(0, 0, 24, 32)
        return self.roi

    def set_binning(self, binning: int) -> int:
        self.binning = binning
        return binning

    def set_pixel_format(self, pixel_format: str) -> str:
        self.pixel_format = pixel_format
        return pixel_format

    def set_trigger_mode(self, mode: TriggerMode) -> TriggerMode:
        self.trigger_mode = mode
        return mode

    def snap(self) -> Frame:
        self._call("snap")
        count = self.world.calls.count("camera.snap")
        image = np.full(self.image_shape, self.world.level + count, np.uint16)
        metadata = FrameMetadata(
            frame_id=count,
            device_time_ns=None,
            host_time_ns=time.monotonic_ns(),
            utc=datetime.now(UTC),
            exposure_ms=self.exposure_ms,
            gain=self.gain,
            pixel_format=self.pixel_format,
            significant_bits=self.significant_bits,
            black_level=self.black_level,
            roi=self.roi.as_tuple(),
            binning=self.binning,
            dropped_before=1,
        )
        return Frame(image, metadata)

    def start_sequence(self, n_buffers: int = 8) -> None:
        self._call(f"start_sequence {n_buffers}")

    def next_frame(self, timeout_s: float) -> Frame:
        assert timeout_s > 0
        return self.snap()

    def trigger(self) -> None:
        self._call("trigger")

    def stop_sequence(self) -> None:
        self._call("stop_sequence")


class MockStage(MockDevice, Stage):
    kind = "stage"
    axes = (StageAxis("x_um", -100.0, 100.0, 1000.0, 0.1), StageAxis("z_um", 0.0, 1e6, 1000.0, 0.1))
    is_homed = True
    is_moving = False

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self._position = {"x_um": 0.0, "z_um": 0.0}

    def position(self) -> dict[str, float]:
        return dict(self._position)

    def home(self) -> None:
        self._call("home")

    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        self._call("move_to" if wait else "start_move_to")
        for axis, value in target.items():
            low, high = self.limits[axis]
            if not low <= value <= high:
                raise LimitError(self.name, f"{axis} = {value:g} is outside {low:g} to {high:g}.")
        self._position.update(target)
        return self.position()

    def commanded_position(self) -> dict[str, float]:
        return self.position()

    def wait(self, timeout_s: float | None = None) -> None:
        self._call(f"wait {timeout_s}")

    def stop(self) -> None:
        self._call("stop")


class MockLedArray(MockDevice, LedArray):
    kind = "led_array"
    led_positions_mm = np.zeros((4, 3))
    led_na = np.zeros((4, 2))
    wavelengths_nm = (630.0, 530.0, 460.0)
    pattern = OFF

    def set_pattern(self, pattern: LedPattern) -> LedPattern:
        self._call("set_pattern")
        self.pattern = pattern
        return pattern

    def off(self) -> None:
        self._call("off")
        self.pattern = OFF


class MockSlm(MockDevice, Slm):
    kind = "slm"
    shape = (4, 6)
    pixel_pitch_um = 8.0
    settle_ms = 1.0

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self._shown = np.zeros(self.shape, np.uint8)

    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        self._call("display")
        self._shown = levels

    @property
    def displayed(self) -> npt.NDArray[np.uint8]:
        return self._shown
