"""A stream accounts for every frame, never changes one that is held, and never returns a stale one."""

from __future__ import annotations

import itertools
import threading
import time
import weakref
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from drivers.common.stream import BufferPool, FrameStream
from drivers.common.stream_reader import StreamStatus
from drivers.errors import DeviceError, DeviceTimeoutError, StoppedError
from drivers.frame import Frame, FrameMetadata
from tests.mocks.free_running import FreeRunningCamera


def number_of(frame: Frame) -> int:
    return int(frame.image[0, 0])


def finite(n: int, **options: object) -> FreeRunningCamera:
    camera = FreeRunningCamera(**options)  # type: ignore[arg-type]
    camera.n_frames = n
    camera.deep_ring = n
    return camera


def positions(frames: list[Frame]) -> list[int]:
    """Place of each frame among all that the camera exposed, from dropped counts alone."""
    return list(np.cumsum([1 + frame.metadata.dropped_before for frame in frames]) - 1)


class _Paced(FreeRunningCamera):
    """Exposes at most 16 frames ahead of its reader, who keeps up then, however slow he is."""

    def __init__(self) -> None:
        super().__init__()
        self.n_frames = self.deep_ring = 60
        self.ahead = threading.Semaphore(16)

    def snap_metadata(self, number: int) -> FrameMetadata:
        assert self.ahead.acquire(timeout=60)
        return super().snap_metadata(number)

    def stop_sequence(self) -> None:
        self.ahead.release(60)  # whatever waits there ends
        super().stop_sequence()


def test_a_reader_that_keeps_up_gets_every_frame_once() -> None:
    camera = _Paced()
    stream = FrameStream(camera, 32)
    reader = stream.reader()
    frames = []
    with stream:
        while len(frames) < 60 and (frame := reader.next_frame(60.0)) is not None:
            frames.append(number_of(frame))
            camera.ahead.release()
        assert reader.next_frame(0.01) is None
        status = reader.status
    assert frames == list(range(60))
    assert (status.acquired, status.delivered, status.overwritten, status.waiting) == (60, 60, 0, 0)
    assert not camera.is_streaming


@pytest.mark.parametrize("drop", [set(), {0}, {3, 4, 5, 20}, set(range(10, 40))])
def test_a_slow_reader_knows_exactly_what_it_missed(drop: set[int]) -> None:
    camera = finite(60)
    camera.drop = drop
    stream = FrameStream(camera, 4)
    reader = stream.reader()
    with stream:
        frames = []
        while (frame := reader.next_frame(0.5)) is not None:
            time.sleep(0.03)
            frames.append(Frame(frame.image.copy(), frame.metadata))
            status = reader.status
            assert status.acquired == status.delivered + status.overwritten + status.waiting
        status = reader.status
    assert positions(frames) == [number_of(frame) for frame in frames]
    assert status.overwritten > 0
    assert status.acquired + status.dropped_by_device == 60
    assert status.dropped_by_device == len(drop)
    assert status.delivered == len(frames)


def test_readers_keep_their_own_account() -> None:
    camera = finite(40)
    stream = FrameStream(camera, 16)
    slow, fast = stream.reader(), stream.reader()
    with stream:
        seen = 0
        while fast.next_frame(0.5) is not None:
            seen += 1
        assert fast.status.delivered == seen == 40
        assert slow.status.delivered == 0
        assert slow.status.overwritten + slow.status.waiting == 40
        first = slow.next_frame()
        assert first is not None
        assert first.metadata.dropped_before == slow.status.overwritten == number_of(first)


def test_a_frame_that_is_held_never_changes_and_starves_only_the_stream() -> None:
    camera = finite(40)
    held: list[Frame] = []
    stream = FrameStream(camera, 4)
    reader = stream.reader()
    with stream:
        while reader.status.acquired < 40 or reader.status.waiting:
            held += [frame for frame in (reader.next_frame(0.5),) if frame is not None]
        status = reader.status
    numbers = [number_of(frame) for frame in held]
    assert len(held) == len(set(numbers)) < 40
    assert all(np.all(frame.image == frame.image[0, 0]) for frame in held)
    assert positions(held) == numbers
    assert status.acquired == 40
    assert status.overwritten == 40 - len(held)


