"""A recording that was cut tells from its folder how much it lacks, in what light and settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from calibration_routines.plan_procedures import left_unfinished
from drivers.errors import DeviceError
from drivers.led_array import LedPattern
from instrument.bench.camera_settings import camera_settings
from instrument.runs.recorder import RecordingStatus, record
from instrument.runs.recording_rest import newest_rest, rest_of
from instrument.runs.run import Run, RunCondition
from tests.instrument.runs.test_recorder import bench_with, camera_of

pytestmark = pytest.mark.usefixtures("mock_drivers")
MOCK = camera_of(1).identity
LIT = LedPattern("two of them", ((3, (0, 255, 0)), (7, (9, 0, 0))))


def cut_recording(
    folder: Path, by: type[BaseException], *, n_frames: int | None = None, seconds: float | None = None
) -> Run:
    """Record until 40 frames are there, in the light of two LEDs, and have something go wrong."""

    def fail(status: RecordingStatus) -> None:
        if status.numbered >= 40:
            raise by

    with bench_with(camera_of(5000)) as bench:
        assert bench.led_array is not None
        bench.led_array.set_pattern(LIT)
        with pytest.raises(by):
            record(bench, folder, n_frames=n_frames, seconds=seconds, label="cells", on_progress=fail)
    return Run.open(next(folder.glob("*cells*")))


def killed(run: Run) -> Run:
    """Make a run as it is after kill -9."""
    state = run.path / "state.json"
    state.write_text(state.read_text().replace('"finished"', '"running"'))
    run = Run.open(run.path)
    assert run.condition is RunCondition.CRASHED
    return run


@pytest.mark.parametrize(
    ("by", "then"), [(OSError, lambda run: run), (OSError, killed), (KeyboardInterrupt, killed)]
)
def test_a_cut_recording_tells_how_many_frames_it_lacks(
    tmp_path: Path, by: type[BaseException], then: Callable[[Run], Run]
) -> None:
    run = then(cut_recording(tmp_path, by, n_frames=4000))
    rest = newest_rest(tmp_path, MOCK)
    assert rest is not None
    assert (rest.run, rest.label, rest.stored) == (run.path, "cells", len(run.records))
    assert (rest.seconds, rest.n_frames) == (None, 4000 - run.n_frames)
    assert rest.lit is not None
    assert rest.lit.pattern == LIT


def test_of_seconds_it_lacks_what_is_after_its_last_frame_and_the_bench_is_set_up_as_it_was(
    tmp_path: Path,
) -> None:
    run = cut_recording(tmp_path, OSError, seconds=60.0)
    rest = rest_of(run.path)
    assert rest is not None
    times = [run.metadata(index).host_time_ns for index in sorted(run.records)]
    assert rest.seconds == pytest.approx(60.0 - (times[-1] - times[0]) / 1e9)
    with bench_with(camera_of(10)) as bench:
        exposure_ms = bench.camera.exposure_ms
        bench.camera.set_exposure_ms(3 * exposure_ms)
        with rest.set_up(bench):
            pass
        assert bench.camera.exposure_ms == exposure_ms
        assert bench.led_array is not None
        assert bench.led_array.pattern == LIT


def test_settings_that_are_refused_half_way_leave_the_camera_as_it_was(tmp_path: Path) -> None:
    rest = rest_of(cut_recording(tmp_path, OSError, seconds=60.0).path)
    assert rest is not None
    wanted = {**rest.camera, "gain": 2.0, "exposure_ms": 1e9}
    with bench_with(camera_of(10)) as bench:
        before = camera_settings(bench.camera)
        assert before["gain"] != 2.0
        with pytest.raises(DeviceError, match="exposure"), replace(rest, camera=wanted).set_up(bench):
            pytest.fail("it is refused")
        assert camera_settings(bench.camera) == before
        assert bench.led_array is not None
        assert bench.led_array.pattern != LIT
        with pytest.raises(OSError, match="disk"), rest.set_up(bench):
            raise OSError("the disk is full")
        assert bench.led_array.pattern != LIT


def test_one_that_was_ended_on_purpose_or_is_of_another_camera_is_not_offered(tmp_path: Path) -> None:
    run = cut_recording(tmp_path, KeyboardInterrupt, n_frames=4000)
    assert run.condition is RunCondition.ABORTED
    assert newest_rest(tmp_path, MOCK) is None
    killed(run)
    assert newest_rest(tmp_path, MOCK) is not None
    assert newest_rest(tmp_path, replace(MOCK, serial_number="008")) is None
    assert newest_rest(tmp_path, replace(MOCK, simulated=False)) is None


def test_one_that_came_to_its_end_lacks_nothing_and_those_before_it_are_not_offered_again(
    tmp_path: Path,
) -> None:
    cut = killed(cut_recording(tmp_path, OSError, n_frames=4000))
    assert left_unfinished(tmp_path, ["plan"]) is None, "a plan in Sweeps is none of recordings"
    with bench_with(camera_of(100)) as bench:
        record(bench, tmp_path, n_frames=5)
    later = tmp_path / "9999-later"
    next(path for path in tmp_path.iterdir() if path != cut.path).rename(later)
    assert rest_of(later) is None
    assert newest_rest(tmp_path, MOCK) is None
    assert newest_rest(tmp_path / "nowhere", MOCK) is None
