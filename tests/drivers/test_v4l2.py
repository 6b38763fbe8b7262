"""The V4L2 driver over a kernel that answers byte by byte."""

from __future__ import annotations

import errno
import threading
from ctypes import sizeof
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.camera import Roi
from drivers.errors import (
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
    LimitError,
    StoppedError,
)
from drivers.registry.claim import DeviceBusyError
from drivers.testing.camera import CameraContract
from drivers.v4l2 import api
from drivers.v4l2.camera import V4l2Camera, V4l2Options
from drivers.v4l2.formats import FORMATS, decode
from tests.mocks import v4l2_kernel as fake
from tests.mocks.v4l2_kernel import FakeKernel


def camera_on(kernel: FakeKernel, **options: Any) -> V4l2Camera:
    class OnFakeKernel(V4l2Camera):
        pass

    OnFakeKernel.kernel = kernel
    given = {"device": "/dev/video0", "pixel_pitch_um": 3.0, "frames_to_skip": 0}
    return OnFakeKernel(V4l2Camera.Options(**given | options))


class TestContract(CameraContract):
    def make(self) -> V4l2Camera:
        kernel = FakeKernel(formats=("GREY", "Y16 ", "Y10 ", "RGGB", "RG10", "YUYV", "RGB3"))
        kernel.line_padding = 6
        return camera_on(kernel)


class TestContractOfACameraThatCrops(CameraContract):
    def make(self) -> V4l2Camera:
        kernel = FakeKernel()
        kernel.crop_step = 4
        kernel.start_of_exposure = True
        return camera_on(kernel)


# The kernel's layouts ---
@pytest.mark.parametrize(
    ("structure", "size"),
    [
        (api.Capability, 104),
        (api.FormatDescription, 64),
        (api.PixFormat, 48),
        (api.Format, 208),
        (api.FrameSize, 44),
        (api.RequestBuffers, 20),
        (api.Buffer, 88),
        (api.QueryControl, 68),
        (api.QueryMenu, 44),
        (api.ControlValue, 8),
        (api.Selection, 64),
        (api.StreamParm, 204),
    ],
)
def test_structures_have_the_size_of_the_64_bit_header(structure: type, size: int) -> None:
    assert sizeof(structure) == size


def test_fields_lie_where_the_64_bit_header_has_them() -> None:
    buffer = api.Buffer
    offsets = [getattr(buffer, name).offset for name in ("timestamp", "sequence", "memory", "m", "length")]
    assert offsets == [24, 56, 60, 64, 72]
    assert api.Format.fmt.offset == 8  # type: ignore[attr-defined]
    assert api.Selection.r.offset == 12  # type: ignore[attr-defined]
    assert api.QueryMenu.u.offset == 8  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", [name for name in vars(fake) if name.isupper() and hasattr(api, name)])
def test_request_numbers_are_those_of_the_header(name: str) -> None:
    assert getattr(api, name) == getattr(fake, name)


# Frames ---
@pytest.mark.parametrize(("code", "name", "factor"), [("GREY", "Mono8", 1), ("Y16 ", "Mono16", 257)])
def test_pixels_and_lines_with_padding_are_as_the_camera_sent_them(code: str, name: str, factor: int) -> None:
    kernel = FakeKernel(formats=(code,))
    kernel.line_padding = 10
    with camera_on(kernel) as camera:
        assert camera.pixel_format == name
        image = camera.snap().image
    rows, columns = np.mgrid[:48, :64]
    np.testing.assert_array_equal(image, (rows * 7 + columns * 3) % 256 * factor)


