"""The V4L2 camera over the kernel's own test driver: real ioctls, mapped buffers, injected errors."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.camera import Roi
from drivers.errors import DeviceError, DeviceLostError, LimitError, StoppedError
from drivers.v4l2.camera import V4l2Camera
from tests.kernel_vm.machine import load_module, remove_module

pytestmark = pytest.mark.kernel_vm

NODE = "/dev/video0"
WEBCAM = {"device": NODE, "pixel_pitch_um": 3.0, "input": 0, "size": (180, 320), "frames_per_s": 25.0}
HDMI = {"device": NODE, "pixel_pitch_um": 3.0, "input": 1}
GREYS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16, "Mono16 (big endian)": 16}


WITHOUT_OUTPUTS = ("num_outputs=0", "node_types=0x1")
VIVID = ("vivid", "n_devs=1", "num_inputs=2", "input_types=12", *WITHOUT_OUTPUTS, "no_error_inj=0")


@pytest.fixture
def camera() -> Iterator[V4l2Camera]:
    with V4l2Camera(V4l2Camera.Options(**WEBCAM)) as camera:
        yield camera


def test_it_is_found_and_says_who_it_is(camera: V4l2Camera) -> None:
    found = [device for device in V4l2Camera.discover() if device.address == NODE]
    assert [(device.driver, device.kind, device.options["device"]) for device in found] == [
        ("v4l2", "camera", NODE)
    ]
    assert camera.identity.model == "vivid"
    assert camera.identity.simulated
    assert camera.sensor_shape == (180, 320)
    assert camera.settings()["frames_per_s"] == pytest.approx(25)


def test_grey_of_all_depths_shows_the_same_colour_bars(camera: V4l2Camera) -> None:
    assert set(GREYS) <= set(camera.pixel_formats)
    camera.set_control("osd_text_mode", 2)
    seen = []
    for name, bits in GREYS.items():
        camera.set_pixel_format(name)
        frame = camera.snap()
        assert frame.metadata.significant_bits == bits
        seen.append(frame.image.astype(float) / frame.full_scale)
    for image in seen[1:]:
        np.testing.assert_allclose(image, seen[0], atol=0.01)
    assert 0.1 < seen[0].mean() < 0.9


def test_every_other_format_is_read(camera: V4l2Camera) -> None:
    camera.set_control("osd_text_mode", 2)
    bars = {}
    for name in ("BayerRG8", "BayerRG12", "BayerBG16", "RGB8", "Mono8 (YUYV)", "RGB8 (YUYV)"):
        camera.set_pixel_format(name)
        image = camera.snap().image
        assert image.shape[:2] == (180, 320)
        bars[name] = image
    # The first bars are white, yellow, cyan, ...: red is bright in the first two and dark in the third.
    for name, tolerance in (("RGB8", 3), ("RGB8 (YUYV)", 12)):
        white, yellow, cyan = (bars[name][90, 20 + 40 * i].astype(int) for i in range(3))
        assert np.ptp(white) <= tolerance
        assert yellow[2] < tolerance < yellow[0]
        assert cyan[0] < tolerance < cyan[1]
    # Of the mosaic's pixels on the cyan bar only the red ones, at even rows and columns, are dark.
    cyan_bar = bars["BayerRG8"][80:100, 90:110]
    assert cyan_bar[0::2, 0::2].max() < 10
    assert cyan_bar[1::2, 1::2].min() > 100


def test_controls_have_ranges_menus_and_are_read_back(camera: V4l2Camera) -> None:
    controls = {control.name: control for control in camera.controls}
    assert (controls["brightness"].minimum, controls["brightness"].maximum) == (0, 255)
    assert controls["test_pattern"].menu[0] == "75% Colorbar"
    assert camera.set_control("brightness", 200) == 200
    assert camera.set_control("brightness", 128) == 128
    assert controls["menu"].menu.keys() == {1, 3, 4}  # a menu with gaps
    with pytest.raises(LimitError, match="0 to 255"):
        camera.set_control("brightness", 256)
    with pytest.raises(LimitError, match="menu does not take 2"):
        camera.set_control("menu", 2)
    with pytest.raises(DeviceError, match="read only"):
        camera.set_control("read_only_integer_32_bits", 1)
    assert controls["bitmask"].maximum == 0x80402010
    assert camera.set_control("bitmask", 0x80000000) == 0x80000000
    with pytest.raises(LimitError, match="bits of 0x80402010"):
        camera.set_control("bitmask", 1)
    low, high = camera.gain_limits
    assert camera.set_gain(high) == camera.gain == high
    with pytest.raises(LimitError):
        camera.set_gain(high * 2)
    assert camera.set_gain(low) == low


def test_regions_are_cut_by_a_device_that_can() -> None:
    with V4l2Camera(V4l2Camera.Options(**HDMI)) as camera:
        camera.set_pixel_format("Mono8")
        camera.set_control("osd_text_mode", 2)
        whole = camera.snap().image
        roi = camera.set_roi(Roi(101, 203, 200, 320))
        assert camera.settings()["roi_cut_by"] == "camera"
        assert 101 <= roi.top <= 109
        assert 203 <= roi.left <= 211
        part = camera.snap().image
        assert part.shape == (roi.height, roi.width)
        expected = whole[roi.top : roi.top + roi.height, roi.left : roi.left + roi.width]
        assert np.mean(np.abs(part.astype(int) - expected) > 2) < 0.02
        assert camera.set_roi(None).height == camera.sensor_shape[0]


def test_a_region_is_cut_by_the_driver_where_the_device_cannot(camera: V4l2Camera) -> None:
    camera.set_pixel_format("Mono8")
    camera.set_control("osd_text_mode", 2)
    whole = camera.snap().image
    assert camera.set_roi(Roi(11, 21, 100, 200)) == Roi(11, 21, 100, 200)
    assert camera.settings()["roi_cut_by"] == "driver"
    np.testing.assert_array_equal(camera.snap().image, whole[11:111, 21:221])


def test_frames_that_the_device_drops_are_counted(camera: V4l2Camera) -> None:
    """The kernel's frame times, 40 ms apart, say independently of its numbers how many frames there were."""
    camera.set_pixel_format("Mono8")
    camera.set_control("percentage_of_dropped_buffers", 40)
    camera.start_sequence(8)
    frames = [camera.next_frame(10).metadata for _ in range(20)]
    camera.stop_sequence()
    camera.set_control("percentage_of_dropped_buffers", 0)
    times = [metadata.device_time_ns for metadata in frames]
    assert None not in times
    passed = (times[-1] - times[0]) / 40e6  # type: ignore[operator]
    dropped = sum(metadata.dropped_before for metadata in frames)
    assert dropped > 0
    assert dropped + 19 == pytest.approx(passed, abs=1.5)


