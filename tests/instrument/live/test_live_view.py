"""The live view: the newest frame, nothing queued, every frame accounted for, failures told."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.common.stream import FrameStream
from drivers.common.stream_reader import StreamReader
from drivers.errors import DeviceError
from drivers.frame import Frame
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.live.live import LiveResult, LiveView, live_view
from recon import Calibration, InputError
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import LivePicture
from recon.streams.stillness import SceneState
from tests.mocks.free_running import FreeRunningCamera

BENCH = """
[bench]
name = "live"
[camera]
driver = "simulated"
exposure_ms = 5
replay_frames = 4
[scene]
control = "simulated"
[simulated]
preset = "tiny"
"""


class Slow(LiveReconstructor):
    """Takes a time for each picture, and remembers what it was fed."""

    def __init__(self, seconds: float) -> None:
        self.work: Callable[[], object] = lambda: time.sleep(seconds)
        self.warnings = ()
        self.fed: list[int] = []
        self.at_once = threading.Semaphore(1)
        self.refined = 0
        self.settled_after = 3

    def feed(self, image: np.ndarray, *, lit: bool) -> LivePicture:
        assert self.at_once.acquire(blocking=False)
        self.fed.append(int(image[0, 0]))
        self.refined = 0
        self.work()
        self.at_once.release()
        return self._picture(0)

    def refine(self, newer: Any = None) -> LivePicture | None:
        self.refined += 1
        return self._picture(self.refined) if self.refined <= self.settled_after else None

    def _picture(self, total: int) -> LivePicture:
        return LivePicture(
            np.zeros((2, 2), np.float32), 1, "admm", 1, total, SceneState.STILL, 1, False, 1.0, 1.0
        )


def test_the_newest_frame_is_next_and_no_queue_grows() -> None:
    camera = FreeRunningCamera(0.002)
    camera.deep_ring = 1000
    slow = Slow(0.03)
    stream = FrameStream(camera, 3)

    def six_frames() -> None:
        """Take as long as six more frames do, however busy the machine."""
        while stream.ring and int(stream.ring[-1].frame.image[0, 0]) < slow.fed[-1] + 6:
            time.sleep(0.002)

    slow.work = six_frames
    with LiveView(stream, slow) as view:
        seen = None
        for _ in range(8):
            seen = view.wait_newer(seen, 20.0)
        status = view.status
        assert len(stream.ring) <= 3
    gaps = np.diff(slow.fed)
    assert (gaps > 0).all()
    assert np.median(gaps) > 3  # frames in between are passed over ...
    assert status.passed_over > 3 * status.pictures  # ... and counted
    assert slow.fed[-1] <= status.pictures + status.passed_over + 30
    assert status.pictures >= 3
    assert not camera.is_streaming
    assert not view.is_running


def test_latency_stays_bounded_while_the_camera_is_faster() -> None:
    camera = FreeRunningCamera(0.002)
    camera.deep_ring = 1000
    ages: list[float] = []
    with LiveView(FrameStream(camera, 3), Slow(0.02)) as view:
        seen = None
        for _ in range(15):
            seen = view.wait_newer(seen, 5.0)
            assert seen is not None
            ages.append(seen.latency_ms)
    assert np.median(ages[8:]) < 2 * np.median(ages[:8]) + 20


def test_a_picture_is_refined_while_no_newer_frame_comes_then_the_view_rests() -> None:
    camera = FreeRunningCamera(0.002)
    camera.n_frames = 1
    slow = Slow(0.0)
    with LiveView(FrameStream(camera, 3), slow) as view:
        results = []
        seen = None
        while (seen := view.wait_newer(seen, 0.5)) is not None:
            results.append(seen)
    assert results[-1].refined
    assert results[-1].picture.total_iterations == 3
    assert slow.refined == 4


def test_before_the_first_frame_the_view_waits_and_does_not_spin(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = FreeRunningCamera(0.3)
    camera.n_frames = 1
    waits: list[float] = []
    take = StreamReader.next_frame

    def next_frame(self: StreamReader, timeout_s: float) -> Frame | None:
        waits.append(timeout_s)
        return take(self, timeout_s)

    monkeypatch.setattr(StreamReader, "next_frame", next_frame)
    with LiveView(FrameStream(camera, 3), Slow(0.0)) as view:
        assert view._thread is not None
        assert view._thread.daemon, "it would keep a program that forgets to close its view"
        seen = None
        while seen is None or seen.picture.total_iterations < 3 or len(waits) < 6:
            seen = view.wait_newer(seen, 5.0) or seen
    came = waits.index(0.0)
    assert came > 0
    assert min(waits[:came]) > 0
    assert set(waits[came : came + 4]) == {0.0}, "while there is something to refine it does not wait"
    assert min(waits[came + 4 :], default=1.0) > 0


def test_iterating_shows_every_picture_and_ends_with_the_view() -> None:
    camera = FreeRunningCamera(0.002)
    view = LiveView(FrameStream(camera, 3), Slow(0.005))
    for count, result in enumerate(view):
        assert result.metadata.frame_id >= 0
        worker = view._thread
        if count == 3:
            break
    view.close()
    assert not camera.is_streaming
    assert worker is not None
    assert not worker.is_alive()


def test_closing_waits_for_the_picture_in_progress() -> None:
    slow = Slow(0.3)
    view = LiveView(FrameStream(FreeRunningCamera(0.002), 3), slow).start()
    while not slow.fed:
        time.sleep(0.001)
    worker = view._thread
    view.close()
    assert worker is not None
    assert not worker.is_alive()


def test_the_status_is_of_the_last_pictures() -> None:
    view = LiveView(FrameStream(FreeRunningCamera(), 3), Slow(0.0))
    assert np.isnan(view.status.pictures_per_s)
    view._done.extend([(5.0, 1.0), (5.25, 2.0)])
    assert view.status.pictures_per_s == 4.0
    view._done.clear()
    view._done.extend((7 + 0.5 * n, float(n)) for n in range(101))
    status = view.status
    assert (status.pictures_per_s, status.latency_median_ms, status.latency_p99_ms) == (2.0, 50.0, 99.0)


def test_a_running_stream_is_left_running() -> None:
    camera = FreeRunningCamera(0.002)
    with camera.stream(4) as stream:
        with LiveView(stream, Slow(0.0)) as view:
            assert view.wait_newer(None, 5.0) is not None
        assert stream.is_running


def test_a_camera_that_fails_is_told_to_who_waits_and_by_close() -> None:
    camera = FreeRunningCamera(0.002)
    camera.fail_at = 5
    view = LiveView(FrameStream(camera, 3), Slow(0.0)).start()

    def watch() -> None:
        seen = None
        while True:
            seen = view.wait_newer(seen, 5.0) or seen

    with pytest.raises(DeviceError, match="unplugged"):
        watch()
    with pytest.raises(DeviceError, match="unplugged"):
        view.close()


def test_frames_that_do_not_fit_end_the_view_with_the_reason() -> None:
    camera = FreeRunningCamera(0.002)
    calibration = Calibration(
        np.random.default_rng(0).random((1, 1, 32, 32), np.float32), np.full((1, 3), np.nan)
    )
    view = LiveView(FrameStream(camera, 3), LiveReconstructor(calibration)).start()
    with pytest.raises(InputError, match="PSF 32 x 32"):
        view.wait_newer(None, 5.0)
    with pytest.raises(InputError, match="PSF 32 x 32"):
        view.close()


def test_an_error_inside_the_view_keeps_its_place() -> None:
    camera = FreeRunningCamera(0.002)
    camera.fail_at = 1
    mine = RuntimeError("mine")
    view = LiveView(FrameStream(camera, 3), Slow(0.0)).start()
    view.wait_newer(None, 5.0)
    time.sleep(0.1)
    view.__exit__(RuntimeError, mine, None)
    assert any("unplugged" in note for note in mine.__notes__)


def test_a_bench_shows_its_scene_live() -> None:
    with open_bench(parse_config(BENCH, None)) as bench:
        bench.scene_on()
        bench.camera.snap()  # renders what is replayed
        n_axes, shape = len(bench.camera.frame_shape), bench.camera.frame_shape[:2]
        psf = np.zeros(shape, np.float32)
        psf[tuple(n // 2 for n in shape)] = 1.0
        calibration = replace(Calibration(psf[None, None], np.full((1, 3), np.nan)), geometry=bench.geometry)
        with live_view(bench, calibration, budget_ms=50.0) as live:
            result = live.wait_newer(None, 60.0)
    assert result is not None
    assert result.picture.budget_ms == 50.0
    assert result.picture.image.ndim == n_axes


def test_a_picture_is_dated_by_its_frames_arrival_and_the_first_is_in_no_statistics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_ms = [0]
    clock = SimpleNamespace(monotonic_ns=lambda: 1_000_000 * now_ms[0])
    monkeypatch.setattr("instrument.live.live.time", clock)
    slow, camera = Slow(0.0), FreeRunningCamera()
    view = LiveView(FrameStream(camera, 3), slow)
    assert (view.status.pictures, view.status.passed_over, view.is_running) == (0, 0, False)
    frame = Frame(np.zeros((2, 2), np.uint16), replace(camera.snap_metadata(0), host_time_ns=10**9))
    for now, passed_over in ((1900, 4), (1010, 2), (1010, 0), (1035, None), (1060, 1)):
        if now == 1060:
            assert np.isnan(view.status.pictures_per_s), "two at the same moment"
        now_ms[0] = now
        view._publish(slow._picture(0), frame, passed_over)
        result = view.newest()
        assert result is not None
        assert (result.latency_ms, result.passed_over) == (now - 1000, passed_over or 0)
        assert result.refined == (passed_over is None)
    status = view.status
    assert (status.pictures, status.passed_over, status.latency_median_ms) == (4, 7, 10.0)
    assert status.pictures_per_s == pytest.approx(2 / 0.05)
    assert status.latency_p99_ms == pytest.approx(59.0)


def test_a_refinement_gives_way_to_a_frame_that_waits_and_to_the_end() -> None:
    view = LiveView(FrameStream(FreeRunningCamera(), 3), Slow(0.0))
    reader: Any = SimpleNamespace(status=SimpleNamespace(waiting=0))
    view._reader = reader
    assert not view._is_wanted_elsewhere()
    reader.status.waiting = 1
    assert view._is_wanted_elsewhere()
    reader.status.waiting = 0
    view.end()
    assert view._is_wanted_elsewhere()


def test_the_end_of_the_camera_ends_the_pictures_and_is_told_to_who_waits() -> None:
    camera = FreeRunningCamera(0.002)
    camera.n_frames = 1
    slow = Slow(0.0)
    view = LiveView(FrameStream(camera, 3), slow)
    waited: list[Any] = []

    def waits(than: LiveResult) -> None:
        waited.append(view.wait_newer(than, 60.0))

    for result in view:
        if result.refined and result.picture.total_iterations == slow.settled_after:
            waiting = threading.Thread(target=waits, args=(result,), daemon=True)
            waiting.start()
            camera.stop_sequence()
            waiting.join(20)
    assert waited == [None]
    assert not view.is_running
