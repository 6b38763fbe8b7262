"""What every camera must do."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from datetime import UTC

import numpy as np
import pytest

from drivers.camera import Camera, Roi
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.testing.device import DeviceContract

PATIENCE_S = 30.0


class CameraContract(DeviceContract):
    """Tests for every camera; ``make`` gives a closed one."""

    kind = "camera"

    @pytest.fixture
    def camera(self) -> Iterator[Camera]:
        device = self.make()
        assert isinstance(device, Camera)
        with device:
            device.set_exposure_ms(max(device.exposure_limits_ms[0], 1.0))
            yield device

    # Frames ---
    def test_a_frame_says_how_it_was_taken(self, camera: Camera) -> None:
        exposure_ms = camera.set_exposure_ms(camera.exposure_limits_ms[0] * 2)
        before = time.monotonic_ns()
        frame = camera.snap()
        assert frame.image.shape[:2] == camera.image_shape
        assert not frame.image.flags.writeable
        assert frame.image.max() <= frame.full_scale
        metadata = frame.metadata
        assert metadata.exposure_ms == exposure_ms
        assert metadata.gain == camera.gain
        assert metadata.pixel_format == camera.pixel_format
        assert metadata.significant_bits == camera.significant_bits
        assert metadata.roi == camera.roi.as_tuple()
        assert metadata.binning == camera.binning
        assert before <= metadata.host_time_ns <= time.monotonic_ns()
        assert metadata.utc.tzinfo is UTC
        expected = float((frame.image == frame.full_scale).mean())
        assert metadata.saturated_fraction == pytest.approx(expected)

    def test_frames_are_numbered(self, camera: Camera) -> None:
        ids = [camera.snap().metadata.frame_id for _ in range(3)]
        assert ids == list(range(ids[0], ids[0] + 3))

    # Settings ---
    def test_exposure_is_read_back_and_limited(self, camera: Camera) -> None:
        low, high = camera.exposure_limits_ms
        set_to = camera.set_exposure_ms(low * 3)
        assert set_to == camera.exposure_ms == pytest.approx(low * 3, rel=0.05)
        for wrong in (low / 10, high * 10, float("nan")):
            with pytest.raises(LimitError, match="expos"):
                camera.set_exposure_ms(wrong)
            assert camera.exposure_ms == set_to

    def test_gain_is_read_back_and_limited(self, camera: Camera) -> None:
        low, high = camera.gain_limits
        assert low <= camera.gain <= high
        assert camera.set_gain(high) == camera.gain == pytest.approx(high, rel=0.01)
        with pytest.raises(LimitError, match="gain"):
            camera.set_gain(high * 2)
        assert camera.gain == pytest.approx(high, rel=0.01)

    def test_black_level_is_read_back(self, camera: Camera) -> None:
        try:
            level = camera.set_black_level(0)
        except LimitError:  # of a sensor that has one offset and keeps it
            assert camera.set_black_level(camera.black_level) == camera.black_level > 0
        else:
            assert level == camera.black_level == pytest.approx(0, abs=1)
        with pytest.raises(LimitError, match="black level"):
            camera.set_black_level(-1)

    def test_every_pixel_format_gives_its_frames(self, camera: Camera) -> None:
        for pixel_format in camera.pixel_formats:
            assert camera.set_pixel_format(pixel_format) == camera.pixel_format == pixel_format
            frame = camera.snap()
            assert frame.metadata.pixel_format == pixel_format
            assert frame.image.dtype == (np.uint8 if camera.significant_bits <= 8 else np.uint16)
        with pytest.raises(LimitError, match="pixel format"):
            camera.set_pixel_format("Mono99")

    def test_every_binning_gives_its_frames(self, camera: Camera) -> None:
        height, width = camera.sensor_shape
        for binning in camera.binnings:
            assert camera.set_binning(binning) == camera.binning == binning
            assert camera.image_shape == (height // binning, width // binning)
            assert camera.snap().image.shape[:2] == camera.image_shape
        with pytest.raises(LimitError, match="binning"):
            camera.set_binning(97)

    def test_region_is_read_back_and_limited(self, camera: Camera) -> None:
        height, width = camera.sensor_shape
        asked = Roi(height // 4, width // 4, height // 2, width // 2)
        roi = camera.set_roi(asked)
        assert roi == camera.roi
        assert roi.top >= asked.top
        assert roi.left >= asked.left
        assert roi.top + roi.height <= asked.top + asked.height
        assert roi.left + roi.width <= asked.left + asked.width
        assert camera.snap().image.shape[:2] == camera.image_shape
        for wrong in (Roi(0, 0, height + 4, width), Roi(-4, 0, 8, 8), Roi(0, 0, 0, 0)):
            with pytest.raises(LimitError):
                camera.set_roi(wrong)
            assert camera.roi == roi
        assert camera.set_roi(None) == Roi(0, 0, height, width)

    # Sequences ---
    def test_a_sequence_delivers_frames_in_order(self, camera: Camera) -> None:
        camera.start_sequence(n_buffers=4)
        assert camera.is_streaming
        last = None
        for _ in range(6):
            metadata = camera.next_frame(PATIENCE_S).metadata
            if last is not None:
                assert metadata.frame_id == last + 1 + metadata.dropped_before
            last = metadata.frame_id
        camera.stop_sequence()
        assert not camera.is_streaming
        camera.stop_sequence()

    def test_lost_frames_are_counted(self, camera: Camera) -> None:
        camera.start_sequence(n_buffers=2)
        first = camera.next_frame(PATIENCE_S).metadata
        # Let the ring overflow: nothing is fetched for many frames' time.
        deadline, pause_s = time.monotonic() + PATIENCE_S, 0.2
        while time.monotonic() < deadline:
            time.sleep(pause_s)
            pause_s *= 1.5  # a busy machine makes frames slowly
            metadata = camera.next_frame(PATIENCE_S).metadata
            assert metadata.frame_id == first.frame_id + 1 + metadata.dropped_before
            if metadata.dropped_before:
                break
            first = metadata
        assert metadata.dropped_before > 0
        camera.stop_sequence()

    def test_settings_of_the_image_are_fixed_while_streaming(self, camera: Camera) -> None:
        camera.start_sequence()
        with pytest.raises(DeviceError, match="stream"):
            camera.set_binning(camera.binnings[0])
        with pytest.raises(DeviceError, match="stream"):
            camera.set_roi(None)
        with pytest.raises(DeviceError, match="stream"):
            camera.start_sequence()
        camera.set_exposure_ms(camera.exposure_limits_ms[0])
        camera.stop_sequence()

    def test_a_stopped_sequence_has_no_next_frame(self, camera: Camera) -> None:
        camera.start_sequence()
        camera.next_frame(PATIENCE_S)
        camera.stop_sequence()
        # What was in the ring may still be fetched, nothing new comes.
        fetched = 0
        while fetched <= 8:
            try:
                camera.next_frame(1.0)
            except DeviceError:
                break
            fetched += 1
        assert fetched <= 8
        camera.snap()

    def test_waiting_for_a_frame_ends_when_the_sequence_is_stopped(self, camera: Camera) -> None:
        if "software" in camera.trigger_modes:
            camera.set_trigger_mode("software")
        else:
            camera.set_exposure_ms(min(1000.0, camera.exposure_limits_ms[1]))
        camera.start_sequence()
        stopper = threading.Timer(0.1, camera.stop_sequence)
        stopper.start()
        with pytest.raises(StoppedError):
            camera.next_frame(PATIENCE_S)
        stopper.join()

    def test_closing_ends_a_sequence(self, camera: Camera) -> None:
        camera.start_sequence()
        camera.close()
        assert not camera.is_streaming

    # Triggers ---
    def test_trigger_modes_that_are_not_there_are_refused(self, camera: Camera) -> None:
        assert "free_run" in camera.trigger_modes
        for mode in {"software", "hardware"} - set(camera.trigger_modes):
            with pytest.raises(LimitError, match="trigger mode"):
                camera.set_trigger_mode(mode)  # type: ignore[arg-type]
            assert camera.trigger_mode == "free_run"

    def test_a_trigger_line_and_edge_are_kept_and_others_refused(self, camera: Camera) -> None:
        for line in camera.trigger_lines:
            assert camera.set_trigger_line(line) == camera.trigger_line == line
        for edge in camera.trigger_edges:
            assert camera.set_trigger_edge(edge) == camera.trigger_edge == edge
        with pytest.raises(LimitError, match="trigger line"):
            camera.set_trigger_line("none such")
        if "rising" not in camera.trigger_edges:
            with pytest.raises(LimitError, match="trigger edge"):
                camera.set_trigger_edge("rising")
        assert camera.readout_ms >= 0

    def test_a_software_trigger_gives_one_frame(self, camera: Camera) -> None:
        if "software" not in camera.trigger_modes:
            pytest.skip("a camera without software trigger")
        assert camera.set_trigger_mode("software") == camera.trigger_mode == "software"
        camera.start_sequence()
        with pytest.raises(DeviceTimeoutError):
            camera.next_frame(0.1)
        camera.trigger()
        camera.next_frame(PATIENCE_S)
        with pytest.raises(DeviceTimeoutError):
            camera.next_frame(0.1)
        camera.stop_sequence()

    def test_a_trigger_without_a_sequence_is_refused(self, camera: Camera) -> None:
        with pytest.raises(DeviceError, match="trigger"):
            camera.trigger()