def test_frames_that_nobody_fetched_are_counted(camera: V4l2Camera) -> None:
    camera.start_sequence(2)
    first = camera.next_frame(10).metadata
    time.sleep(1.0)
    rest = [camera.next_frame(10).metadata for _ in range(6)]
    camera.stop_sequence()
    assert sum(metadata.dropped_before for metadata in rest) >= 10
    assert rest[-1].frame_id == first.frame_id + 6 + sum(metadata.dropped_before for metadata in rest)


def test_sequence_numbers_may_wrap(camera: V4l2Camera) -> None:
    camera.set_control("wrap_sequence_number", 1)
    camera.start_sequence(4)
    frames = [camera.next_frame(10).metadata for _ in range(30)]
    camera.stop_sequence()
    camera.set_control("wrap_sequence_number", 0)
    assert sum(metadata.dropped_before for metadata in frames) < 1000


def test_a_buffer_with_an_error_is_not_handed_out_and_counts_as_lost(camera: V4l2Camera) -> None:
    camera.start_sequence(4)
    camera.next_frame(10)
    before = camera.incomplete_frames
    camera.set_control("inject_v4l2_buf_flag_error", 1)
    dropped = 0
    for _ in range(10):
        dropped += camera.next_frame(10).metadata.dropped_before
    camera.stop_sequence()
    assert camera.incomplete_frames == before + 1
    assert dropped >= 1