def test_a_control_that_turns_the_pixels_turns_the_mosaic() -> None:
    kernel = FakeKernel(formats=("RGGB", "YUYV"))
    kernel.controls[0x980914] = fake.FakeControl("Horizontal Flip", 2, 0, 1, 1, 0, 0, flags=0x400)
    with camera_on(kernel, controls={"horizontal_flip": 1}) as camera:
        assert camera.pixel_format == "BayerGR8"
        camera.set_pixel_format("BayerGR8")
        camera.set_roi(Roi(4, 8, 20, 30))
        camera.set_own("horizontal_flip", "0")
        assert (camera.pixel_format, camera.roi) == ("BayerRG8", Roi(4, 8, 20, 30))
        assert camera.snap().metadata.pixel_format == "BayerRG8"
        for chosen in ("BayerRG8", "Mono8 (YUYV)"):
            camera.set_pixel_format(chosen)
            camera.start_sequence()
            with pytest.raises(DeviceError, match="streams: no new horizontal_flip now"):
                camera.set_own("horizontal_flip", "1")
            kernel.unplugged = True
            with pytest.raises(DeviceLostError):
                [camera.next_frame(1.0) for _ in range(20)]
            kernel.unplugged = False
            camera.open()  # as bench.toml has it, then as it was set since
            assert (camera.pixel_format, camera.roi) == (chosen, Roi(4, 8, 20, 30))


def test_a_control_that_makes_the_images_unreadable_is_set_back_and_not_remembered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kernel = FakeKernel(formats=("RGGB",))
    turns = kernel.controls[0x980914] = fake.FakeControl("Horizontal Flip", 2, 0, 1, 1, 0, 0, flags=0x400)
    with camera_on(kernel) as camera:
        look_again = camera._images.look_again

        def unreadable() -> None:
            if turns.value:
                raise DeviceError(camera.name, "offers no pixel format that can be read here.")
            look_again()

        monkeypatch.setattr(camera._images, "look_again", unreadable)
        with pytest.raises(DeviceError, match="no pixel format that can be read"):
            camera.set_own("horizontal_flip", "1")
        assert (turns.value, camera._remembered, camera.pixel_format) == (0, {}, "BayerRG8")


@pytest.mark.parametrize("crop_step", [0, 8])
def test_a_region_shows_the_same_pixels_whoever_cuts_it(crop_step: int) -> None:
    kernel = FakeKernel(formats=("GREY",))
    kernel.crop_step = crop_step
    with camera_on(kernel) as camera:
        roi = camera.set_roi(Roi(9, 17, 30, 40))
        assert roi == (Roi(16, 24, 16, 32) if crop_step else Roi(9, 17, 30, 40))
        assert camera.settings()["roi_cut_by"] == ("camera" if crop_step else "driver")
        image = camera.snap().image
        assert camera.set_roi(None) == Roi(0, 0, 48, 64)
        assert camera.snap().image.shape == (48, 64)
    rows, columns = np.mgrid[roi.top : roi.top + roi.height, roi.left : roi.left + roi.width]
    np.testing.assert_array_equal(image, (rows * 7 + columns * 3) % 256)


def test_a_region_of_a_mosaic_begins_with_the_mosaics_first_colour() -> None:
    with camera_on(FakeKernel(formats=("RGGB",))) as camera:
        assert camera.set_roi(Roi(9, 17, 30, 40)) == Roi(10, 18, 28, 38)


def test_lost_and_damaged_frames_are_counted_exactly() -> None:
    kernel = FakeKernel()
    kernel.lost, kernel.damaged = {3, 4, 9}, {6, 10}
    with camera_on(kernel) as camera:
        camera.set_exposure_ms(1.0)
        camera.start_sequence(20)  # all of them have a place: a machine that is late loses none
        frames = [camera.next_frame(5).metadata for _ in range(10)]
        assert camera.incomplete_frames == 2
    # Sequence numbers 0 1 2 5 7 8 11 12 13 14 arrive whole.
    assert [m.dropped_before for m in frames] == [0, 0, 0, 2, 1, 0, 2, 0, 0, 0]
    assert [m.frame_id for m in frames] == [0, 1, 2, 5, 7, 8, 11, 12, 13, 14]


def test_frames_damaged_before_the_first_whole_one_are_counted() -> None:
    kernel = FakeKernel()
    kernel.damaged, kernel.lost = {0, 2}, {1}
    with camera_on(kernel) as camera:
        camera.set_exposure_ms(1.0)
        for first in (0, 5):  # in each sequence anew
            camera.start_sequence(4)
            frames = [camera.next_frame(5).metadata for _ in range(2)]
            camera.stop_sequence()
            # Sequence numbers 3 4 arrive whole.
            assert [m.dropped_before for m in frames] == [3, 0]
            assert [m.frame_id for m in frames] == [first + 3, first + 4]


