"""The Raspberry Pi's camera over a stand-in of picamera2's interface."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.camera import Roi
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError
from drivers.raspberry import camera as module
from drivers.raspberry import modes
from drivers.raspberry.camera import RaspberryCamera, RaspberryOptions
from drivers.raspberry.modes import raw_format
from drivers.testing.camera import CameraContract
from tests.mocks.picamera2_stand_in import BLACK, LINE_US, Picamera2, counts


@pytest.fixture(autouse=True)
def library(monkeypatch: pytest.MonkeyPatch) -> type[Picamera2]:
    """A library of its own for each test, on a Raspberry Pi 4."""
    made = type("Picamera2", (Picamera2,), {})
    monkeypatch.setattr(Picamera2, "opened", 0)
    monkeypatch.setitem(sys.modules, "picamera2", SimpleNamespace(Picamera2=made))
    return made


def camera_of(**options: Any) -> RaspberryCamera:
    return RaspberryCamera(RaspberryOptions(**options))


class TestContract(CameraContract):
    def make(self) -> RaspberryCamera:
        return camera_of()


def test_every_format_holds_the_sensors_counts(library: type[Picamera2]) -> None:
    for model, formats in (
        (4, ["BayerRG12", "BayerRG12 (MIPI)", "BayerRG10", "BayerRG10 (MIPI)"]),
        (5, ["BayerRG12", "BayerRG10"]),  # what it sends packed is compressed with loss
    ):
        library.model = model
        with camera_of() as camera:
            assert list(camera.pixel_formats) == formats
            for name in formats:
                camera.set_pixel_format(name)
                bits = camera.significant_bits
                assert bits == int(name[7:9])
                camera.set_roi(None)
                frame = camera.snap()
                numbers = [n for n in range(20) if np.array_equal(counts(n, (48, 64), bits), frame.image)]
                assert len(numbers) == 1, name
                assert frame.metadata.black_level == camera.black_level == BLACK >> (16 - bits)
                assert camera.set_roi(Roi(5, 7, 20, 30)) == Roi(6, 8, 18, 28)
                cut = camera.snap().image
                assert any(np.array_equal(counts(n, (48, 64), bits)[6:24, 8:36], cut) for n in range(20))


def test_a_mode_that_bins_has_larger_pixels() -> None:
    with camera_of() as camera:
        assert camera.sensor_shape == (48, 64)
        assert camera.pixel_pitch_um == pytest.approx(1.55)
    with camera_of(size=(24, 32)) as camera:
        assert camera.snap().image.shape == camera.sensor_shape == (24, 32)
        assert camera.pixel_pitch_um == pytest.approx(3.10)


def test_frames_say_what_they_were_exposed_with() -> None:
    with camera_of() as camera:
        asked_us = 10_003
        said_us = round(camera.set_exposure_ms(asked_us / 1e3) * 1e3)
        assert said_us == asked_us // LINE_US * LINE_US
        camera.set_gain(3.3)
        assert camera.gain == round(3.3 * 16) / 16
        camera.start_sequence(4)
        assert camera.next_frame(5.0).metadata.exposure_ms == said_us / 1e3
        camera.set_exposure_ms(20.0)
        exposures = [camera.next_frame(5.0).metadata.exposure_ms for _ in range(8)]
        # Some were on their way with the exposure of before, and say so; snaps let those go.
        assert exposures[0] == said_us / 1e3
        assert exposures[-1] == 20_000 // LINE_US * LINE_US / 1e3
        camera.stop_sequence()
        camera.set_exposure_ms(5.0)
        assert camera.snap().metadata.exposure_ms == 5_000 // LINE_US * LINE_US / 1e3


def test_its_own_controls_can_be_set() -> None:
    with camera_of(controls={"LensPosition": 2.0}) as camera:
        (own,) = camera.own_settings().items()
        assert (own[0], own[1].value, own[1].takes) == ("LensPosition", 2.0, "0 to 32")
        assert camera.set_own("LensPosition", "7.5") == 7.5
        assert camera._camera._controls["LensPosition"] == 7.5
        for wrong in ("33", "near", "nan"):
            with pytest.raises(LimitError, match=r"LensPosition does not take .*It takes 0 to 32"):
                camera.set_own("LensPosition", wrong)
        with pytest.raises(LimitError, match="no setting 'ExposureTime'"):
            camera.set_own("ExposureTime", "100")
        camera.close()
        camera.open()  # what was set comes back
        assert camera.own_settings()["LensPosition"].value == 7.5
        assert camera._camera._controls["LensPosition"] == 7.5


def test_a_pulled_cable_is_said(library: type[Picamera2], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_START_S", 0.1)
    with camera_of() as camera:
        camera.start_sequence(4)
        camera.next_frame(5.0)
        library.broken_after = 0
        with pytest.raises(DeviceTimeoutError):
            [camera.next_frame(0.2) for _ in range(9)]
        camera.stop_sequence()
        with pytest.raises(DeviceTimeoutError, match="sends no frame with the exposure it was set to"):
            camera.set_exposure_ms(7.0)


def test_an_exposure_that_the_sensor_never_makes_is_not_waited_for_without_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_START_S", 0.1)
    with pytest.raises(DeviceTimeoutError, match="sends no frame with the exposure it was set to"):
        camera_of(controls={"ExposureTime": 40_000}).open()  # whatever else is asked for


def test_what_is_not_there_is_said(library: type[Picamera2], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceError, match=r"there is no such camera; found 0: imx000"):
        camera_of(index=1).open()
    with pytest.raises(
        LimitError, match=r"has no sensor mode \(100, 100\). It offers \(48, 64\), \(24, 32\)"
    ):
        camera_of(size=(100, 100)).open()
    with pytest.raises(LimitError, match="has no control Zoom"):
        camera_of(controls={"Zoom": 2}).open()
    with camera_of(controls={"LensPosition": 1.5}), pytest.raises(DeviceError, match="Another program may"):
        camera_of().open()
    library.model = 5
    with camera_of() as camera:
        monkeypatch.setattr(
            "tests.mocks.picamera2_stand_in.words", lambda image, stride: np.full(48 * stride, 3, np.uint8)
        )
        with pytest.raises(DeviceError, match="sends 12 bits in 16 otherwise than a Raspberry Pi 5 does"):
            camera.snap()
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(DeviceError, match="sudo apt install python3-picamera2"):
        camera_of().open()


def test_it_is_found_on_a_raspberry_pi_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setattr(modes, "_MODEL", tmp_path / "model")
    assert RaspberryCamera.discover() == ()
    (tmp_path / "model").write_text("Raspberry Pi 4 Model B Rev 1.4\x00")
    (found,) = RaspberryCamera.discover()
    assert 'driver = "raspberry"\nindex = 0' in found.bench_lines()


@pytest.mark.parametrize(
    ("asked", "sent", "depth", "name", "shift"),
    [
        ("SBGGR8", "SBGGR8", 8, "BayerBG8", 0),
        ("SGBRG14", "SGBRG14", 14, "BayerGB14", 0),
        ("R10_CSI2P", "R10_CSI2P", 10, "Mono10 (MIPI)", 0),
        ("R10", "R16", 10, "Mono10", 6),
        ("SGRBG12", "SGRBG16", 12, "BayerGR12", 4),
        ("SRGGB14_CSI2P", "SRGGB14_CSI2P", 14, None, 0),
        ("SRGGB12_CSI2P", "RGGB_PISP_COMP1", 12, None, 0),
        ("YUYV", "YUYV", 8, None, 0),
    ],
)
def test_formats_by_libcameras_names(asked: str, sent: str, depth: int, name: str | None, shift: int) -> None:
    made = raw_format(asked, sent, depth)
    assert (made and (made.name, made.shift)) == (name and (name, shift))