@pytest.mark.parametrize(
    "control", ["inject_vidioc_reqbufs_error", "inject_vidioc_qbuf_error", "inject_vidioc_streamon_error"]
)
def test_a_sequence_that_does_not_start_says_so_and_the_next_one_does(
    camera: V4l2Camera, control: str
) -> None:
    camera.set_control(control, 1)
    with pytest.raises(DeviceError, match="did not"):
        camera.start_sequence()
    assert not camera.is_streaming
    camera.snap()


def test_a_fatal_streaming_error_ends_the_wait(camera: V4l2Camera) -> None:
    camera.start_sequence(4)
    camera.next_frame(10)
    camera.set_control("inject_fatal_streaming_error", 1)
    with pytest.raises(DeviceError, match="check the cable"):
        _fetch(camera, 10)
    camera.snap()


def test_a_wait_is_ended_from_another_thread(camera: V4l2Camera) -> None:
    camera.set_control("percentage_of_dropped_buffers", 100)
    camera.start_sequence(4)
    threading.Timer(0.3, camera.stop_sequence).start()
    began = time.monotonic()
    with pytest.raises(StoppedError):
        camera.next_frame(60)
    assert time.monotonic() - began < 30
    camera.set_control("percentage_of_dropped_buffers", 0)


def test_software_triggers_let_one_frame_each_through(camera: V4l2Camera) -> None:
    camera.set_trigger_mode("software")
    camera.start_sequence(4)
    for _ in range(2):
        before = time.monotonic_ns()
        camera.trigger()
        metadata = camera.next_frame(10).metadata
        assert metadata.device_time_ns is not None
        assert metadata.device_time_ns - metadata.exposure_ms * 1e6 >= before
        assert metadata.dropped_before == 0
    camera.stop_sequence()


def test_unplugging_is_an_error_that_names_the_device_and_opening_again_restores() -> None:
    camera = V4l2Camera(V4l2Camera.Options(**WEBCAM))
    camera.open()
    camera.set_pixel_format("Mono12")
    camera.set_gain(33.0)
    camera.set_roi(Roi(10, 20, 50, 60))
    camera.start_sequence(4)
    camera.next_frame(10)
    camera.set_control("disconnect", 1)
    with pytest.raises(DeviceLostError, match=NODE):
        _fetch(camera, 10)
    assert not camera.is_open
    camera.close()
    remove_module("vivid")
    with pytest.raises(DeviceError, match="there is no"):
        camera.open()
    load_module(*VIVID)
    camera.open()
    assert (camera.pixel_format, camera.gain, camera.roi) == ("Mono12", 33.0, Roi(10, 20, 50, 60))
    assert camera.snap().image.shape == (50, 60)
    camera.close()


@pytest.mark.parametrize("planes", [1, 2], ids=["without planes", "with planes"])
def test_video_formats_with_and_without_memory_planes(planes: int) -> None:
    remove_module("vivid")
    load_module(*VIVID, f"multiplanar={planes}")
    try:
        with V4l2Camera(V4l2Camera.Options(**WEBCAM)) as camera:
            camera.set_control("osd_text_mode", 2)
            for name in ("RGB8", "RGB8 (YUYV)", "RGB8 (UYVY)", "RGB8 (NV12)"):
                camera.set_pixel_format(name)
                image = camera.snap().image
                white, yellow, cyan = (image[90, 20 + 40 * bar].astype(int) for bar in range(3))
                assert np.ptp(white) <= 12, name
                assert yellow[2] < 12 < yellow[0], name
                assert cyan[0] < 12 < cyan[1], name
            camera.set_pixel_format("Mono8 (NV12)")
            np.testing.assert_allclose(camera.snap().image[90, 20], 180, atol=12)
    finally:
        remove_module("vivid")
        load_module(*VIVID)


def _fetch(camera: V4l2Camera, n_frames: int) -> None:
    """Fetch frames: those that were ready before a failure come first."""
    for _ in range(n_frames):
        camera.next_frame(10)
