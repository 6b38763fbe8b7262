"""The devices of the simulated holographic display keep the contracts that every driver keeps."""

from __future__ import annotations

from drivers.device import Device
from drivers.simulated.camera_settings import CameraOptions
from drivers.simulated.display import (
    DisplayCamera,
    DisplayLasers,
    DisplayOptions,
    DisplaySlm,
    DisplayStage,
    DisplayStageOptions,
    DisplayWorld,
    LaserOptions,
)
from drivers.simulated.slm import SlmOptions
from drivers.testing.camera import CameraContract
from drivers.testing.led_array import LedArrayContract
from drivers.testing.slm import SlmContract
from drivers.testing.stage import StageContract
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config, template


class TestDisplayCamera(CameraContract):
    def make(self) -> Device:
        world = DisplayWorld(DisplayOptions(time_scale=0.1))
        world.scene_lit = True
        DisplaySlm(SlmOptions(shape=(32, 40)), world)
        return DisplayCamera(CameraOptions(), world)


class TestDisplayStage(StageContract):
    def make(self) -> Device:
        return DisplayStage(DisplayStageOptions(), DisplayWorld(DisplayOptions(time_scale=0.02)))


class TestDisplaySlm(SlmContract):
    def make(self) -> Device:
        return DisplaySlm(SlmOptions(shape=(60, 80)), DisplayWorld(DisplayOptions(time_scale=0.0)))


class TestDisplayLasers(LedArrayContract):
    def make(self) -> Device:
        return DisplayLasers(LaserOptions(), DisplayWorld(DisplayOptions(time_scale=0.0)))


def test_the_laser_is_the_scene_and_the_mask_rides_on_the_stage() -> None:
    text = template("display").replace("shape = [360, 640]", "shape = [32, 40]")
    with Bench(parse_config(text, None)).open() as bench:
        assert bench.stage is not None
        dark = bench.snap().image.mean()
        bench.scene_on()
        lit = bench.snap().image.astype(float)
        assert lit.mean() > dark + 15
        bench.stage.home()
        bench.stage.move_to({"x_um": 40.0, "roll_mrad": 3.0})
        moved = bench.snap().image.astype(float)
        assert abs(moved - lit).mean() > 0.2 * lit.mean()
        assert "SIMULATED" in bench.label


def test_a_mask_that_is_not_there_has_no_place() -> None:
    seen = []
    for masked, moved in ((True, {}), (True, {"x_um": 40.0}), (False, {}), (False, {"x_um": 40.0})):
        world = DisplayWorld(DisplayOptions(time_scale=0.0, masked=masked, mask_pitch_um=8.0))
        world.scene_lit = True
        DisplaySlm(SlmOptions(shape=(32, 40)), world).open()
        world.mount_mask(lambda moved=moved: moved)
        light = world.photons_per_s((1.0, 1.0, 1.0))
        assert light is not None
        seen.append(light)
    assert abs(seen[0] - seen[1]).mean() > 0.1 * seen[0].mean()
    assert (seen[2] == seen[3]).all()
