"""The camera running for somebody to look at: what ends a pause of it, and what is told then."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import pytest

from drivers.common.stream import FrameStream
from drivers.errors import DeviceError, DeviceLostError
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.live.live_camera import LiveCamera
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
