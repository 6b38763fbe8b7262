"""A recording holds every frame that came, at its own number, and says of every other why it is not there."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zarr
from ome_zarr_models.v05 import Image

from drivers.errors import DeviceError, DeviceLostError
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.files.errors import BenchError
from instrument.runs.recorder import Recorder, RecordingStatus, prepare_recording, record
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_files import RunError
from instrument.runs.writer import FrameToStore, RunWriter
from tests.mocks.devices import MockDevice, MockWorld
from tests.mocks.free_running import FreeRunningCamera

pytestmark = pytest.mark.usefixtures("mock_drivers")


def bench_with(camera: FreeRunningCamera) -> Bench:
    tables = "".join(f'[{kind}]\ndriver = "mock"\n' for kind in ("camera", "stage", "led_array"))
    bench = Bench(parse_config(f'[scene]\ncontrol = "simulated"\n{tables}', None)).open()
    bench.devices = {**bench.devices, "camera": camera}
    return bench


def camera_of(n: int, drop: Sequence[int] = ()) -> FreeRunningCamera:
    camera = FreeRunningCamera()
    camera.n_frames = n
    camera.deep_ring = n
    camera.drop = set(drop)
    return camera


def assert_every_frame_is_at_its_number(run: Run) -> None:
    for index in run.records:
        assert np.all(run.frame(index) == index)
        assert run.metadata(index).frame_id == index
        assert run.verify(index) is None
    lost = [index for gap in run.gaps for index in range(gap.first, gap.first + gap.count)]
    assert sorted([*lost, *run.records]) == list(range(run.n_frames))
    assert run.missing() == lost


def test_a_recording_whose_led_array_is_lost_fails_and_keeps_no_frame_of_after(tmp_path: Path) -> None:
    bench = bench_with(camera_of(1000))
    leds = bench.led_array
    assert isinstance(leds, MockDevice)

    def lose(_: RecordingStatus) -> None:
        leds._open = False

    with pytest.raises(DeviceLostError, match=r"led_array \(mock\): was lost") as caught, bench:
        record(bench, tmp_path, n_frames=400, on_progress=lose)
    assert "The light may be on" in "".join(caught.value.__notes__)
    (path,) = tmp_path.iterdir()
    run = Run.open(path)
    assert run.condition is RunCondition.FAILED
    assert 0 < len(run.records) < 400


def test_frames_dropped_by_the_device_are_gaps(tmp_path: Path) -> None:
    drop = [0, 1, 7, 20, 21, 22]
    with bench_with(camera_of(1000, drop)) as bench:
        run = record(bench, tmp_path, n_frames=40)
    assert run.condition is RunCondition.COMPLETED
    assert run.n_frames == 40
    assert run.missing() == drop
    assert [gap.by_device for gap in run.gaps] == [2, 1, 3]
    assert_every_frame_is_at_its_number(run)
    started = next(event for event in run.events if event["kind"] == "started")
    assert started["drops_counted_by"] == "the driver's own count"


def test_a_gap_at_the_end_does_not_make_the_recording_longer(tmp_path: Path) -> None:
    with bench_with(camera_of(1000, range(8, 30))) as bench:
        run = record(bench, tmp_path, n_frames=10)
    assert run.n_frames == 10
    assert run.missing() == [8, 9]
    assert_every_frame_is_at_its_number(run)


def test_a_disk_that_is_too_slow_is_told_at_once_and_costs_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = RunWriter.write

    def slowly(self: RunWriter, frames: Sequence[FrameToStore]) -> None:
        time.sleep(0.1)
        write(self, frames)

    monkeypatch.setattr(RunWriter, "write", slowly)
    told: list[RecordingStatus] = []
    camera = camera_of(1000, [3])
    with bench_with(camera) as bench:
        run = record(bench, tmp_path, n_frames=250, n_buffers=16, on_progress=told.append)
    assert run.n_frames == 250
    assert_every_frame_is_at_its_number(run)
    not_written = sum(gap.not_written for gap in run.gaps)
    assert not_written > 0
    assert sum(gap.by_device for gap in run.gaps) == 1
    assert told[-1].not_written == not_written
    assert max(status.waiting for status in told) <= 16
    first_loss = next(i for i, status in enumerate(told) if status.not_written)
    assert told[first_loss].written < 120


def test_others_read_a_recording_with_its_frame_period(tmp_path: Path) -> None:
    with bench_with(camera_of(1000)) as bench:
        run = record(bench, tmp_path, n_frames=12)
    image = Image.from_zarr(zarr.open_group(run.path / "frames.ome.zarr", mode="r"))
    multiscale = image.ome_attributes.multiscales[0]
    assert multiscale.axes[0].unit == "second"
    period_s = multiscale.datasets[0].coordinateTransformations[0].scale[0]
    assert period_s == pytest.approx(run.frame_period_s)
    assert period_s > 0  # how near it is to the camera's, the machine's other work decides
    assert run.frames.shape == (12, 24, 32)


def test_recording_for_a_time_and_stopping_from_outside_both_complete(tmp_path: Path) -> None:
    with bench_with(FreeRunningCamera()) as bench:
        run = record(bench, tmp_path, seconds=0.2)
        assert run.reason is FinishReason.COMPLETED
        assert run.records

        def stop(status: RecordingStatus) -> None:
            if status.written >= 5:
                recorder.stop()

        recorder = prepare_recording(bench, tmp_path, on_progress=stop)
        run = recorder.execute()
    assert run.reason is FinishReason.COMPLETED
    assert len(run.records) >= 5


def test_a_recording_for_a_time_ends_then_and_not_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench_with(FreeRunningCamera()) as bench:
        recorder = prepare_recording(bench, tmp_path, seconds=5.0)
    ends = []
    for began_s, now_s in ((math.inf, 90.0), (100.0, 100.0), (100.0, 104.9), (100.0, 105.0), (100.0, 106.0)):
        recorder._began_s = began_s
        monkeypatch.setattr("instrument.runs.recorder.time", SimpleNamespace(monotonic=lambda now=now_s: now))
        ends.append(recorder._is_done())
    assert ends == [False, False, False, True, True]


def test_a_camera_unplugged_keeps_what_was_recorded(tmp_path: Path) -> None:
    camera = camera_of(1000)
    camera.fail_at = 20
    with bench_with(camera) as bench:
        with pytest.raises(DeviceError, match="unplugged") as caught:
            record(bench, tmp_path, n_frames=100)
        world = bench.shared["mock"]
        assert isinstance(world, MockWorld)
        assert "led_array.off" in world.calls
    (path,) = tmp_path.iterdir()
    assert str(path) in str(caught.value.__notes__)
    run = Run.open(path)
    assert run.condition is RunCondition.FAILED
    assert sorted(run.records) == list(range(20))
    assert_every_frame_is_at_its_number(run)


def test_a_camera_unplugged_before_it_begins_leaves_no_run_that_seems_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(_: FreeRunningCamera) -> None:
        raise DeviceLostError("camera", "was unplugged.")

    def unplugged_meanwhile(*args: Any, **known: Any) -> RunWriter:
        writer = create(*args, **known)
        monkeypatch.setattr(FreeRunningCamera, "frame_shape", property(lost))
        return writer

    create = RunWriter.create
    monkeypatch.setattr(RunWriter, "create", unplugged_meanwhile)
    with bench_with(camera_of(1000)) as bench, pytest.raises(DeviceLostError, match="unplugged"):
        record(bench, tmp_path, n_frames=100)
    (path,) = tmp_path.iterdir()
    assert Run.open(path).condition is RunCondition.FAILED


def test_a_disk_that_fills_up_ends_the_recording_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench_with(camera_of(1000)) as bench:
        recorder = prepare_recording(bench, tmp_path, n_frames=100)
        usage = shutil.disk_usage(tmp_path)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
        with pytest.raises(RunError, match="nearly full"):
            recorder.execute()
        with pytest.raises(BenchError, match="only 1 kB are free"):
            prepare_recording(bench, tmp_path, n_frames=100)


def test_ctrl_c_keeps_what_was_recorded_as_aborted(tmp_path: Path) -> None:
    def interrupt(status: RecordingStatus) -> None:
        if status.written >= 3:
            raise KeyboardInterrupt

    with bench_with(camera_of(1000)) as bench, pytest.raises(KeyboardInterrupt):
        record(bench, tmp_path, n_frames=100, on_progress=interrupt)
    (path,) = tmp_path.iterdir()
    run = Run.open(path)
    assert run.condition is RunCondition.ABORTED
    assert_every_frame_is_at_its_number(run)


def test_stop_from_another_thread_ends_a_recording(tmp_path: Path) -> None:
    with bench_with(camera_of(100_000)) as bench:

        def stop(status: RecordingStatus) -> None:
            if status.written >= 3:
                bench.stop()

        run = record(bench, tmp_path, n_frames=90_000, on_progress=stop)
    assert run.condition is RunCondition.STOPPED
    assert_every_frame_is_at_its_number(run)


def test_an_endless_recording_must_be_asked_for(tmp_path: Path) -> None:
    with bench_with(camera_of(10)) as bench, pytest.raises(BenchError, match="how much"):
        record(bench, tmp_path)
    assert Recorder.__doc__