def test_frames_that_are_held_take_old_ones_from_the_ring_not_new_ones() -> None:
    camera = _Paced()
    stream = FrameStream(camera, 4)
    reader = stream.reader()
    with stream:
        held = [frame for frame in (reader.next_frame(60.0) for _ in range(4)) if frame is not None]
        for _ in range(40):
            camera.ahead.release()
        seen = held[-1]
        while number_of(seen) < 45:
            newer = stream.wait_newer(seen, 10.0)
            assert newer is not None
            seen = newer
    assert [number_of(frame) for frame in held] == sorted({number_of(frame) for frame in held})


def test_the_ring_holds_as_many_frames_as_it_was_asked_to() -> None:
    camera = finite(10)
    stream = FrameStream(camera, 4)
    with stream:
        while stream.acquired < 10:
            time.sleep(0.001)
        assert len(stream.ring) == 4


def test_going_through_a_streams_frames_starts_and_ends_it() -> None:
    camera = finite(5)
    seen = []
    for frame in FrameStream(camera, 8):
        seen.append(number_of(frame))
        if len(seen) == 3:
            break
    assert seen == [0, 1, 2]
    assert not camera.is_streaming


def test_a_stream_is_started_once() -> None:
    with FrameStream(finite(3)) as stream, pytest.raises(DeviceError, match="started before"):
        stream.start()


def test_a_newer_frame_is_not_waited_for_longer_than_it_takes() -> None:
    with FrameStream(finite(2)) as stream:
        began_s = time.monotonic()
        assert stream.wait_newer(None, 60.0) is not None
        assert time.monotonic() - began_s < 50


def test_part_of_a_frame_keeps_its_buffer() -> None:
    pool = BufferPool(1, (4, 4), np.uint16)
    image = pool.take()
    assert image is not None
    part = image[1:][:, 1:].T
    del image
    assert pool.take() is None
    del part
    assert pool.n_free == 1
    again = pool.take()
    assert again is not None
    again[:] = 7


def test_memory_is_that_of_the_ring_however_long_it_runs() -> None:
    camera = finite(100, period_s=0.001)
    addresses = set()
    with FrameStream(camera, 5) as stream:
        reader = stream.reader()
        thread = stream._thread
        assert reader.missed == (0, 0)
        while (frame := reader.next_frame(0.5)) is not None:
            addresses.add(frame.image.ctypes.data)
            assert len(stream.ring) <= 5
    assert len(addresses) <= 7
    assert thread is not None
    assert not thread.is_alive()


