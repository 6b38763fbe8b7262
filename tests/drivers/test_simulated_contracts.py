"""The simulated devices keep the contracts that every driver keeps."""

from __future__ import annotations

import pytest

from drivers.common.stage_axes import AXIS_NAMES
from drivers.device import Device
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
