"""The camera running for somebody to look at: what ends a pause of it, and what is told then."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from drivers.common.stream import FrameStream
from drivers.errors import DeviceError, DeviceLostError
from drivers.frame import Frame
from drivers.simulated.camera import SimulatedCamera
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.live.live_camera import LiveCamera, LiveCameraStatus
from tests.instrument.live.test_live_view import BENCH


def paused(live: LiveCamera, work: Callable[[], object]) -> None:
    with live.paused():
        work()


def test_a_pause_goes_on_and_hides_no_error_where_the_camera_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def lost() -> None:
        raise DeviceLostError("camera", "was unplugged.")

    def refused(*_: Any) -> None:
        raise DeviceError("camera", "does not start.")

    with open_bench(parse_config(BENCH, None)) as bench:
        live = LiveCamera(bench.camera)
        live.start()
        running: list[bool] = []
        paused(live, lambda: running.append(live.is_running))
        assert [*running, live.is_running] == [False, True]
        with pytest.raises(DeviceLostError, match="unplugged"):
            paused(live, lost)
        assert live.is_running
        monkeypatch.setattr(type(bench.camera), "start_sequence", refused)
        with pytest.raises(DeviceLostError, match="unplugged") as caught:
            paused(live, lost)
        assert caught.value.__notes__ == ["camera: does not start."]
        assert not live.is_running
        paused(live, lambda: running.append(live.is_running))  # did not run before: is not started
        live.stop()


def test_frames_are_counted_once_while_their_stream_ends_in_another_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    closing, go_on = threading.Event(), threading.Event()
    close = FrameStream.close

    def slowly(stream: FrameStream) -> None:
        close(stream)
        closing.set()
        go_on.wait(20)

    monkeypatch.setattr(FrameStream, "close", slowly)
    with open_bench(parse_config(BENCH, None)) as bench:
        live = LiveCamera(bench.camera)
        live.start()
        while not live.status().acquired:
            pass
        ending = threading.Thread(target=live.stop)
        ending.start()
        assert closing.wait(20)
        during = live.status()
        go_on.set()
        ending.join()
        after = live.status()
    assert during.acquired == after.acquired > 0
    assert during.frames_per_s >= 0
    assert not during.running
    assert after.frames_per_s == 0


def test_an_end_in_another_thread_does_not_disturb_who_counts() -> None:
    class Ended(deque[tuple[float, int]]):
        def append(self, one: tuple[float, int]) -> None:
            super().append(one)
            ending.start()
            ending.join(0.3)  # as far as it comes meanwhile

    with open_bench(parse_config(BENCH, None)) as bench:
        live = LiveCamera(bench.camera)
        live.start()
        ending = threading.Thread(target=live.stop)
        live._history = Ended([(0.0, 0)] * 5)
        assert live.status().frames_per_s >= 0
        ending.join()
        assert not live._history


def test_rates_are_of_the_last_two_seconds_and_counts_of_all_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr("instrument.live.live_camera.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    live = LiveCamera(None)
    assert live.status() == LiveCameraStatus(running=False, frames_per_s=0.0, acquired=0, dropped=0)
    assert live.newest() is live.stream is live.error is live.coarse() is None
    live._history.clear()
    live._stream = stream = cast(FrameStream, SimpleNamespace(acquired=0, dropped=0, is_running=True))
    rates = []
    for acquired in (0, 10, 20, 60, 100):  # a second each
        stream.acquired, stream.dropped = acquired, acquired // 10
        rates.append(live.status().frames_per_s)
        now_s[0] += 1.0
    assert rates == [0.0, 10.0, 10.0, 25.0, 40.0]
    stream.close = lambda: None  # type: ignore[method-assign]
    live.stop()
    live._stream = cast(FrameStream, SimpleNamespace(acquired=5, dropped=1, is_running=True))
    assert live.status() == LiveCameraStatus(running=True, frames_per_s=0.0, acquired=105, dropped=11)


def test_what_a_run_has_newest_is_shown_while_it_has_the_camera() -> None:
    frame = object()
    live = LiveCamera(None)
    with live.watching(lambda: cast(Frame, frame)):
        assert live.newest() is frame
    assert live.newest() is None


def test_a_simulated_camera_is_asked_for_coarse_light_while_somebody_looks_only() -> None:
    with open_bench(parse_config(BENCH, None)) as bench:
        camera = bench.camera
        assert isinstance(camera, SimulatedCamera)
        camera.coarse = lambda: "coarsely"  # type: ignore[method-assign, assignment, return-value]
        live = LiveCamera(camera)
        assert live.coarse() is None
        live.start()
        live.start()  # does nothing
        assert camera.coarse_first
        assert live.coarse() == "coarsely"
        live.stop()
        assert not camera.coarse_first
        assert live.coarse() is None


def test_a_stream_that_ended_by_itself_is_closed_and_counted_before_the_next() -> None:
    with open_bench(parse_config(BENCH, None)) as bench:
        live, closed = LiveCamera(bench.camera), threading.Event()
        ended = SimpleNamespace(is_running=False, acquired=1000, dropped=3, close=closed.set)
        live._stream = cast(FrameStream, ended)
        live.start()
        assert closed.is_set()
        assert live.status().acquired >= 1000
        assert live.status().dropped == 3
        live.stop()
