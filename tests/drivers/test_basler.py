"""The Basler driver over the cameras that pylon emulates."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.basler.camera import BaslerCamera, BaslerOptions
from drivers.camera import Camera, Roi
from drivers.errors import DeviceError, DeviceLostError, LimitError
from drivers.testing.camera import CameraContract


@pytest.fixture(autouse=True)
def _emulated(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pypylon", reason='pip install "diffuserbench[basler]"')
    monkeypatch.setenv("PYLON_CAMEMU", "2")


def camera_of(**options: Any) -> BaslerCamera:
    given = {"serial_number": "0815-0000", "pixel_pitch_um": 3.45, "frames_per_s": 100.0}
    return BaslerCamera(BaslerOptions(**given | options))


@pytest.fixture
def camera() -> Iterator[BaslerCamera]:
    with camera_of() as camera:
        camera.set_roi(Roi(0, 0, 256, 512))
        camera.set_exposure_ms(1.0)
        yield camera


class SmallCamera(BaslerCamera):
    """Shows the first 512 x 512 pixels of a sensor of 16 megapixels, which takes long to draw."""

    def _read_sensor(self) -> tuple[int, int]:
        height, width = super()._read_sensor()
        return min(height, 512), min(width, 512)


class TestContract(CameraContract):
    def make(self) -> BaslerCamera:
        return SmallCamera(camera_of().options)

    def test_lost_frames_are_counted(self, camera: Camera) -> None:
        pytest.skip("pylon's emulated camera waits for a free buffer; frames that fail are a test of its own")


def test_it_is_labelled_simulated_and_found(camera: BaslerCamera) -> None:
    assert camera.identity.simulated
    assert camera.identity.serial_number == "0815-0000"
    found = {device.serial_number: device for device in BaslerCamera.discover()}
    assert found["0815-0001"].options == {"serial_number": "0815-0001"}
    assert 'driver = "basler"' in found["0815-0001"].bench_lines()


def test_frames_that_fail_count_as_lost(camera: BaslerCamera) -> None:
    camera._features.set_number("ForceFailedBufferCount", 3)
    camera.start_sequence(8)
    frames = [camera.next_frame(5.0).metadata for _ in range(2)]
    camera._features.execute("ForceFailedBuffer")
    frames += [camera.next_frame(5.0).metadata for _ in range(10)]
    camera.stop_sequence()
    assert camera.incomplete_frames == 3
    assert sum(metadata.dropped_before for metadata in frames) == 3
    assert frames[-1].frame_id == frames[0].frame_id + 11 + 3


def test_a_gige_cameras_ticks_are_told_as_nanoseconds(
    camera: BaslerCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    find, number = camera._features.find, camera._features.number
    clock = "GevTimestampTickFrequency"
    monkeypatch.setattr(camera._features, "find", lambda *names: clock if clock in names else find(*names))
    monkeypatch.setattr(camera._features, "number", lambda name: 125e6 if name == clock else number(name))
    camera._begin(2)
    camera._end()
    result = SimpleNamespace(
        GrabSucceeded=lambda: True,
        Height=256,
        Width=512,
        GetBuffer=lambda: b"",
        BlockID=7,
        TimeStamp=(1 << 60) + 1,
        PaddingX=0,
    )
    assert camera._raw(result).device_time_ns == 8 * ((1 << 60) + 1)


@pytest.mark.parametrize(("pixel_format", "dtype"), [("Mono8", "u1"), ("Mono12", "u2")])
def test_bytes_that_pad_each_line_are_left_out(camera: BaslerCamera, pixel_format: str, dtype: str) -> None:
    camera.set_pixel_format(pixel_format)
    image = (np.arange(256 * 512).reshape(256, 512) % 251).astype(dtype)
    padded = np.pad(image.view("u1"), ((0, 0), (0, 6)), constant_values=77)
    result = SimpleNamespace(
        GrabSucceeded=lambda: True,
        Height=256,
        Width=512,
        GetBuffer=lambda: padded.tobytes(),
        BlockID=7,
        TimeStamp=1,
        PaddingX=6,
    )
    out = np.zeros_like(image)
    assert camera._decode(camera._raw(result).data, out)
    np.testing.assert_array_equal(out, image)


def test_a_picture_from_its_file_arrives_whole(camera: BaslerCamera) -> None:
    camera._features.choose("TestImageSelector", "Testimage1")
    camera.set_pixel_format("Mono12")
    image = camera.snap().image
    assert image.dtype == np.uint16
    assert image.shape == (256, 512)
    assert image.max() < 4096
    assert np.unique(image).size > 100


def test_a_hardware_trigger_sets_line_and_edge(camera: BaslerCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    assert camera.set_trigger_mode("hardware") == "hardware"
    assert camera._features.text("TriggerMode") == "On"
    assert camera._features.text("TriggerSource") == "Line1"
    assert camera.trigger_edges == ("rising", "falling")
    camera.set_trigger_mode("free_run")
    assert camera.set_trigger_line("Line3") == "Line3"
    assert camera.set_trigger_edge("falling") == "falling"
    camera.set_trigger_mode("hardware")
    assert camera._features.text("TriggerSource") == "Line3"
    assert camera._features.text("TriggerActivation") == "FallingEdge"
    with pytest.raises(LimitError, match=r"no trigger line 'Line7'\. It offers .*Line3"):
        camera.set_trigger_line("Line7")
    # A camera that takes a word and has another is not believed.
    monkeypatch.setattr(camera._features, "_write_text", lambda name, entry: None)
    with pytest.raises(DeviceError, match=r"was told TriggerSelector = .* and has FrameStart"):
        camera.set_trigger_mode("free_run")
    assert camera.trigger_mode == "hardware"
    assert camera._features.choose("ExposureAuto", "Once") == "Off"  # which it is when it is done


def test_a_camera_that_is_unplugged_is_lost_and_comes_back(
    camera: BaslerCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The emulator cannot be unplugged: the library's own answer that a camera is gone stands for it."""
    camera.set_exposure_ms(3.0)
    camera.start_sequence(4)
    camera.next_frame(5.0)
    unplug = threading.Timer(
        0.1, lambda: monkeypatch.setattr(type(camera._camera), "IsCameraDeviceRemoved", _gone)
    )
    unplug.start()
    began_s = time.monotonic()
    with pytest.raises(DeviceLostError, match="is gone: unplugged"):
        _fetch(camera, began_s + 30)
    unplug.join()
    assert not camera.is_open
    with pytest.raises(DeviceLostError):
        camera.settings()
    monkeypatch.setattr(type(camera._camera), "IsCameraDeviceRemoved", lambda _camera: False)
    camera.open()
    assert camera.exposure_ms == pytest.approx(3.0)
    assert camera.roi == Roi(0, 0, 256, 512)
    camera.snap()


def _fetch(camera: BaslerCamera, until_s: float) -> None:
    while time.monotonic() < until_s:
        camera.next_frame(5.0)


def _gone(_camera: object) -> bool:
    return True


def test_what_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceError, match=r"was not found; found: 0815-0000, 0815-0001"):
        camera_of(serial_number="4711").open()
    with pytest.raises(DeviceError, match=r"2 Basler cameras .* Name one by serial_number"):
        camera_of(serial_number=None).open()
    with pytest.raises(DeviceError, match="Give pixel_pitch_um"):
        camera_of(pixel_pitch_um=None).open()
    with pytest.raises(LimitError, match="has no feature 'Colour'"):
        camera_of(features={"Colour": 1}).open()
    with camera_of(features={"ReverseX": True, "DigitalShift": 1, "Width": 64}) as camera:
        assert camera.settings()["feature.ReverseX"] == "1"
        assert set(camera.own_settings()) == {"ReverseX", "DigitalShift"}  # the driver sets the others
    monkeypatch.setitem(__import__("sys").modules, "pypylon", None)
    with pytest.raises(DeviceError, match=r"pip install .diffuserbench\[basler\]"):
        camera_of().open()
