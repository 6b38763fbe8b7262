"""Buffers that come in a known order: which become frames, what is waited for, what is said of others."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.camera import Roi
from drivers.common.buffered_camera import BufferedCamera, RawFrame
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels
from drivers.errors import DeviceError, DeviceLostError, DeviceNotOpenError, DeviceTimeoutError, LimitError

CAME: Bytes = np.arange(12, dtype=np.uint8)
now_s = [0.0]


@pytest.fixture(autouse=True)
def _clock(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s[0] = 0.0
    clock = SimpleNamespace(monotonic=lambda: now_s[0], monotonic_ns=lambda: int(1e9 * now_s[0]))
    monkeypatch.setattr("drivers.common.buffered_camera.time", clock)


class Queue(BufferedCamera):
    """Gives buffers in turn; where none is left it waits as long as it is told to, by a clock of its own."""

    name = "camera (queue)"
    exposure_limits_ms = (0.0, 1e6)
    trigger_modes = ("free_run", "software", "hardware")
    pixel_format, significant_bits, black_level = "Mono8", 8, 0.0
    _roi = Roi(0, 0, 3, 4)
    _exposure_ms, _gain = 100.0, 1.0
    _period_s = 0.25

    def __init__(self) -> None:
        super().__init__()
        self.connected = False
        self.coming: deque[RawFrame | Callable[[], object]] = deque()
        self.waits: list[float] = []
        self.happened: list[str] = []
        self.numbered = True

    @property
    def _connected(self) -> bool:
        return self.connected

    def _connect(self) -> None:
        self.connected = True

    def _disconnect(self) -> None:
        self.connected = False

    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        self.happened.append(f"begin {n_buffers}")
        return FrameNumberCounter() if self.numbered else None

    def _end(self) -> None:
        self.happened.append("end")

    def _wake(self) -> None:
        self.happened.append("wake")

    def _fire(self) -> None:
        self.happened.append("fire")

    def _take(self, timeout_s: float) -> RawFrame | None:
        self.waits.append(timeout_s)
        if not self.coming:
            now_s[0] += timeout_s
            return None
        what = self.coming.popleft()
        if isinstance(what, RawFrame):
            return what
        what()
        return None

    def _give_back(self, raw: RawFrame) -> None:
        self.happened.append(f"back {raw.number}")

    def _decode(self, data: Bytes, out: Pixels) -> bool:
        out[:] = data.reshape(3, 4)
        return bool(data[0] == 0)

    def _write_exposure(self, exposure_ms: float) -> float:
        if exposure_ms == 13:
            raise DeviceError(self.name, "does not take it.")
        return exposure_ms


Queue.__abstractmethods__ = frozenset()  # settings that nothing is asked of here


def camera(*coming: int | Callable[[], object], damaged: tuple[int, ...] = ()) -> Queue:
    """Return an open camera that sends frames of these numbers."""
    made: Queue = Queue()  # type: ignore[abstract]
    made.open()
    for what in coming:
        if isinstance(what, int):
            what = RawFrame(CAME + (what in damaged), what, None, complete=True, buffer=None)
        made.coming.append(what)
    return made


def test_a_snap_waits_as_long_as_powering_up_and_skipped_frames_may_take(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    queue = camera(7, 8, 9)
    assert queue.longest_wait_s == 3.0 + 3 * 0.25
    monkeypatch.setattr(Queue, "frames_to_skip", 2)
    assert queue.longest_wait_s == 3.0 + 5 * 0.25
    queue.set_exposure_ms(1000.0)
    assert queue.longest_wait_s == 3.0 + 5 * 1.0
    monkeypatch.setattr(Queue, "longest_silence_s", 6.0)
    assert queue.longest_wait_s == 6.0 + 5 * 1.0
    now_s[0] = 100.0
    frame = queue.snap()
    assert not queue.coming
    assert queue.waits == [11.0] * 3
    assert (frame.metadata.frame_id, frame.metadata.dropped_before) == (0, 0)
    np.testing.assert_array_equal(frame.image, CAME.reshape(3, 4))
    assert queue.happened == ["begin 4", "back 7", "back 8", "back 9", "wake", "end"]
    with pytest.raises(DeviceTimeoutError, match="no frame within 11 s"):
        queue.snap()
    assert queue.waits[3:] == [11.0], "what is over is over"


def test_a_snap_on_a_trigger_fires_it_once_and_skips_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Queue, "frames_to_skip", 2)
    queue = camera(4, 5)
    queue.set_trigger_mode("software")
    queue.snap()
    assert queue.happened == ["begin 4", "fire", "back 4", "wake", "end"]


def test_a_snap_is_no_sequence_and_numbers_that_do_not_rise_are_nothing_to_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Queue, "frames_to_skip", 4)
    streaming = []
    queue = camera(5, 5, 5, 5, lambda: streaming.append(queue.is_streaming), 5)
    queue.snap()
    assert streaming == [False]
    queue.start_sequence(1)
    assert queue.is_streaming
    with pytest.raises(DeviceError, match="no new frame now"):
        queue.snap()
    assert queue.is_streaming
    queue.close()
    with pytest.raises(DeviceNotOpenError):
        queue.trigger()


def test_a_sequence_needs_a_buffer_and_its_frames_go_where_they_fit() -> None:
    queue = camera(1, 2)
    with pytest.raises(LimitError, match="into 0 buffers"):
        queue.start_sequence(0)
    queue.start_sequence(1)
    for wrong in (np.empty((3, 4), np.uint16), np.empty((4, 3), np.uint8)):
        with pytest.raises(DeviceError, match=r"sends frames uint8 \(3, 4\)"):
            queue.next_frame_into(wrong, 1.0)
    fits = np.empty((3, 4), np.uint8)
    assert queue.next_frame_into(fits, 1.0).dropped_before == 0
    np.testing.assert_array_equal(fits, CAME.reshape(3, 4))


def test_damaged_frames_count_as_lost_and_are_told_when_nothing_comes() -> None:
    queue = camera(3, 4, 6, 7, 8, damaged=(3, 7))
    queue.start_sequence()
    first = queue.next_frame(2.0)
    assert (first.metadata.frame_id, first.metadata.dropped_before) == (1, 1)
    second = queue.next_frame(2.0)
    assert (second.metadata.frame_id, second.metadata.dropped_before) == (3, 1)
    third = queue.next_frame(2.0)
    assert (third.metadata.frame_id, third.metadata.dropped_before) == (5, 1)
    assert queue.incomplete_frames == 2
    with pytest.raises(DeviceTimeoutError) as silence:
        queue.next_frame(2.0)
    assert " 2 frames came damaged" in str(silence.value)
    assert "pulses" not in str(silence.value)
    queue.stop_sequence()
    queue.set_trigger_mode("hardware")
    queue.start_sequence()
    with pytest.raises(DeviceTimeoutError, match="Do trigger pulses come") as silence:
        queue.next_frame(2.0)
    assert "damaged" not in str(silence.value)


def test_after_a_damaged_frame_no_more_is_waited_for_than_is_left() -> None:
    def later() -> None:
        now_s[0] += 0.75

    queue = camera(later)
    queue.start_sequence()
    with pytest.raises(DeviceTimeoutError):
        queue.next_frame(1.0)
    assert queue.waits == [1.0, 0.25]


def test_numbers_that_do_not_rise_are_borne_twice_in_a_row() -> None:
    queue = camera(1, 1, 1, 2, 2, 2, 2)
    queue.start_sequence()
    assert [queue.next_frame(1.0).metadata.dropped_before for _ in range(6)] == [0] * 6
    with pytest.raises(DeviceError, match="does not number its frames"):
        queue.next_frame(1.0)
    assert not queue.is_streaming


def test_frames_that_are_asked_for_one_by_one_are_not_counted() -> None:
    queue = camera(5, 9)
    queue.numbered = False
    queue.start_sequence()
    assert [queue.next_frame(1.0).metadata.dropped_before for _ in range(2)] == [0, 0]


def test_a_device_that_is_lost_stays_lost_until_it_is_opened_and_its_settings_come_back() -> None:
    def gone() -> None:
        raise DeviceLostError(queue.name, "was unplugged.", "Plug it in.")

    queue = camera(1, gone)
    queue.set_exposure_ms(20.0)
    queue.start_sequence()
    queue.next_frame(1.0)
    for call in (lambda: queue.next_frame(1.0), queue.snap, lambda: queue.gain, queue.trigger):
        with pytest.raises(DeviceLostError, match="unplugged"):
            call()
    assert not queue.is_open
    assert queue.happened.count("end") == 1
    queue.open()
    assert queue.exposure_ms == 20.0
    queue.close()
    queue._remembered["exposure_ms"] = lambda: queue.set_exposure_ms(13)
    with pytest.raises(DeviceError, match="does not take it"):
        queue.open()
    assert not queue.connected


def test_a_wait_that_closing_ends_says_so() -> None:
    queue = camera(lambda: queue.close())  # as another thread may
    queue.start_sequence()
    with pytest.raises(DeviceNotOpenError):
        queue.next_frame(1.0)
    idle: Any = camera()
    with pytest.raises(DeviceError, match="no sequence runs"):
        idle.next_frame(1.0)


def test_pixels_at_full_scale_are_counted_as_saturated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Queue, "significant_bits", 3)
    assert camera(1).snap().metadata.saturated_fraction == 5 / 12  # 7 to 11 of 0 to 11


def test_a_software_trigger_is_fired_in_a_sequence_that_waits_for_it_alone() -> None:
    queue = camera()
    for mode, streams in ("software", False), ("free_run", True), ("hardware", True):
        queue._trigger_mode = mode  # type: ignore[assignment]
        if streams:
            queue.start_sequence(4)
        with pytest.raises(DeviceError, match="takes no software trigger now"):
            queue.trigger()
        queue.stop_sequence()
    queue._trigger_mode = "software"
    queue.start_sequence(4)
    queue.trigger()
    assert queue.happened.count("fire") == 1


def test_a_sequence_that_does_not_begin_is_ended_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def begin(*_: object) -> None:
        raise DeviceError("camera", "has no memory.")

    queue = camera()
    monkeypatch.setattr(queue, "_begin", begin)
    with pytest.raises(DeviceError, match="has no memory"):
        queue.start_sequence(4)
    assert queue.happened == ["end"]
    assert not queue.is_streaming