def test_a_trigger_that_nobody_waits_for_is_refused() -> None:
    with camera_on(FakeKernel()) as camera:
        with pytest.raises(DeviceError, match="no software trigger now"):
            camera.trigger()
        camera.start_sequence(4)
        with pytest.raises(DeviceError, match="no software trigger now"):
            camera.trigger()


def test_a_camera_that_does_not_number_its_frames_is_refused_in_words() -> None:
    kernel = FakeKernel()
    kernel.numbered = False
    with camera_on(kernel) as camera:
        camera.start_sequence(4)
        for _ in range(3):
            camera.next_frame(5)
        with pytest.raises(DeviceError, match="does not number its frames"):
            camera.next_frame(5)
        assert not kernel.streaming
        kernel.numbered = True
        camera.start_sequence(4)
        assert camera.next_frame(5).metadata.dropped_before == 0


def test_device_times_are_ends_of_exposures() -> None:
    times = []
    for at_start in (False, True):
        kernel = FakeKernel()
        kernel.start_of_exposure = at_start
        with camera_on(kernel) as camera:
            camera.set_exposure_ms(20.0)
            snaps = [camera.snap().metadata for _ in range(5)]
        assert all(m.device_time_ns is not None for m in snaps)
        times.append(min(m.host_time_ns - (m.device_time_ns or 0) for m in snaps))  # one may be held up
    assert all(-1e5 < late < 20e6 for late in times)  # a start taken for an end would be 20 ms late


def test_times_of_an_unknown_clock_are_not_passed_on() -> None:
    kernel = FakeKernel()
    kernel.clock_flags = 0
    with camera_on(kernel) as camera:
        assert camera.snap().metadata.device_time_ns is None


