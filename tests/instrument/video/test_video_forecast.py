"""What is told of a film before it: by blocks that were carried out; nothing of them is left."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from instrument.cli import main
from instrument.files.errors import BenchError, FileError
from instrument.reconstruction import video_forecast as module
from instrument.reconstruction.video import PreparedVideo, prepare_video, solve_video, write_shown
from instrument.reconstruction.video_forecast import forecast_video, trial_of
from instrument.reconstruction.video_job import VideoJob
from instrument.reconstruction.video_work import BlockReport
from tests.instrument.video.recorded import request


def report(number: int, worker: str, *frame_s: float) -> BlockReport:
    return BlockReport(number, len(frame_s), len(frame_s), frame_s[-1] + 0.5, 0, frame_s, worker)


def test_a_block_takes_longer_where_it_is_the_first_of_its_worker() -> None:
    reports = [report(0, "a", 5.0, 5.9), report(1, "b", 7.0, 7.9), report(2, "a", 3.0, 3.2)]
    pace = module._one_by_one(reports)
    assert pace(11, True) == pytest.approx(6.0 + 10 * 0.2 + 0.5)
    assert pace(11, False) == pytest.approx(3.0 + 10 * 0.2 + 0.5)
    ended = module._longest(iter([11, 11, 1]), 2, pace)
    assert ended == pytest.approx(pace(11, True) + pace(1, False)), "the third waits for one that is free"
    assert module._Solved(reports, 20.0).beside_s == pytest.approx(20.0 - (6.4 + 3.7)), "a cluster's start"


def test_a_frame_that_takes_longer_once_a_block_stands_for_no_other() -> None:
    pace = module._one_by_one([report(0, "a", 5.0, 5.9), report(1, "a", 3.0, 3.2, 3.8, 4.0)])
    assert pace(11, False) == pytest.approx(3.0 + 10 * 0.2 + 0.5)


def test_frames_solved_together_go_by_their_iterations() -> None:
    pace = module._together([report(0, "a", 1.5, 1.5, 1.5, 1.5)], 1.5)
    assert pace(4, True) == pytest.approx(1.5 * 2.0)
    assert pace(2, True) == pytest.approx(pace(4, True) / 2)


def test_the_first_frames_are_carried_out_and_nothing_is_left(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved: list[list[int]] = []
    true = module.solve_video

    def noted(prepared, *rest):
        solved.append([len(block) for block in prepared.job.blocks])
        return true(prepared, *rest)

    written: list[int] = []
    film = module.write_shown
    monkeypatch.setattr(
        module, "write_shown", lambda made, frames: (written.append(len(frames)), film(made, frames))
    )
    monkeypatch.setattr(module, "solve_video", noted)
    monkeypatch.setattr(module, "FRAMES", 2)
    monkeypatch.setattr(module.MemoryMeter, "peak_mib", lambda _meter: 3.0)  # a warm process may take none
    for asked in ({"block": 3}, {"over_time": "tv", "block": 5}):
        with trial_of(request(recording, tmp_path, **asked)) as trial:
            told = forecast_video(trial)
        assert told is not None
        assert (told.settles, told.each) == (10, "frame"), "of eleven one was lost"
        assert told.seconds > told.beside_s > 0
        assert told.memory_bytes == 3 * 2**20
    assert max(solved[0]) == 2
    assert written == [1, 10, 1, 10], "an encoder is given as many pictures as the film has, up to a number"
    assert solved[1] == [5, 4], "what is solved together is carried out so"
    assert not list(tmp_path.iterdir())


def test_what_solving_freed_is_given_back_before_a_film_is_encoded(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    monkeypatch.setattr("instrument.reconstruction.video.give_back", lambda: order.append("given back"))
    monkeypatch.setattr("instrument.reconstruction.video.write_mp4", lambda *_: order.append("encoded"))
    with trial_of(request(recording, tmp_path, block=3)) as trial:
        write_shown(trial.prepared, trial.prepared.job.plan.frames[:1])
    assert order == ["given back", "encoded"]


def test_of_a_film_that_was_begun_what_is_left_is_told(recording: Path, tmp_path: Path) -> None:
    asked, stop, shares = request(recording, tmp_path, block=3), threading.Event(), list[float]()
    assert not solve_video(prepare_video(asked), lambda _: stop.set(), stop)
    with trial_of(asked) as trial:
        told = forecast_video(trial, on_progress=shares.append)
    assert told is not None
    assert 0 < told.settles == trial.frames_left < 10
    assert {len(block) for block in trial.left} <= {2, 3}, "whole blocks, in one of which a frame was lost"
    assert shares == sorted(shares)
    assert shares[-1] == 1
    with trial_of(asked, force=True) as trial:
        assert trial.frames_left == 10
    stop.clear()
    assert solve_video(prepare_video(asked), lambda _: None, stop)
    with trial_of(asked) as trial:
        told = forecast_video(trial)
    assert told is not None
    assert " a frame" not in str(told), "only the MP4 is left"
    assert VideoJob.folder_of(asked.out).exists()


def test_a_trial_that_lost_a_worker_is_made_again_and_not_counted(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    losing = [1, 0, 1, 1]
    begun: list[int] = []

    def solve(prepared: PreparedVideo, note: Callable[[BlockReport], object], *hooks: object) -> bool:
        *_, on_lost = hooks
        lost = losing.pop(0)
        begun.append(lost)
        if lost:
            on_lost(lost)  # type: ignore[operator]
        return solve_video(prepared, note, threading.Event())

    monkeypatch.setattr(module, "solve_video", solve)
    with trial_of(request(recording, tmp_path)) as trial:
        told = forecast_video(trial)
        assert told is not None
    assert begun == [1, 0]
    with (
        trial_of(request(recording, tmp_path)) as trial,
        pytest.raises(BenchError, match="Workers were lost each time"),
    ):
        forecast_video(trial)
    assert begun == [1, 0, 1, 1]


def test_what_is_wrong_is_said_of_the_film_that_was_asked_for(recording: Path, tmp_path: Path) -> None:
    for out, problem in (
        (tmp_path / "none" / "v.ome.zarr", "its folder .*none does not exist"),
        (tmp_path / "v.mp4", "must end in .ome.zarr"),
        (recording, "must end in .ome.zarr"),
    ):
        wanted = replace(request(recording, tmp_path), out=out)
        with pytest.raises(FileError, match=problem) as found, trial_of(wanted):
            pass
        assert found.value.path == out
        assert ".trial-" not in str(found.value)


def test_the_command_only_says_it(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, psf = tmp_path / "v.ome.zarr", recording.parent / "psf.npy"
    given = ["reconstruct", str(recording), "--video", "--psf", str(psf), "--out", str(out), "--explain"]
    assert main([*given, "--iterations", "3", "--warm", "1", "--dark", "20", "--bin", "1"]) == 0
    said = capsys.readouterr().out
    assert "Will take   about " in said
    assert " ms a frame, 10 of them; " in said
    assert not list(tmp_path.iterdir())
