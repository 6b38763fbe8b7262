"""Micro-Manager's devices: its own demonstration adapters under the contracts, and what goes wrong."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.camera import Roi
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError
from drivers.led_array import LedPattern
from drivers.micromanager.camera import MicroManagerCamera, MicroManagerCameraOptions, genicam_name
from drivers.micromanager.core import LoadedDevice, MicroManager, MicroManagerOptions, Part
from drivers.micromanager.light import Channel, MicroManagerLight, MicroManagerLightOptions
from drivers.micromanager.slm import MicroManagerSlm, MicroManagerSlmOptions
from drivers.micromanager.stage import MicroManagerAxis, MicroManagerStage, MicroManagerStageOptions
from drivers.testing.camera import CameraContract
from drivers.testing.led_array import LedArrayContract
from drivers.testing.slm import SlmContract
from drivers.testing.stage import StageContract
from instrument.bench.bench import open_bench
from tests.mocks.micromanager_slm import FakeSlmCore

DEMO = {
    "Cam": "DCam",
    "XY": "DXYStage",
    "Z": "DStage",
    **{
        f"{colour}{kind}": device
        for kind, device in (("Shutter", "DShutter"), ("Level", "D-DA"))
        for colour in "RGB"
    },
    "Wheel": "DWheel",
}


@pytest.fixture
def adapters() -> Path:
    found = pytest.importorskip("mm_test_adapters", reason='pip install "diffuserbench[test-adapters]"')
    pymmcore = pytest.importorskip("pymmcore", reason='pip install "diffuserbench[test-adapters]"')
    folder = Path(found.device_adapter_path())
    core = pymmcore.CMMCore()
    core.setDeviceAdapterSearchPaths([str(folder)])
    if "DemoCamera" not in core.getDeviceAdapterNames():
        pytest.skip(f"mm-test-adapters are of another release than pymmcore ({core.getAPIVersionInfo()})")
    return folder


@pytest.fixture
def manager(adapters: Path) -> MicroManager:
    return manager_of(adapters)


def manager_of(adapters: Path, *labels: str, **others: LoadedDevice) -> MicroManager:
    devices = {label: LoadedDevice(library="DemoCamera", device=DEMO[label]) for label in labels or DEMO}
    return MicroManager(MicroManagerOptions(installation=adapters, devices=devices | others))


def camera_on(manager: MicroManager, **options: Any) -> MicroManagerCamera:
    given = {"device": "Cam", "pixel_pitch_um": 3.45} | options
    return MicroManagerCamera(MicroManagerCameraOptions(**given), manager)


def stage_on(manager: MicroManager, **axes: Any) -> MicroManagerStage:
    limits = {"lower_limit": -20_000.0, "upper_limit": 20_000.0}
    given = axes or {
        "x_um": MicroManagerAxis(device="XY", **limits),
        "y_um": MicroManagerAxis(device="XY", reverse=True, **limits),
        "z_um": MicroManagerAxis(device="Z", lower_limit=-200.0, upper_limit=250.0),
    }
    return MicroManagerStage(MicroManagerStageOptions(axes=given), manager)


def lights_on(manager: MicroManager) -> MicroManagerLight:
    channels = {
        name: Channel(shutter=f"{letter}Shutter", device=f"{letter}Level", intensity="Voltage", full=5.0)
        for name, letter in (("red", "R"), ("green", "G"), ("blue", "B"))
    }
    # A second place with lights of their own would need as many devices again: the two share them.
    lights = [{"position_mm": (x, 0.0, 80.0), **channels} for x in (0.0, -20.0)]
    return MicroManagerLight(MicroManagerLightOptions.model_validate({"lights": lights}), manager)


# The contracts ---
class TestCamera(CameraContract):
    @pytest.fixture(autouse=True)
    def _manager(self, manager: MicroManager) -> None:
        self.manager = manager

    def make(self) -> MicroManagerCamera:
        return camera_on(self.manager)


def test_a_choice_that_is_read_back_with_more_decimals_is_that_choice() -> None:
    part = Part(FactorsCore(), "Cam", "camera")
    assert part.set("Factor", 0.5) == "0.5000"
    with pytest.raises(DeviceError, match=r"was told Factor = 2\.0 and has 0\.5000"):
        part.set("Factor", 2.0)


class FactorsCore:
    """An adapter whose only property takes two values, keeps the first, and writes it at length."""

    def getLoadedDevices(self) -> tuple[str, ...]:
        return ("Cam",)

    def __getattr__(self, function: str) -> Any:
        said = {
            **{"hasProperty": True, "getPropertyType": None, "hasPropertyLimits": False},
            **{"getAllowedPropertyValues": ("0.5", "2.0"), "setProperty": None, "getProperty": "0.5000"},
        }
        return lambda *_: said[function]


def test_a_long_exposure_is_waited_for(manager: MicroManager) -> None:
    with camera_on(manager) as camera:
        waits = []
        for exposure_ms in (10.0, 2000.0, 4000.0):
            camera.set_exposure_ms(exposure_ms)
            waits.append(camera.longest_wait_s)
        frames = 3 + camera.frames_to_skip
    assert waits[0] >= camera.longest_silence_s
    assert waits[2] - waits[1] == pytest.approx(2.0 * frames, rel=0.05)
    assert waits[1] - waits[0] == pytest.approx(1.99 * frames, rel=0.05)


class TestStage(StageContract):
    @pytest.fixture(autouse=True)
    def _manager(self, manager: MicroManager) -> None:
        self.manager = manager

    def make(self) -> MicroManagerStage:
        return stage_on(self.manager)


class TestLight(LedArrayContract):
    @pytest.fixture(autouse=True)
    def _manager(self, manager: MicroManager) -> None:
        self.manager = manager

    def make(self) -> MicroManagerLight:
        return lights_on(self.manager)


class TestSlm(SlmContract):
    """No adapter without hardware is an SLM: the core's interface, as its documentation has it."""

    def make(self) -> MicroManagerSlm:
        devices = {"SLM": LoadedDevice(library="Fake", device="SLM")}
        manager = _WithoutAdapters(MicroManagerOptions(devices=devices))
        options = MicroManagerSlmOptions(device="SLM", pixel_pitch_um=8.0, settle_ms=0.0)
        return MicroManagerSlm(options, manager)

    def test_after_an_image_that_failed_it_does_not_tell_the_one_before(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        slm = self.make()
        slm.open()
        levels = np.full(slm.shape, 7, np.uint8)
        with monkeypatch.context() as patch:
            patch.setattr(FakeSlmCore, "displaySLMImage", lambda *_: int("an adapter's own words"))
            with pytest.raises(DeviceError):
                slm.display(levels)
        with pytest.raises(DeviceError, match="unknown after a failure"):
            _ = slm.displayed
        slm.display(levels)
        assert (slm.displayed == 7).all()
        slm.close()


class _WithoutAdapters(MicroManager):
    def _loaded(self, name: str) -> Any:
        return FakeSlmCore("SLM", (12, 20))


# A bench of them ---
BENCH = """
[micromanager]
installation = "{adapters}"
configuration = "{configuration}"

[camera]
driver = "micromanager"
pixel_pitch_um = 3.45
exposure_ms = 5.0
properties = {{ Mode = "Noise", PixelType = "16bit", BitDepth = 12 }}

[stage]
driver = "micromanager"

[stage.axes.x_um]
lower_limit = -500.0
upper_limit = 500.0

[stage.axes.z_um]
lower_limit = 0.0
upper_limit = 100.0

[led_array]
driver = "micromanager"

[[led_array.lights]]
white = {{ shutter = "Lamp", device = "Wheel", state = "State-3", state_off = "State-0" }}
"""
CONFIGURATION = """
Property,Core,Initialize,0
Device,Cam,DemoCamera,DCam
Device,Table,DemoCamera,DXYStage
Device,Focus,DemoCamera,DStage
Device,Lamp,DemoCamera,DShutter
Device,Wheel,DemoCamera,DWheel
Property,Core,Initialize,1
Property,Core,Camera,Cam
Property,Core,Focus,Focus
Property,Core,XYStage,Table
"""


def test_a_bench_shares_one_core_and_the_configurations_roles(adapters: Path, tmp_path: Path) -> None:
    configuration = tmp_path / "lab.cfg"
    configuration.write_text(CONFIGURATION)
    (tmp_path / "bench.toml").write_text(BENCH.format(adapters=adapters, configuration=configuration))
    with open_bench(tmp_path / "bench.toml") as bench:
        frame = bench.camera.snap()
        assert frame.image.dtype == np.uint16
        assert frame.metadata.significant_bits == 12
        assert frame.image.std() > 0
        assert bench.camera.settings()["property.Mode"] == "Noise"
        assert bench.camera.identity.simulated
        assert bench.stage is not None
        assert bench.led_array is not None
        bench.stage.home()
        assert bench.stage.move_to({"x_um": 120.0, "z_um": 40.0}) == pytest.approx(
            {"x_um": 120.0, "z_um": 40.0}, abs=0.1
        )
        bench.led_array.set_pattern(bench.led_array.single(0))
        lit = bench.led_array.settings()
        assert (lit["Lamp.property.State"], lit["Wheel.property.Label"]) == ("1", "State-3")
        bench.led_array.off()
        dark = bench.led_array.settings()
        assert (dark["Lamp.property.State"], dark["Wheel.property.Label"]) == ("0", "State-0")
        with pytest.raises(LimitError, match="on or off"):
            bench.led_array.set_pattern(LedPattern("dim", ((0, (9, 9, 9)),)))
        with pytest.raises(LimitError, match="white"):
            bench.led_array.set_pattern(LedPattern("red", ((0, (255, 0, 0)),)))


# The camera ---
def test_colour_pixels_come_in_their_order(manager: MicroManager) -> None:
    with camera_on(manager, properties={"Mode": "Color Test Pattern"}) as camera:
        assert set(camera.pixel_formats) == {"Mono8", "Mono16", "RGB8"}
        camera.set_pixel_format("RGB8")
        image = camera.snap().image
    assert image.shape == (512, 512, 3)
    # The pattern's columns change their colour; bytes beside the three colours are always 0.
    assert all(image[..., channel].any() for channel in range(3))


def test_lost_frames_are_those_that_the_core_lost(manager: MicroManager) -> None:
    with camera_on(manager) as camera:
        camera.set_exposure_ms(2.0)
        camera.start_sequence(2)
        first = camera.next_frame(5.0).metadata.frame_id
        time.sleep(0.3)
        later = [camera.next_frame(5.0).metadata for _ in range(8)]
        camera.stop_sequence()
    lost = sum(metadata.dropped_before for metadata in later)
    assert lost > 0
    assert later[-1].frame_id == first + 8 + lost


def test_regions_of_binned_pixels_lie_within_what_was_asked(manager: MicroManager) -> None:
    with camera_on(manager) as camera:
        camera.set_binning(4)
        assert camera.set_roi(Roi(9, 18, 102, 203)) == Roi(12, 20, 96, 200)
        assert camera.snap().image.shape == (24, 50)
        with pytest.raises(LimitError, match="steps of 4"):
            camera.set_roi(Roi(1, 1, 3, 3))


def test_a_trigger_is_made_of_properties(manager: MicroManager) -> None:
    triggers = {"hardware": {"StripeWidth": 2.0}, "free_run": {"StripeWidth": 1.0}}
    with camera_on(manager, triggers=triggers) as camera:
        assert camera.trigger_modes == ("free_run", "hardware")
        camera.set_trigger_mode("hardware")
        assert float(str(camera.settings()["property.StripeWidth"])) == 2.0
        camera.set_trigger_mode("free_run")
        assert float(str(camera.settings()["property.StripeWidth"])) == 1.0


def test_no_property_of_a_trigger_mode_stays_set() -> None:
    modes = {"hardware": {"TriggerMode": "External"}, "free_run": {"TriggerMode": "Internal"}}
    assert MicroManagerCameraOptions(pixel_pitch_um=3.0, triggers=modes).triggers == modes
    modes["hardware"]["TriggerDelay"] = "5"
    with pytest.raises(
        ValidationError, match=r"free_run must say what TriggerDelay is then, which .*hardware"
    ):
        MicroManagerCameraOptions(pixel_pitch_um=3.0, triggers=modes)
    with pytest.raises(ValidationError, match="free_run must say what TriggerMode is then"):
        MicroManagerCameraOptions(pixel_pitch_um=3.0, triggers={"hardware": {"TriggerMode": "External"}})


def test_a_silent_camera_is_waited_for_no_longer_than_asked(manager: MicroManager) -> None:
    with camera_on(manager) as camera:
        camera.set_exposure_ms(800.0)
        camera.start_sequence()
        with pytest.raises(DeviceTimeoutError, match="no frame within"):
            camera.next_frame(0.1)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("8bit", "Mono8"),
        ("16bit", "Mono16"),
        ("Mono12", "Mono12"),
        ("GREY16", "Mono16"),
        ("12 bit", "Mono12"),
        ("32bitRGB", "RGB8"),
        ("RGB32", "RGB8"),
        ("64bitRGB", None),
        ("32bit", None),
        ("Bayer8", None),
    ],
)
def test_pixel_types_have_genicam_names(text: str, name: str | None) -> None:
    assert genicam_name(text) == name