def test_jpeg_frames_are_decoded_and_cut_off_ones_are_counted() -> None:
    kernel = FakeKernel(formats=("MJPG",))
    colours = np.zeros((48, 64, 3), np.uint8)
    colours[..., 2] = 200  # BGR: red
    jpeg = cv2.imencode(".jpg", colours)[1].tobytes()
    kernel.image = lambda sequence, *_: jpeg[: len(jpeg) // 2] if sequence == 1 else jpeg + b"\0\0"
    with camera_on(kernel) as camera:
        assert camera.pixel_formats == ("Mono8 (MJPG)", "RGB8 (MJPG)")
        camera.set_pixel_format("RGB8 (MJPG)")
        camera.start_sequence(4)
        first, second = camera.next_frame(5), camera.next_frame(5)
        camera.stop_sequence()
        camera.set_pixel_format("Mono8 (MJPG)")
        grey = camera.snap().image
    np.testing.assert_allclose(first.image, np.broadcast_to((200, 0, 0), (48, 64, 3)), atol=4)
    assert second.metadata.dropped_before == 1
    np.testing.assert_allclose(grey, 0.299 * 200, atol=3)


@pytest.mark.parametrize("code", ["YUYV", "UYVY", "NV12"])
@pytest.mark.parametrize("padding", [0, 8])
def test_luma_and_colours_of_video_formats(code: str, padding: int) -> None:
    kernel = FakeKernel(formats=("MJPG", code))
    kernel.line_padding = padding
    with camera_on(kernel) as camera:
        assert camera.pixel_format == f"Mono8 ({code})"  # before the compressed one
        luma = camera.snap().image
        camera.set_pixel_format(f"RGB8 ({code})")
        colour = camera.snap().image
    rows, columns = np.mgrid[:48, :64]
    np.testing.assert_array_equal(luma, (rows * 7 + columns * 3) % 256)
    assert colour.shape == (48, 64, 3)
    np.testing.assert_array_equal(colour[..., 0], colour[..., 2])  # no chroma: grey


def test_a_driver_of_memory_planes_gives_the_same_images() -> None:
    shown = []
    for planes in (0, 1):
        kernel = FakeKernel(formats=("Y16 ", "NV12"))
        kernel.planes, kernel.line_padding = planes, 8
        with camera_on(kernel) as camera:
            camera.set_pixel_format("Mono8 (NV12)")
            shown.append(camera.snap().image)
            camera.set_pixel_format("Mono16")
            shown.append(camera.snap().image)
    np.testing.assert_array_equal(shown[0], shown[2])
    np.testing.assert_array_equal(shown[1], shown[3])
    kernel.planes = 2
    with pytest.raises(DeviceError, match="over 2 memory planes; one can be read here"):
        camera_on(kernel).open()


# Settings ---
def test_automatics_are_off_after_opening() -> None:
    kernel = FakeKernel()
    with camera_on(kernel):
        assert kernel.controls[fake.AUTO_EXPOSURE].value == 1
        assert kernel.controls[fake.AUTOGAIN].value == 0


def test_what_was_automatic_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    kernel = FakeKernel()
    kernel.controls[0x9A090C] = fake.FakeControl("Focus, Automatic", 2, 0, 1, 1, 1, 1)
    kernel.controls[0x98090C] = fake.FakeControl("White Balance, Automatic", 2, 0, 1, 1, 1, 1)
    with camera_on(kernel):
        assert kernel.controls[0x9A090C].value == kernel.controls[0x98090C].value == 0
    (said,) = [text for text in caplog.messages if "switched off" in text]
    for name in ("auto_exposure", "gain_automatic", "white_balance_automatic", "focus_automatic"):
        assert name in said
    caplog.clear()
    with camera_on(kernel):  # nothing was on
        assert not [text for text in caplog.messages if "switched off" in text]


def test_what_the_driver_made_of_an_exposure_is_reported() -> None:
    kernel = FakeKernel()
    kernel.exposure_step = 50
    with camera_on(kernel) as camera:
        assert camera.set_exposure_ms(12.3) == camera.exposure_ms == pytest.approx(10.0)
        assert camera.snap().metadata.exposure_ms == pytest.approx(10.0)


def test_controls_have_ranges_and_menus() -> None:
    with camera_on(FakeKernel()) as camera:
        found = {control.name: control for control in camera.controls}
        assert found["brightness"].minimum == -64
        assert found["auto_exposure"].menu == {0: "Auto Mode", 1: "Manual Mode", 3: "Aperture Priority Mode"}
        assert camera.set_control("power_line_frequency", 2) == 2
        assert camera.settings()["control.power_line_frequency"] == "2 (60 Hz)"
        assert "control.pan_reset" not in camera.settings()
        camera.set_control("pan_reset", 1)
        with pytest.raises(LimitError, match=r"brightness does not take 65\. It takes -64 to 64"):
            camera.set_control("brightness", 65)
        with pytest.raises(LimitError, match=r"does not take 2\. It takes 0 \(Auto Mode\), 1"):
            camera.set_control("auto_exposure", 2)
        with pytest.raises(LimitError, match="has no control 'zoom'"):
            camera.set_control("zoom", 1)
        with pytest.raises(DeviceError, match="read_only is read only"):
            camera.set_control("read_only", 1)


def test_controls_of_the_configuration_are_set_on_opening() -> None:
    kernel = FakeKernel()
    with camera_on(kernel, controls={"brightness": -5}):
        assert kernel.controls[0x980900].value == -5
    with pytest.raises(LimitError, match="'colour'"):
        camera_on(kernel, controls={"colour": 1}).open()
    assert kernel.opened == 0


def test_size_and_frame_rate_are_set_and_read_back(caplog: pytest.LogCaptureFixture) -> None:
    kernel = FakeKernel()
    with camera_on(kernel, size=(16, 32), frames_per_s=1000) as camera:
        assert camera.sensor_shape == (16, 32)
        assert camera.settings()["frames_per_s"] == pytest.approx(500)
    with camera_on(kernel, size=(17, 32)) as camera:
        assert camera.sensor_shape == (16, 32)
    assert "images are 16 x 32, asked for 17 x 32" in caplog.text
    assert "takes 500 frames/s, asked for 1000" in caplog.text


@pytest.mark.parametrize("size", [(0, 32), (16, -5)])
def test_a_size_that_is_none_is_a_mistake_of_the_configuration(size: tuple[int, int]) -> None:
    with pytest.raises(ValidationError, match="greater than 0"):
        V4l2Options(pixel_pitch_um=3.0, size=size)


def test_gain_is_a_factor_by_the_configured_unit() -> None:
    with camera_on(FakeKernel(), gain_unit="dB", gain_per_count=0.2) as camera:
        assert camera.gain_limits == (1.0, pytest.approx(10.0))
        assert camera.set_gain(2.0) == pytest.approx(10 ** (30 * 0.2 / 20))


def test_a_control_that_unplugs_the_camera_is_set_and_what_comes_next_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kernel = FakeKernel()
    with camera_on(kernel) as camera:
        camera.start_sequence(4)
        set_value = kernel._s_ctrl

        def unplugs(data: object) -> int:
            kernel.unplugged = True
            return set_value(data)

        monkeypatch.setattr(kernel, "_s_ctrl", unplugs)
        camera.set_control("pan_reset", 1)  # a button: nothing is read back
        assert not camera.is_open
        with pytest.raises(DeviceLostError, match="is gone"):
            camera.next_frame(5.0)


def test_controls_of_the_sensors_own_node_are_the_cameras() -> None:
    kernel = FakeKernel()
    del kernel.controls[fake.EXPOSURE], kernel.controls[fake.GAIN]
    kernel.of_subdevice = {
        0x980911: fake.FakeControl("Exposure", 1, 4, 2000, 1, 500, 500),
        0x9E0901: fake.FakeControl("Vertical Blanking", 1, 4, 9000, 1, 20, 20),
        0x9E0903: fake.FakeControl("Analogue Gain", 1, 0, 100, 1, 0, 7),
        fake.BLACK: fake.FakeControl("Black Level", 1, 0, 4095, 1, 64, 64),
    }
    given = {"subdevices": ["/dev/v4l-subdev0"], "exposure_line_us": 20.0, "controls": {"exposure": 50}}
    with camera_on(kernel, **given) as camera:
        assert camera.exposure_limits_ms == (0.08, 40.0)
        assert camera.exposure_ms == 1.0
        assert camera.set_exposure_ms(10.0) == pytest.approx(10.0)
        assert kernel.of_subdevice[0x980911].value == 500
        assert camera.set_gain(3.0) == 3.0
        assert kernel.of_subdevice[0x9E0903].value == 2
        assert camera.black_level == 16  # of the node that comes first
        kernel.of_subdevice[0x980911].maximum, kernel.of_subdevice[0x980911].value = 4000, 400
        camera.set_control("vertical_blanking", 2020)  # longer frames hold longer exposures
        assert camera.exposure_limits_ms == (0.08, 80.0)
        assert camera.exposure_ms == 8.0
        kernel.unplugged = True
        with pytest.raises(DeviceLostError, match="v4l-subdev0 is gone"):
            camera.set_gain(2.0)
        assert not camera.is_open
    assert kernel.opened == 0
    with pytest.raises(DeviceError, match=r"no /dev/v4l-subdev3.*Nodes of its kind"):
        camera_on(FakeKernel(), subdevices=["/dev/v4l-subdev3"]).open()
    claims = V4l2Camera.claims(V4l2Camera.Options(pixel_pitch_um=1.0, **given))
    assert len(claims) == 2


def test_a_camera_without_exposure_control_says_so() -> None:
    kernel = FakeKernel()
    del kernel.controls[fake.EXPOSURE]
    kernel.controls[fake.EXPOSURE] = fake.FakeControl("Other", 1, 1, 2, 1, 1, 1, flags=0x1)  # disabled
    with camera_on(kernel) as camera:
        assert camera.exposure_ms == pytest.approx(5.0)
        with pytest.raises(LimitError, match="cannot be set: 5 ms, a frame's period"):
            camera.set_exposure_ms(7.0)


def test_a_camera_that_exposes_only_automatically_is_refused() -> None:
    kernel = FakeKernel()
    del kernel.controls[fake.AUTO_EXPOSURE].menu[1]
    with pytest.raises(DeviceError, match="cannot be set by hand: auto_exposure offers 0"):
        camera_on(kernel).open()


def test_a_camera_without_a_format_that_can_be_read_is_refused() -> None:
    with pytest.raises(DeviceError, match="no pixel format that can be read here, only H264"):
        camera_on(FakeKernel(formats=("H264",))).open()


# What goes wrong ---
@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.EACCES, "group 'video'"), (errno.ENOENT, "there is no /dev/video0"), (errno.EBUSY, "in use")],
)
def test_what_keeps_a_node_from_opening_is_said(number: int, words: str) -> None:
    kernel = FakeKernel()
    kernel.refuse[0] = number
    with pytest.raises(DeviceError, match=words):
        camera_on(kernel).open()


