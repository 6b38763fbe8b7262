"""What a recorder counts, batches and tells, from a stream that is written out here and without a disk."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from drivers.errors import DeviceError
from drivers.frame import Frame
from instrument.bench.bench import Bench
from instrument.files.atomic import SPARE_BYTES
from instrument.files.errors import BenchError
from instrument.runs import recorder as module
from instrument.runs.log import Gap
from instrument.runs.recorder import Recorder, RecordingOptions, RecordingStatus, prepare_recording, record
from instrument.runs.run_files import RunError
from tests.instrument.runs.test_recorder import bench_with, camera_of
from tests.instrument.runs.test_runner import open_mock_bench
from tests.mocks.free_running import FreeRunningCamera

pytestmark = pytest.mark.usefixtures("mock_drivers")

FRAME_BYTES = 24 * 32 * 2


@pytest.fixture
def bench() -> Iterator[Bench]:
    with open_mock_bench() as bench:
        yield bench


class Stream:
    """Gives what is written in ``parts``: frames by what was missed before each, None for "not there yet"."""

    is_running = True
    status = SimpleNamespace(waiting=3)

    def __init__(self, frame: Frame, *parts: tuple[int, int] | DeviceError | None) -> None:
        self.frame, self.parts = frame, list(parts)
        self.missed, self.number = (0, 0), 0

    def next_frame(self, timeout_s: float) -> Frame | None:
        while self.parts:
            part = self.parts.pop(0)
            if isinstance(part, DeviceError):
                raise part
            if part is None and timeout_s == 0:
                return None
            if part is not None:
                self.missed, self.number = part, self.number + 1
                metadata = replace(self.frame.metadata, saturated_fraction=self.number / 100)
                return Frame(self.frame.image, metadata)
        raise AssertionError("asked for more than there is")


def recorded(
    bench: Bench, *parts: tuple[int, int] | DeviceError | None, **options: Any
) -> tuple[list[Any], list[RecordingStatus]]:
    """Record a stream; returns what was written (gaps, and the numbers of frames) and what was told."""
    writer, told = Mock(path=Path()), list[RecordingStatus]()
    recorder = Recorder(bench, writer, RecordingOptions(**options), told.append)
    reader: Any = Stream(bench.camera.snap(), *parts)
    try:
        recorder._record(reader)
    finally:
        written = [call.args[0] for call in writer.method_calls]
    return [one if isinstance(one, Gap) else [frame.index for frame in one] for one in written], told


def test_lost_frames_keep_their_numbers_and_are_counted_by_who_lost_them(bench: Bench) -> None:
    parts = [(0, 0), (0, 0), (1, 2), None, (2, 0), (2, 4)]
    written, told = recorded(bench, *parts, n_frames=12)
    assert written == [Gap(2, 1, 2), [0, 1, 5], Gap(6, 2, 0), Gap(9, 2, 1), [8]]
    counts = [(s.written, s.numbered, s.dropped_by_device, s.not_written) for s in told]
    assert counts == [(3, 6, 1, 2), (4, 12, 5, 3)]
    assert [s.saturated_fraction for s in told] == [0.03, 0.04]
    assert [s.waiting for s in told] == [3, 3]
    for status in told:
        assert status.frames_per_s == pytest.approx(status.written / status.seconds)
        assert status.bytes_per_s == pytest.approx(FRAME_BYTES * status.frames_per_s)
        assert 0 < status.seconds < 3600
        assert status.free_bytes > 0


def test_time_runs_from_the_first_frame_on_and_is_never_nothing(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    for step_s in (0.0, 1.0):
        ticks = itertools.count(100.0, step_s)
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=ticks.__next__))
        _, told = recorded(bench, (0, 0), None, (0, 0), n_frames=2)
        first, last = (status.seconds for status in told)
        assert (first == last == 1e-9) if step_s == 0 else (1 <= first < last < 20)


def test_a_frame_that_is_late_is_waited_for(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    take, late = Stream.next_frame, [True]
    monkeypatch.setattr(Stream, "next_frame", lambda *given: None if late and late.pop() else take(*given))
    assert recorded(bench, (0, 0), n_frames=1)[0] == [[0]]


def test_a_recording_may_end_with_what_was_lost(bench: Bench) -> None:
    written, told = recorded(bench, (5, 0), n_frames=2)
    assert written == [Gap(0, 2, 0), []]
    assert (told[-1].numbered, told[-1].saturated_fraction) == (2, 0.0)


def test_frames_are_written_together_as_many_as_a_quarter_of_the_buffers(bench: Bench) -> None:
    assert recorded(bench, *[(0, 0)] * 7, n_frames=7, n_buffers=22)[0] == [[0, 1, 2, 3, 4], [5, 6]]
    together = recorded(bench, *[(0, 0)] * 40, n_frames=40, n_buffers=400)[0]
    assert [len(numbers) for numbers in together] == [32, 8]


def test_what_came_before_a_fault_is_written_and_the_fault_is_raised(bench: Bench) -> None:
    writer = Mock(path=Path())
    recorder = Recorder(bench, writer, RecordingOptions(n_frames=9))
    reader: Any = Stream(bench.camera.snap(), (0, 0), (0, 0), DeviceError("camera", "was unplugged."))
    with pytest.raises(DeviceError, match="unplugged"):
        recorder._record(reader)
    assert [len(call.args[0]) for call in writer.write.call_args_list] == [2]


def test_the_first_loss_is_a_warning_and_no_other_is(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, logger="instrument.runs.recorder"):
        recorded(bench, (1, 2), (3, 1), (2, 0), n_frames=12)
    lost = [(r.levelname, r.args) for r in caplog.records if "lost from frame" in r.message]
    assert lost == [("WARNING", (0, 1, 2)), ("DEBUG", (4, 3, 1)), ("DEBUG", (9, 2, 0))]


@pytest.mark.parametrize(
    ("frame_bytes", "n_buffers"), [(FRAME_BYTES, 512), (3 * 2**20, 85), (100 * 2**20, 16)]
)
def test_memory_for_a_slow_disk_is_256_megabytes_within_bounds(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, frame_bytes: int, n_buffers: int
) -> None:
    monkeypatch.setattr(module, "_frame_bytes", lambda _: frame_bytes)
    assert Recorder(bench, Mock(), RecordingOptions()).n_buffers == n_buffers
    assert Recorder(bench, Mock(), RecordingOptions(n_buffers=30)).n_buffers == 30


@pytest.mark.parametrize(("n_frames", "needed"), [(None, 1), (7, 7)])
def test_a_recording_needs_room_for_its_frames_and_some_to_spare(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_frames: int | None, needed: int
) -> None:
    free = [needed * FRAME_BYTES + SPARE_BYTES - 1]
    monkeypatch.setattr(module, "free_bytes", lambda _: free[0])
    options = RecordingOptions(n_frames=n_frames)
    with pytest.raises(BenchError, match="B are free"):
        prepare_recording(bench, tmp_path, options)
    free[0] += 1
    prepare_recording(bench, tmp_path, options)._writer.close()


def test_the_disk_is_looked_at_once_a_second_and_its_last_eighth_of_a_gigabyte_left(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, looks, free = [0.2], [0], SPARE_BYTES // 2

    def free_bytes(_: Path) -> int:
        looks[0] += 1
        return free

    monkeypatch.setattr(module, "free_bytes", free_bytes)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    recorder = Recorder(bench, Mock(path=Path()), RecordingOptions())
    for now_s[0], looked in ((0.2, 1), (1.1, 1), (1.3, 2), (2.2, 2), (2.4, 3)):
        recorder._check_disk()
        assert looks == [looked]
    free, now_s[0] = free - 1, 9.0
    with pytest.raises(RunError, match="nearly full"):
        recorder._check_disk()


def test_a_recording_ends_by_time_by_number_or_when_it_is_told(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: 50.0))

    def ends(began_s: float = 40.0, next_one: int = 5, stopped: bool = False, **options: Any) -> bool:
        recorder = Recorder(bench, Mock(), RecordingOptions(**options))
        recorder._began_s, recorder._next = began_s, next_one
        if stopped:
            recorder.stop()
        return recorder._is_done()

    assert not ends()
    assert ends(stopped=True)
    assert [ends(seconds=s) for s in (9.0, 10.0, 11.0)] == [True, True, False]
    assert not ends(math.inf, seconds=0.5)  # no frame came yet
    assert [ends(n_frames=n) for n in (5, 6)] == [True, False]
    assert ends(seconds=9.0, n_frames=6)


def test_the_newest_frame_is_had_while_the_camera_records_and_options_may_be_given_whole(
    tmp_path: Path,
) -> None:
    seen: list[Frame | None] = []
    with bench_with(camera_of(1000)) as bench:
        recorder = prepare_recording(bench, tmp_path, RecordingOptions(n_frames=4))
        recorder.on_progress = lambda _: seen.append(recorder.newest())
        assert recorder.newest() is None
        run = recorder.execute()
        assert recorder.newest() is None
    assert run.n_frames == 4
    assert seen
    assert None not in seen
    with bench_with(FreeRunningCamera()) as bench:
        assert record(bench, tmp_path, RecordingOptions(n_frames=3)).n_frames == 3