# What goes wrong ---
@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"device": "Kam"}, "no device 'Kam'. It has Cam"),
        ({"properties": {"Gian": 3}}, "no property 'Gian'"),
        ({"properties": {"Gain": 99}}, "Gain is -5 to 8"),
        ({"properties": {"Mode": "Nois"}}, "Mode is one of"),
        ({"properties": {"PixelType": "32bit"}}, "sends pixels of 4 bytes"),
    ],
)
def test_mistakes_of_a_camera_are_said(manager: MicroManager, options: dict[str, Any], said: str) -> None:
    camera = camera_on(manager, **options)
    with pytest.raises(DeviceError, match=said):
        camera.open()
    assert not camera.is_open


def test_what_cannot_be_loaded_is_said(adapters: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.cfg"
    wrong.write_text("Device,Cam,NoSuchAdapter,DCam\n")
    for options, said in (
        (
            {"devices": {"Cam": LoadedDevice(library="Nikon", device="Ti")}},
            "Adapters there are: .*DemoCamera",
        ),
        ({"devices": {"Cam": LoadedDevice(library="DemoCamera", device="DKam")}}, "DKam"),
        ({"configuration": tmp_path / "none.cfg"}, "none.cfg' is no file"),
        ({"configuration": wrong}, "NoSuchAdapter"),
        ({"installation": tmp_path / "none", "configuration": wrong}, "is no folder"),
    ):
        manager = MicroManager(MicroManagerOptions.model_validate({"installation": adapters} | options))
        with pytest.raises(DeviceError, match=said):
            camera_on(manager).open()
    for table in ({}, {"configuration": "a.cfg", "devices": {"Cam": {"library": "a", "device": "b"}}}):
        with pytest.raises(ValidationError, match="configuration"):
            MicroManagerOptions.model_validate(table)


def test_axes_must_be_axes_of_stages(manager: MicroManager) -> None:
    limits = {"lower_limit": 0.0, "upper_limit": 10.0}
    for axes, said in (
        ({"x_um": MicroManagerAxis(device="Wheel", **limits)}, "is no stage"),
        ({"z_um": MicroManagerAxis(device="XY", **limits)}, 'Say axis = "x"'),
        (
            {
                "x_um": MicroManagerAxis(device="XY", **limits),
                "z_um": MicroManagerAxis(device="XY", axis="x", **limits),
            },
            "the same axis",
        ),
    ):
        with pytest.raises(DeviceError, match=said):
            stage_on(manager, **axes).open()


def test_a_light_that_could_never_be_dark_is_refused() -> None:
    for table in (
        {},
        {"white": {"device": "Wheel", "state": "Open"}},
        {"white": {"shutter": "A"}, "red": {"shutter": "B"}},
        {"white": {"shutter": "A", "state": "Open"}},
        {"white": {"shutter": "A", "device": "B", "state": "Open", "intensity": "Volts"}},
    ):
        with pytest.raises(ValidationError):
            MicroManagerLightOptions.model_validate({"lights": [table]})


def test_one_wheel_cannot_stand_at_two_places(manager: MicroManager) -> None:
    colours = {
        name: {"shutter": "RShutter", "device": "Wheel", "state": state}
        for name, state in (("red", "State-1"), ("blue", "State-2"))
    }
    options = MicroManagerLightOptions.model_validate({"lights": [colours]})
    with MicroManagerLight(options, manager) as light:
        light.set_pattern(LedPattern("red", ((0, (255, 0, 0)),)))
        with pytest.raises(LimitError, match="Wheel would have to stand at"):
            light.set_pattern(LedPattern("both", ((0, (255, 0, 255)),)))
        with pytest.raises(LimitError, match="no such colour"):
            light.set_pattern(LedPattern("green", ((0, (0, 255, 0)),)))
        assert light.pattern.description == "red"


def test_frames_are_those_of_pixels_that_an_own_setting_changed(adapters: Path) -> None:
    with camera_on(manager_of(adapters, "Cam")) as camera:
        assert camera.pixel_format == "Mono8"
        camera.set_own("BitDepth", "16")
        assert (camera.pixel_format, camera.significant_bits) == ("Mono16", 16)
        assert camera.snap().image.dtype == np.uint16
        camera.set_own("BitDepth", "8")  # still in two bytes
        assert camera.snap().image.max() < 256
        camera.set_own("OnCameraCCDXSize", "256")
        assert camera.sensor_shape == camera.snap().image.shape == (512, 256)


def test_own_settings_are_the_properties_that_the_driver_leaves_alone(adapters: Path) -> None:
    with camera_on(manager_of(adapters, "Cam")) as camera:
        own = camera.own_settings()
        assert not {"Exposure", "Binning", "PixelType", "Gain"} & set(own)
        assert own["FastImage"].choices == ("0", "1")
        assert camera.set_own("FastImage", "1") == "1"
        assert camera.own_settings()["FastImage"].value == "1"
        with pytest.raises(LimitError, match="is one of"):
            camera.set_own("FastImage", "7")
        with pytest.raises(LimitError, match="Exposure"):
            camera.set_own("Exposure", "7")


def test_what_was_done_once_may_read_off_afterwards_and_is_not_done_again(
    adapters: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[object] = []
    call = Part.call

    def tinting(part: Part, doing: str, function: str, *values: object) -> object:
        if function == "setProperty":
            calls.append(values)
        elif function == "getAllowedPropertyValues" and values == ("FastImage",):
            return ("0", "1", "Off", "Once")
        elif function == "getProperty" and calls and values == ("FastImage",):
            return "Off"
        else:
            return call(part, doing, function, *values)
        return None

    with camera_on(manager_of(adapters, "Cam")) as camera:
        monkeypatch.setattr(Part, "call", tinting)
        assert camera.set_own("FastImage", "Once") == "Off"
        camera._bring_back()
        assert calls == [("FastImage", "Once"), ("FastImage", "Off")]


def test_looking_for_an_installation_leaves_the_log_as_quiet_as_it_was() -> None:
    lines = (
        "import logging",
        "from drivers.micromanager.core import found_installation",
        "found_installation()",
        "assert logging.getLogger().level == logging.WARNING",
    )
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True, timeout=60)