def test_another_program_that_streams_is_told_apart() -> None:
    kernel = FakeKernel()
    with camera_on(kernel) as camera:
        kernel.refuse[fake.REQBUFS] = errno.EBUSY
        with pytest.raises(DeviceBusyError, match="in use by another program"):
            camera.start_sequence()
        assert not camera.is_streaming
        camera.snap()


@pytest.mark.parametrize("request_number", [fake.QUERYBUF, fake.QBUF, fake.STREAMON, fake.REQBUFS])
def test_a_sequence_that_does_not_start_leaves_nothing_behind(request_number: int) -> None:
    kernel = FakeKernel()
    with camera_on(kernel) as camera:
        kernel.refuse[request_number] = errno.EINVAL
        with pytest.raises(DeviceError, match="Invalid argument"):
            camera.start_sequence()
        assert not camera.is_streaming
        assert not kernel.memory
        camera.snap()


def test_unplugging_ends_a_wait_and_opening_again_restores_the_settings() -> None:
    kernel = FakeKernel()
    camera = camera_on(kernel)
    camera.open()
    camera.set_pixel_format("Mono8")
    camera.set_roi(Roi(4, 8, 20, 30))
    camera.set_gain(50)
    camera.set_exposure_ms(400.0)
    camera.start_sequence()
    threading.Timer(0.1, lambda: setattr(kernel, "unplugged", True)).start()
    with pytest.raises(DeviceLostError, match=r"/dev/video0 is gone"):
        camera.next_frame(10)
    assert not camera.is_open
    assert not camera.is_streaming
    with pytest.raises(DeviceLostError):
        camera.snap()
    with pytest.raises(DeviceError, match="there is no /dev/video0"):
        camera.open()
    kernel.unplugged = False
    kernel.controls[fake.EXPOSURE].value = 77
    camera.open()
    assert (camera.pixel_format, camera.roi, camera.gain) == ("Mono8", Roi(4, 8, 20, 30), 50)
    assert camera.exposure_ms == pytest.approx(400.0)
    camera.set_exposure_ms(1.0)
    assert camera.snap().image.shape == (20, 30)
    camera.close()
    assert kernel.opened == 0


