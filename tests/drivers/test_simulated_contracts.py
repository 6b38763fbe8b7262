"""The simulated devices keep the contracts that every driver keeps."""

from __future__ import annotations

import pytest

from drivers.camera import TriggerMode
from drivers.common.stage_axes import AXIS_NAMES
from drivers.device import Device
from drivers.errors import DeviceError, LimitError
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.camera_settings import CameraOptions
from drivers.simulated.led_array import LedArrayOptions, SimulatedLedArray
from drivers.simulated.options import WorldOptions
from drivers.simulated.screen import ScreenOptions, SimulatedScreen
from drivers.simulated.slm import SimulatedSlm, SlmOptions
from drivers.simulated.stage import AxisOptions, SimulatedStage, StageOptions
from drivers.simulated.world import SimulatedWorld
from drivers.testing.camera import CameraContract
from drivers.testing.led_array import LedArrayContract
from drivers.testing.slm import SlmContract
from drivers.testing.stage import StageContract


def tiny_world(time_scale: float = 0.0) -> SimulatedWorld:
    return SimulatedWorld(WorldOptions(preset="tiny", time_scale=time_scale, scene="none"))


class TestSimulatedCamera(CameraContract):
    def make(self) -> Device:
        return SimulatedCamera(CameraOptions(), tiny_world(time_scale=0.1))


class TestSimulatedColorCamera(CameraContract):
    def make(self) -> Device:
        return SimulatedCamera(CameraOptions(color=True), tiny_world(time_scale=0.1))


class TestSimulatedStage(StageContract):
    def make(self) -> Device:
        # A hundredth of real time: moves last some tens of milliseconds, long enough to be stopped.
        return SimulatedStage(StageOptions(), tiny_world(time_scale=0.02))


class TestSimulatedStageOfSixAxes(StageContract):
    def make(self) -> Device:
        return SimulatedStage(StageOptions(axis_names=AXIS_NAMES), tiny_world(time_scale=0.02))


class TestSimulatedStageOfOneAxis(StageContract):
    def make(self) -> Device:
        options = StageOptions(
            axis_names=("z_um",), axes={"z_um": AxisOptions(lower_limit=9000.0, resolution=1.0)}
        )
        return SimulatedStage(options, tiny_world(time_scale=0.02))


class TestSimulatedLedArray(LedArrayContract):
    def make(self) -> Device:
        return SimulatedLedArray(LedArrayOptions(), tiny_world())


class TestSimulatedSlm(SlmContract):
    def make(self) -> Device:
        return SimulatedSlm(SlmOptions(shape=(60, 80)), tiny_world())


class TestSimulatedScreen(SlmContract):
    def make(self) -> Device:
        return SimulatedScreen(ScreenOptions(shape=(60, 80)), tiny_world())


@pytest.mark.parametrize(
    ("driver", "options"),
    [
        (SimulatedCamera, CameraOptions()),
        (SimulatedStage, StageOptions()),
        (SimulatedLedArray, LedArrayOptions()),
        (SimulatedSlm, SlmOptions()),
        (SimulatedScreen, ScreenOptions()),
    ],
)
def test_needs_the_shared_world(driver: type[Device], options: object) -> None:
    with pytest.raises(TypeError, match="SimulatedWorld"):
        driver(options, None)  # type: ignore[arg-type]


class NotingCamera(SimulatedCamera):
    """Notes what its trigger is told; ``stubborn`` refuses it."""

    def __init__(self) -> None:
        super().__init__(CameraOptions(), tiny_world())
        self.told: list[tuple[str, str, str]] = []
        self.stubborn = False

    def _write_trigger(self, mode: TriggerMode) -> None:
        if self.stubborn:
            raise DeviceError(self.name, "does not want to.")
        self.told.append((mode, self.trigger_line, self.trigger_edge))


def test_a_trigger_in_force_is_made_again_with_another_line_or_edge() -> None:
    with NotingCamera() as camera:
        line, other = camera.trigger_lines
        camera.set_trigger_line(other)
        camera.set_trigger_edge("falling")
        assert camera.told == []
        camera.set_trigger_mode("hardware")
        camera.set_trigger_line(line)
        camera.set_trigger_edge("rising")
        assert camera.told == [("hardware", other, "falling"), ("hardware", line, "falling"),
                               ("hardware", line, "rising")]  # fmt: skip
        camera.stubborn = True
        for change in (lambda: camera.set_trigger_line(other), lambda: camera.set_trigger_edge("falling")):
            with pytest.raises(DeviceError, match="does not want to"):
                change()
        assert (camera.trigger_line, camera.trigger_edge) == (line, "rising")


def test_settings_come_back_in_their_order_and_stay_remembered_where_one_fails() -> None:
    with NotingCamera() as camera:
        camera.set_exposure_ms(7.0)
        camera.set_exposure_ms(3.0)
        camera.set_gain(2.0)
        camera.set_black_level(4.0)
        camera.set_trigger_mode("software")
        camera._exposure_ms, camera._gain, camera._trigger_mode = 1.0, 1.0, "free_run"
        camera.stubborn = True
        with pytest.raises(DeviceError, match="does not want to"):
            camera._bring_back()
        assert (camera.exposure_ms, camera.gain, camera.black_level) == (3.0, 2.0, 4.0)
        camera.stubborn = False
        camera._bring_back()
        assert camera.trigger_mode == "software"
        camera._forget("gain")
        camera._gain = 1.0
        camera._bring_back()
        assert camera.gain == 1.0


def test_settings_beyond_their_limits_are_refused() -> None:
    with NotingCamera() as camera:
        before = camera.exposure_ms, camera.gain, camera.black_level
        low, high = camera.exposure_limits_ms
        assert camera.set_exposure_ms(low) == low
        camera.set_exposure_ms(before[0])
        for change in (
            lambda: camera.set_exposure_ms(2 * high),
            lambda: camera.set_gain(1e9),
            lambda: camera.set_black_level(-1.0),
            lambda: camera.set_black_level(1e9),
        ):
            with pytest.raises(LimitError):
                change()
        assert (camera.exposure_ms, camera.gain, camera.black_level) == before
