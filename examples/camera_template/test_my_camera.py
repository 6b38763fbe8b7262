"""My camera keeps the contract that every camera keeps, and says in words what goes wrong."""

from __future__ import annotations

import my_camera_sdk as sdk
import pytest
from my_camera import MyCamera, MyCameraOptions

from drivers.device import Device
from drivers.errors import DeviceError, DeviceLostError
from drivers.testing.camera import CameraContract

SERIAL_NUMBER = sdk.plugged[0]


def my_camera() -> MyCamera:
    return MyCamera(MyCameraOptions(serial_number=SERIAL_NUMBER))


class TestMyCamera(CameraContract):
    """The whole contract, from this one method."""

    def make(self) -> Device:
        return my_camera()


def test_a_camera_that_is_not_there_is_an_error_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sdk, "plugged", [])
    with pytest.raises(DeviceError, match="connected: none"):
        my_camera().open()


def test_a_pulled_cable_is_said_and_settings_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    with my_camera() as camera:
        exposure_ms = camera.set_exposure_ms(3.0)
        camera.start_sequence()
        with monkeypatch.context() as pulled:
            pulled.setattr(sdk, "plugged", [])
            with pytest.raises(DeviceLostError, match="is gone"):
                camera.next_frame(5.0)
            assert not camera.is_open
        camera.open()
        assert camera.exposure_ms == exposure_ms
        assert camera.snap().image.max() > 0


def test_a_frame_that_arrives_in_part_counts_as_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    with my_camera() as camera:
        camera.start_sequence()
        before = camera.next_frame(5.0).metadata
        monkeypatch.setattr(sdk, "damage", [1])
        while not (metadata := camera.next_frame(5.0).metadata).dropped_before:
            before = metadata
        assert metadata.frame_id == before.frame_id + 1 + metadata.dropped_before


def test_it_is_found_with_its_lines_for_the_bench() -> None:
    (found,) = MyCamera.discover()
    assert found.bench_lines() == f'[camera]\ndriver = "my_camera"\nserial_number = "{SERIAL_NUMBER}"'