def test_a_region_that_a_new_format_ended_does_not_come_back() -> None:
    kernel = FakeKernel(formats=("GREY", "Y16 "))
    kernel.shapes["GREY"] = (24, 40)
    with camera_on(kernel) as camera:
        camera.set_roi(Roi(8, 8, 32, 48))
        camera.set_pixel_format("Mono8")
        assert camera.roi == Roi(0, 0, 24, 40)
        kernel.unplugged = True
        with pytest.raises(DeviceLostError):
            camera.snap()
        kernel.unplugged = False
        camera.open()
        assert (camera.pixel_format, camera.roi) == ("Mono8", Roi(0, 0, 24, 40))
        camera.set_roi(Roi(4, 4, 8, 8))
        kernel.unplugged = True
        with pytest.raises(DeviceLostError):
            camera.snap()
        kernel.unplugged = False
        for _ in range(2):  # what is restored is remembered further on
            camera.close()
            camera.open()
            assert (camera.pixel_format, camera.roi) == ("Mono8", Roi(4, 4, 8, 8))


def test_a_format_that_was_not_taken_leaves_the_one_before() -> None:
    kernel = FakeKernel(formats=("Y10 ", "GREY", "Y16 "))
    with camera_on(kernel) as camera:
        camera.set_roi(Roi(8, 8, 32, 48))
        kernel.taken_for["GREY"] = "Y10 "
        with pytest.raises(DeviceError, match="takes Y10 instead of Mono8"):
            camera.set_pixel_format("Mono8")
        assert (camera.pixel_format, camera.roi) == ("Mono16", Roi(8, 8, 32, 48))
        assert camera.snap().image.max() > 1023