def test_a_closed_stream_holds_no_buffers_whoever_keeps_it_or_its_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    buffers: list[weakref.ref[object]] = []

    class Watched(BufferPool):
        def __init__(self, n_buffers: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
            super().__init__(n_buffers, shape, dtype)
            buffers.extend(weakref.ref(memory) for memory in self._memory)

    monkeypatch.setattr("drivers.common.stream.BufferPool", Watched)
    camera = FreeRunningCamera()
    camera.fail_at = 12
    stream = FrameStream(camera, 32)
    reader = stream.reader()
    with stream:
        kept = reader.next_frame(5)
        assert kept is not None
        with pytest.raises(DeviceError, match="unplugged") as error:
            list(iter(lambda: reader.next_frame(5), None))
    assert number_of(kept) == 0
    assert error.value is stream.error
    assert len(buffers) == 34
    # That of the frame kept, and the one that was being filled, which the traceback holds.
    assert sum(buffer() is not None for buffer in buffers) <= 2
    assert stream.newest() is None


def test_frames_are_read_only() -> None:
    with FrameStream(FreeRunningCamera()) as stream:
        frame = stream.reader().next_frame(5)
        assert frame is not None
        with pytest.raises(ValueError, match="read-only"):
            frame.image[0, 0] = 1


def test_the_newest_frame_is_there_at_once_and_newer_ones_can_be_waited_for() -> None:
    with FrameStream(FreeRunningCamera()) as stream:
        first = stream.wait_newer(None, 5)
        assert first is not None
        second = stream.wait_newer(first, 5)
        assert second is not None
        assert number_of(second) > number_of(first)
        newest = stream.newest()
        assert newest is not None
        assert number_of(newest) >= number_of(second)
        assert stream.wait_newer(newest, 0.0) in (None, stream.newest())


def test_iterating_starts_the_camera_and_leaving_the_loop_stops_it() -> None:
    camera = FreeRunningCamera()
    for count, frame in enumerate(camera.stream()):
        assert frame.image.shape == camera.image_shape
        if count == 5:
            break
    deadline = time.monotonic() + 5
    while camera.is_streaming and time.monotonic() < deadline:
        time.sleep(0.001)
    assert not camera.is_streaming


def test_a_slow_callback_holds_nobody_up() -> None:
    camera = finite(60)
    release, entered = threading.Event(), threading.Event()

    def slow(_: Frame) -> None:
        entered.set()
        assert release.wait(10)

    seen: list[int] = []
    stream = FrameStream(camera, 32)
    reader = stream.reader()
    with stream:
        stuck = stream.subscribe(slow)
        stream.subscribe(lambda frame: seen.append(number_of(frame)), newest_only=True)
        assert entered.wait(5)
        count = 0
        while reader.next_frame(0.5) is not None:
            count += 1
        assert count == 60
        assert stuck.status.delivered == 1
        release.set()
    assert seen == sorted(seen)
    assert seen[-1] == 59


def test_what_a_callback_raises_is_raised_on_leaving() -> None:
    def fails(_: Frame) -> None:
        raise RuntimeError("broken callback")

    stream = FrameStream(FreeRunningCamera()).start()
    subscription = stream.subscribe(fails)
    subscription.join()
    with pytest.raises(RuntimeError, match="broken callback"):
        stream.close()
    assert not stream.camera.is_streaming


def test_a_camera_that_fails_gives_its_frames_first_and_then_its_error() -> None:
    camera = FreeRunningCamera()
    camera.fail_at = 12
    numbers = []
    stream = FrameStream(camera, 32)
    reader = stream.reader()
    with stream, pytest.raises(DeviceError, match="unplugged"):
        numbers.extend(number_of(frame) for frame in iter(lambda: reader.next_frame(5), None))
    assert numbers == list(range(12))


def test_a_camera_that_falls_silent_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.camera.Camera.longest_silence_s", 0.05)
    camera = finite(3)
    with FrameStream(camera) as stream:
        reader = stream.reader()
        with pytest.raises(DeviceTimeoutError):
            list(iter(lambda: reader.next_frame(5), None))


def test_a_camera_that_computes_is_not_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.camera.Camera.longest_silence_s", 0.05)
    camera, computed_s = FreeRunningCamera(), itertools.chain(range(4), itertools.repeat(4))
    asked = list[float]()

    def silent(*_: object) -> None:
        asked.append(1.0)
        time.sleep(0.1)
        raise DeviceTimeoutError(camera.name, "no frame.")

    monkeypatch.setattr(camera, "computed_s", lambda: float(next(computed_s)))
    monkeypatch.setattr(camera, "next_frame_into", silent)
    with (
        FrameStream(camera) as stream,
        pytest.raises(DeviceTimeoutError, match=r"has sent no frame for 0\.1 s"),
    ):
        stream.reader().next_frame(20)
    assert len(asked) == 5


def test_stopping_the_camera_from_elsewhere_ends_the_stream_without_error() -> None:
    camera = FreeRunningCamera()
    with FrameStream(camera) as stream:
        reader = stream.reader()
        assert reader.next_frame(5) is not None
        camera.stop_sequence()
        while reader.next_frame(5) is not None:
            pass
        assert not stream.is_running


@pytest.mark.parametrize("late_s", [0.0, 0.05])
def test_a_fresh_frame_was_exposed_wholly_after_it_was_asked_for(
    late_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the host is slow, so that every frame lay in the driver's buffers, and many were lost."""
    camera = FreeRunningCamera()
    take = camera.next_frame

    asked = threading.Event()

    def slow(timeout_s: float) -> Frame:
        if asked.is_set():  # the driver's buffers fill before it is asked, and are emptied at once after it
            time.sleep(late_s)
            asked.clear()
        return take(timeout_s)

    monkeypatch.setattr(camera, "next_frame", slow)
    with FrameStream(camera, 4) as stream:
        for _ in range(8):
            asked.set()
            time.sleep(late_s)
            exposing = camera.exposing
            assert number_of(stream.fresh()) > exposing
    with pytest.raises(StoppedError):
        stream.fresh()


def test_a_fresh_frame_is_the_first_after_all_that_can_have_been_on_their_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for buffers, in_flight in ((4, 2), (7, 0)):
        camera = FreeRunningCamera()
        monkeypatch.setattr(FreeRunningCamera, "frames_in_flight", in_flight)
        stream = FrameStream(camera, buffers)
        numbers = itertools.count()
        reader = SimpleNamespace(next_frame=lambda _, numbers=numbers: next(numbers))
        monkeypatch.setattr(stream, "reader", lambda reader=reader: reader)
        old = [*range(buffers), *range(in_flight), "the one being exposed"]
        for asked in range(2):
            found: Any = stream.fresh()
            assert found == asked * (len(old) + 1) + len(old)


def test_a_fresh_frame_of_a_silent_camera_is_not_waited_for_forever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("drivers.camera.Camera.longest_silence_s", 0.05)
    with FrameStream(finite(6)) as stream, pytest.raises(DeviceTimeoutError):
        stream.fresh()


def test_a_drivers_mistake_reaches_those_who_read(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = finite(1000)

    def broken(*_: object) -> None:
        raise ValueError("wrong shape")

    for call in ("next_frame_into", "computed_s"):
        monkeypatch.setattr(camera, call, broken)
        with FrameStream(camera, 4) as stream, pytest.raises(DeviceError, match="wrong shape"):
            stream.reader().next_frame(5.0)
        monkeypatch.undo()


def test_a_stream_has_three_buffers_at_least_and_runs_from_its_start_on() -> None:
    with pytest.raises(ValueError, match="at least 3 buffers, not 2"):
        FrameStream(finite(3), 2)
    stream = FrameStream(finite(3), 3)
    assert not stream.is_running
    with stream:
        assert stream.is_running
    assert not stream.is_running


def test_silence_is_counted_from_the_last_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Given up is a camera that was silent for longer than it may be, however often it was asked."""
    camera, now_s, asked = finite(3), [0.0], []
    monkeypatch.setattr("drivers.common.stream.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    monkeypatch.setattr(FreeRunningCamera, "longest_wait_s", 10.0)
    answers = iter([*"..........", "a frame", *"..........", "another", *"..........."])

    def answer(*_: object) -> FrameMetadata:
        asked.append(next(answers))
        if asked[-1] == ".":
            now_s[0] += 1.0
            raise DeviceTimeoutError(camera.name, "no frame.")
        return camera.snap_metadata(0)

    monkeypatch.setattr(camera, "next_frame_into", answer)
    stream = FrameStream(camera, 4)
    reader = stream.reader()
    with stream:
        assert reader.next_frame(20.0) is not None
        assert reader.next_frame(20.0) is not None
        with pytest.raises(DeviceTimeoutError, match=r"no frame for 11\.0 s"):
            reader.next_frame(20.0)
    assert len(asked) == 33
    assert next(answers, None) is None


def test_a_triggered_camera_may_be_silent_for_as_long_as_it_likes(monkeypatch: pytest.MonkeyPatch) -> None:
    camera, now_s = finite(3), [0.0]
    monkeypatch.setattr("drivers.common.stream.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    monkeypatch.setattr(type(camera), "trigger_mode", "software")
    silent = iter(range(50))

    def answer(*_: object) -> FrameMetadata:
        now_s[0] += 10.0
        if next(silent, None) is not None:
            raise DeviceTimeoutError(camera.name, "no frame.")
        return camera.snap_metadata(0)

    monkeypatch.setattr(camera, "next_frame_into", answer)
    stream = FrameStream(camera, 4)
    reader = stream.reader()
    with stream:
        assert reader.next_frame(20.0) is not None


def test_the_end_of_a_stream_is_told_to_who_waits_and_its_thread_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera, asked, threads = finite(3), threading.Event(), []

    def answer(*_: object) -> FrameMetadata:
        threads.append(threading.current_thread())
        asked.set()
        time.sleep(0.3)
        raise StoppedError(camera.name, "stopped.")

    monkeypatch.setattr(camera, "next_frame_into", answer)
    stream = FrameStream(camera, 4)
    found: list[Frame | None] = []
    reader = stream.reader()
    with stream:
        waiting = threading.Thread(target=lambda: found.append(reader.next_frame(60.0)), daemon=True)
        waiting.start()
        assert asked.wait(20)
    (thread,) = threads
    assert not thread.is_alive()
    assert thread.daemon, "it would keep a program that forgets to close its stream"
    waiting.join(20)
    assert found == [None]


def test_a_stream_counts_from_its_first_frame_and_its_last_is_the_newest() -> None:
    camera = finite(9)
    camera.drop = {2, 3}
    stream = FrameStream(camera, 4)
    reader = stream.reader()
    with stream:
        while reader.next_frame(0.5) is not None:
            pass
        newest = stream.newest()
        assert newest is not None
        assert number_of(newest) == 8
        assert stream.wait_newer(newest, 0.0) is None
    assert (stream.acquired, stream.dropped) == (7, 2)


def test_who_waits_for_a_newer_frame_is_told_that_the_camera_failed() -> None:
    camera = FreeRunningCamera()
    camera.fail_at = 3
    stream = FrameStream(camera, 4)

    def watch() -> None:
        seen = None
        while True:
            seen = stream.wait_newer(seen, 20.0)

    with stream, pytest.raises(DeviceError, match="unplugged"):
        watch()


def test_who_comes_late_has_an_account_of_its_own() -> None:
    camera = _Paced()
    camera.drop = {1, 2, 20, 21, 22}
    stream = FrameStream(camera, 32)
    early = stream.reader()
    with stream:
        for _ in range(10):
            assert early.next_frame(60.0) is not None
        while stream.acquired < 14:  # as far as it exposes ahead
            time.sleep(0.001)
        late = stream.reader()
        assert late.status == StreamStatus(0, 0, 0, 0, 0)
        for _ in range(44):
            camera.ahead.release()
        first = late.next_frame(60.0)
        assert first is not None
        assert (number_of(first), first.metadata.dropped_before, late.missed) == (16, 0, (0, 0))
        while stream.acquired < 55:
            time.sleep(0.001)
        late.skip_to_newest()
        assert late.status == StreamStatus(41, 1, 39, 1, 3)
        last = late.next_frame(60.0)
        assert last is not None
        assert (number_of(last), last.metadata.dropped_before, late.missed) == (59, 42, (3, 39))
        late.skip_to_newest()
        assert late.status == StreamStatus(41, 2, 39, 0, 3)


def test_a_subscription_ends_when_it_is_cancelled_and_is_waited_for() -> None:
    stream = FrameStream(FreeRunningCamera(), 4).start()
    entered, seen = threading.Event(), []

    def slow(frame: Frame) -> None:
        seen.append(number_of(frame))
        entered.set()
        time.sleep(0.2)

    subscription = stream.subscribe(slow)
    (thread,) = (thread for thread in threading.enumerate() if thread.name == "stream callback")
    assert entered.wait(20)
    subscription.cancel()
    subscription.join()
    assert not thread.is_alive()
    assert thread.daemon, "it would keep a program that forgets to close its stream"
    assert len(seen) == 1
    stream.close()


@pytest.mark.parametrize("newest_only", [False, True])
def test_a_subscription_gets_every_frame_or_skips_to_the_newest(newest_only: bool) -> None:
    stream = FrameStream(finite(30), 32)
    seen: list[int] = []

    def slow(frame: Frame) -> None:
        seen.append(number_of(frame))
        while stream.acquired < 30:
            time.sleep(0.001)

    with stream:
        subscription = stream.subscribe(slow, newest_only=newest_only)
        while stream.acquired < 30 or subscription.status.waiting:
            time.sleep(0.001)
    assert seen == ([seen[0], 29] if newest_only else list(range(seen[0], 30)))


def test_who_subscribes_to_a_stream_that_does_not_run_is_told() -> None:
    stream = FrameStream(finite(3), 4)
    with pytest.raises(StoppedError, match="Start the stream first"):
        stream.subscribe(lambda _: None)
    with stream:
        stream.subscribe(lambda _: None)
    camera = FreeRunningCamera()
    camera.fail_at = 0
    with FrameStream(camera, 4) as failed:
        while failed.is_running:
            time.sleep(0.001)
        with pytest.raises(DeviceError, match="unplugged"):
            failed.subscribe(lambda _: None)


@pytest.mark.parametrize("error", [None, StoppedError("camera", "was stopped."), ValueError("first")])
def test_a_stream_that_does_not_end_says_so_beside_what_went_wrong_before(
    error: Exception | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = finite(3)
    stream = FrameStream(camera).start()

    def close() -> None:
        raise DeviceError("camera", "does not stop.")

    def leave() -> None:
        with stream:
            if error is not None:
                raise error

    with monkeypatch.context() as stuck:
        stuck.setattr(stream, "close", close)
        with pytest.raises((DeviceError, ValueError)) as caught:
            leave()
    if isinstance(error, ValueError):
        assert caught.value is error
        assert "does not stop" in caught.value.__notes__[0]
    else:
        assert "does not stop" in str(caught.value)
    stream.close()
