"""The camera running for somebody to look at: what ends a pause of it, and what is told then."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import pytest

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