def test_unplugging_is_noticed_by_settings_too() -> None:
    kernel = FakeKernel()
    camera = camera_on(kernel)
    camera.open()
    kernel.unplugged = True
    with pytest.raises(DeviceLostError):
        camera.set_exposure_ms(2.0)
    assert not camera.is_open
    camera.close()


def test_a_failed_stream_says_what_to_check() -> None:
    kernel = FakeKernel()
    with camera_on(kernel) as camera:
        camera.start_sequence()
        camera.next_frame(5)
        kernel.failed = True
        with pytest.raises(DeviceError, match="check the cable"):
            camera.next_frame(5)
        assert not camera.is_streaming
        kernel.failed = False
        camera.snap()


def test_a_snap_can_be_stopped() -> None:
    with camera_on(FakeKernel()) as camera:
        camera.set_exposure_ms(500.0)
        threading.Timer(0.05, camera.stop_sequence).start()
        with pytest.raises(StoppedError):
            camera.snap()
        assert not camera.is_streaming


def test_a_time_out_says_how_many_frames_came_damaged() -> None:
    kernel = FakeKernel()
    kernel.damaged = set(range(100_000))
    with camera_on(kernel) as camera:
        camera.start_sequence()
        with pytest.raises(DeviceTimeoutError, match="frames came damaged or in part"):
            camera.next_frame(0.1)


def test_a_stream_gets_every_frame_into_its_own_buffers() -> None:
    kernel = FakeKernel()
    kernel.lost = {5, 6}
    with camera_on(kernel) as camera:
        camera.set_exposure_ms(1.0)
        with camera.stream(n_buffers=4) as stream:
            reader = stream.reader()
            dropped = 0
            for _ in range(12):
                frame = reader.next_frame(5)
                assert frame is not None
                dropped += frame.metadata.dropped_before
        assert stream.error is None
    assert dropped >= 2


@settings(deadline=None)
@given(st.binary(max_size=200), st.sampled_from(FORMATS), st.integers(0, 40))
def test_arbitrary_bytes_are_decoded_or_refused(data: bytes, wanted: Any, line_bytes: int) -> None:
    shape = (4, 6, 3) if wanted.pixels.channels == 3 else (4, 6)
    out = np.zeros(shape, wanted.pixels.dtype)
    decode(np.frombuffer(data, np.uint8), wanted, line_bytes, out)


@pytest.mark.parametrize("cut", [0.3, 0.7, 0.99])
def test_a_cut_off_jpeg_is_refused(cut: float) -> None:
    jpeg = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8))[1]
    wanted = next(known for known in FORMATS if known.name == "Mono8 (MJPG)")
    out = np.zeros((48, 64), np.uint8)
    assert decode(jpeg, wanted, 0, out)
    assert not decode(jpeg[: int(len(jpeg) * cut)], wanted, 0, out)


def test_own_settings_are_the_controls_that_the_driver_leaves_alone() -> None:
    with camera_on(FakeKernel()) as camera:
        own = camera.own_settings()
        assert set(own) == {"brightness", "power_line_frequency"}
        assert own["power_line_frequency"].choices[2] == "2 (60 Hz)"
        assert camera.set_own("power_line_frequency", "2 (60 Hz)") == "2 (60 Hz)"
        assert camera.set_own("brightness", "-5") == -5
        for name, value in (("brightness", "65"), ("brightness", "much"), ("read_only", "4"), ("gain", "3")):
            with pytest.raises(LimitError, match=name):
                camera.set_own(name, value)
