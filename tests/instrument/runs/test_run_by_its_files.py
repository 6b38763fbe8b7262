"""A run as its files tell it: its period, its start, who holds it, what is damaged, and how it ended."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from instrument.files.calibration_file import CALIBRATION_FILES, save_calibration
from instrument.files.errors import FileError
from instrument.files.images import write_image
from instrument.runs.export import _told, export
from instrument.runs.inspection import verify
from instrument.runs.log import Gap
from instrument.runs.recording_rest import rest_of
from instrument.runs.repair import file_problems
from instrument.runs.results import result_problems
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import RunError, RunFiles, log_size, refuse_own_files, refuse_within
from instrument.runs.writer import RunWriter
from recon.types import Calibration
from tests.instrument.files.test_atomic import open_below
from tests.instrument.runs.test_store import BENCH, frame, new_run, plan


def recorded(folder: Path, *indices: int) -> Path:
    """Return a recording of frames 20 ms apart, by its own clock; the others were lost."""
    with RunWriter.create(folder, label="r", bench=BENCH) as writer:
        writer.start()
        done = 0
        for index in indices:
            if index > done:
                writer.gap(Gap(done, index - done, 0))
            one = frame(index)
            times = {"host_time_ns": 7 * index, "device_time_ns": 20_000_000 * index}
            writer.write([replace(one, metadata=replace(one.metadata, **times))])
            done = index + 1
        return writer.finish(FinishReason.COMPLETED).path


def test_a_recordings_period_counts_lost_frames_from_whatever_its_first_is(tmp_path: Path) -> None:
    assert Run.open(recorded(tmp_path, 2, 3, 7)).frame_period_s == pytest.approx(0.02)


def test_frames_that_were_lost_at_the_end_have_their_place(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as writer:
        writer.write([frame(0)])
        writer.gap(Gap(1, 2, 0))
        run = writer.finish(FinishReason.COMPLETED)
    assert (run.n_frames, run.missing(), run.array.n_frames) == (3, [1, 2], 3)


def test_a_run_starts_before_its_first_step_with_what_the_bench_had(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        start = Run.open(writer.path).start
    assert (start.index, start.repeat, start.label) == (-1, 0, "start")
    assert (start.exposure_ms, start.gain) == (1.0, 1.0)


@pytest.mark.parametrize("held", ["folder", "lock"])
def test_a_run_is_held_by_its_folder_or_by_its_lock(
    tmp_path: Path, held: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded(tmp_path, 0)
    locked = {"folder": path, "lock": path / "lock"}[held]
    assert not Run.open(path).is_locked()
    monkeypatch.setattr("instrument.runs.run.is_locked", lambda place: place == locked)
    assert Run.open(path).is_locked()


def test_a_look_at_sizes_reads_what_was_noted_as_damaged_and_no_more(tmp_path: Path) -> None:
    path = recorded(tmp_path, 0, 1, 2)
    chunk = Run.open(path).array.chunk_path(1)
    whole = chunk.read_bytes()
    chunk.write_bytes(bytes(len(whole)))
    assert Run.open(path).damaged(read=False) == ()
    with pytest.raises(RunError, match="frame 1 is damaged: its file has the CRC-32"):
        Run.open(path).frame(1)
    done: list[tuple[int, int]] = []
    assert [one.index for one in Run.open(path).damaged(lambda *n: done.append(n))] == [1]
    assert done == [(1, 3), (2, 3), (3, 3)]
    assert [one.index for one in Run.open(path).damaged(read=False, noted=[1, 2])] == [1]
    chunk.write_bytes(whole[:-1])
    assert [one.index for one in Run.open(path).damaged(read=False)] == [1], "its size tells"
    assert [one.index for one in verify(Run.open(path), read=False).damaged] == [1]
    assert not (path / "damaged.json").exists(), "what reading finds is noted"
    verify(Run.open(path))
    assert (path / "damaged.json").exists()


def test_a_kept_text_has_its_copy_in_the_log(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.keep_text("more.json", '{"a": 1}')
        path = writer.path
    (path / "more.json").unlink()
    problems = [str(problem) for problem in Run.open(path).files.problems()]
    assert problems == ["more.json: is gone"]
    assert Run.open(path).files.copies["more.json"] == '{"a": 1}'
    (path / "more.json").write_text('{"a": 2}')  # put right by hand
    assert Run.open(path).files.problems() == []
    (path / "more.json").write_text("{")
    assert [str(problem) for problem in Run.open(path).files.problems()] == [
        "more.json: is not as it was written"
    ]


def test_who_finishes_a_run_closes_its_log_and_keeps_the_end_of_one_that_had_ended(tmp_path: Path) -> None:
    path = recorded(tmp_path, 0)
    ended, size = Run.open(path).state["finished_utc"], log_size(path)
    with RunWriter.reopen(path) as again:
        assert open_below(tmp_path)
        assert again.finish(FinishReason.COMPLETED).state["finished_utc"] == ended
        assert not open_below(tmp_path)
    last = json.loads((path / "log.jsonl").read_bytes()[size:])
    assert (last["kind"], last["utc"]) == ("finished", ended)
    with new_run(tmp_path) as writer:
        writer.start(steps=5)
        began = Run.open(writer.path).state["started_utc"]
        run = writer.finish(FinishReason.STOPPED)
    assert run.state["finished_utc"] >= began


@pytest.mark.parametrize(
    ("values", "told"),
    [([3.0], 3.0), ([3.0, 3.0], 3.0), ([3.0, 4.0], "3.0; 4.0"), (["a", "a", "b"], "a; a; b")],
)
def test_what_all_frames_share_is_told_once(values: list[Any], told: Any) -> None:
    assert _told(values) == told


def test_an_array_is_held_against_the_last_of_the_logs_ends(tmp_path: Path) -> None:
    """A run that ended twice was described twice: the sums of the second time count."""
    with new_run(tmp_path) as writer:
        writer.start(steps=5)
        writer.write([frame(0), frame(1)])
        path = writer.finish(FinishReason.STOPPED).path
    with RunWriter.reopen(path) as again:
        again.start()
        again.write([frame(i) for i in (2, 3, 4)])
        again.finish(FinishReason.COMPLETED)
    assert [str(problem) for problem in file_problems(Run.open(path))] == []
    described = path / "frames.ome.zarr" / "0" / "zarr.json"
    described.write_bytes(described.read_bytes() + b" ")  # it reads the same
    (problem,) = file_problems(Run.open(path))
    assert (problem.name, problem.problem) == ("frames.ome.zarr/0/zarr.json", "is not as it was written")


def test_what_a_newer_program_noted_in_a_plan_is_said_to_be_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with new_run(tmp_path) as writer:
        writer.keep_text("plan.json", json.dumps(json.loads(plan().to_json()) | {"mood": "blue"}))
    assert Run.open(writer.path).plan == plan()
    assert "'mood', which this program does not know" in caplog.text


def test_images_that_were_deleted_meanwhile_are_not_begun_anew(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.write([frame(0)])
        shutil.rmtree(writer.path / "frames.ome.zarr")
        with pytest.raises(RunError, match="deleted or moved meanwhile"):
            writer.write([frame(1)])
        assert not (writer.path / "frames.ome.zarr").exists()


def test_an_array_grows_with_the_first_frame_beyond_it(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as writer:
        writer.write([frame(0)])
        assert Run.open(writer.path).array.n_frames == 256
        writer.write([frame(255), frame(256)])
        assert Run.open(writer.path).array.n_frames == 512
        writer.write([frame(1600)])
        assert Run.open(writer.path).array.n_frames == 1601
        assert sorted(writer.finish(FinishReason.COMPLETED).records) == [0, 255, 256, 1600]


@pytest.mark.parametrize(
    ("copy", "state", "is_foreign"),
    [
        ('{"id": "a"}', "b", True),
        ('{"id": "a"}', "a", False),
        ('{"id": "a"}', None, False),
        ("{}", "b", False),
        ("[1]", "b", False),
        ("{", "b", False),
    ],
)
def test_a_log_with_anothers_identifier_is_foreign(
    tmp_path: Path, copy: str, state: str | None, *, is_foreign: bool
) -> None:
    assert RunFiles(tmp_path, {"provenance.json": copy}).log_is_foreign(state) is is_foreign
    (tmp_path / "provenance.json").write_text('{"id": "a"}')
    assert not RunFiles(tmp_path, {"provenance.json": copy}).log_is_foreign(state)


@pytest.mark.parametrize(("asked", "left"), [(3, 1), (2, None)])
def test_one_frame_that_a_recording_lacks_is_worth_taking(
    tmp_path: Path, asked: int, left: int | None
) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as writer:
        writer.start(n_frames=asked)
        writer.write([frame(0), frame(1)])
        rest = rest_of(writer.finish(FinishReason.STOPPED).path)
    assert left == (None if rest is None else rest.n_frames)


@pytest.mark.parametrize("within", ["", "deep/down"])
def test_no_run_is_kept_within_another(tmp_path: Path, within: str) -> None:
    path = recorded(tmp_path, 0)
    with pytest.raises(RunError, match="no other run is kept there") as refused:
        refuse_within(path / within)
    assert f"e.g. {tmp_path}" in str(refused.value)
    with pytest.raises(RunError, match="no other run is kept there"):
        new_run(path / within)
    assert [one.name for one in path.glob("*/")] == ["frames.ome.zarr"]
    refuse_within(tmp_path / within)
    (path / "log.jsonl").unlink()
    refuse_within(path / within)


def test_a_calibration_that_is_being_written_is_no_result_yet(tmp_path: Path) -> None:
    for name in ("calibration", ".calibration"):
        (tmp_path / name).mkdir()
        (tmp_path / name / CALIBRATION_FILES[0]).write_text("{")
    assert {problem.of for problem in result_problems(tmp_path)} == {"calibration"}


@pytest.fixture(name="made")
def _made(tmp_path: Path) -> Path:
    """A folder of whole results of each kind; what else lies there is nobody's."""
    for name in ("photograph.tif", "doubtful_photograph.tif"):
        write_image(tmp_path / name, np.ones((4, 5), np.uint16))
    write_image(tmp_path / "height.tif", np.array([[1.0, np.nan], [2.0, 3.0]], np.float32))
    for name in ("dpc.json", "doubtful_dpc.json"):
        (tmp_path / name).write_text('{"height_file": "height.tif"}')
    (tmp_path / "stage.json").write_text('{"height_file": 3}')
    (tmp_path / "angular_response.json").write_text("[1]")
    (tmp_path / "notes.json").write_text("{")
    calibration = Calibration(np.ones((2, 1, 4, 5), np.float32), np.array([[0, 0, 1e3], [0, 0, 2e3]]))
    save_calibration(calibration, tmp_path / "calibration")
    assert result_problems(tmp_path) == []
    return tmp_path


@pytest.mark.parametrize(
    ("damaged", "text", "told", "of", "at_a_look"),
    [
        ("photograph.tif", "no picture", "photograph.tif", "photograph.tif", False),
        ("doubtful_photograph.tif", "none", "doubtful_photograph.tif", "doubtful_photograph.tif", False),
        ("stage.json", "{", "stage.json", "stage.json", True),
        ("doubtful_dpc.json", "{", "doubtful_dpc.json", "doubtful_dpc.json", True),
        ("dpc.json", '{"height_file": "notes.json"}', "dpc.json", "dpc.json", False),
        ("calibration/calibration.json", "{", "calibration/calibration.json", "calibration", True),
        (
            "calibration/psfs.ome.zarr/0/zarr.json",
            "{",
            "calibration/psfs.ome.zarr",
            "calibration",
            False,
        ),
    ],
)
def test_a_damaged_result_is_told_by_its_name_and_at_a_look_where_that_reads_it(
    made: Path, damaged: str, text: str, told: str, of: str, *, at_a_look: bool
) -> None:
    (made / damaged).write_text(text)
    (problem,) = result_problems(made)
    assert (problem.name, problem.of) == (told, of)
    assert problem.problem
    assert bool(result_problems(made, read=False)) is at_a_look
    assert [one.of for one in result_problems(made, read=False, noted=[of])] == [of]
    assert bool(result_problems(made, read=False, noted=["another"])) is at_a_look


def test_a_runs_own_file_is_not_written_to_by_another_name_either(tmp_path: Path) -> None:
    path = recorded(tmp_path, 0)
    (path / "mine.json").hardlink_to(path / "state.json")
    for name in ("state.json", "mine.json", "frames.ome.zarr/0/more"):
        with pytest.raises(FileError, match=r"is a run, and .* is part of it; no output replaces it"):
            refuse_own_files(path / name)
    refuse_own_files(path / "notes.txt")
    refuse_own_files(tmp_path / "state.json")


def test_pictures_of_a_run_have_names_of_one_length(tmp_path: Path) -> None:
    export(Run.open(recorded(tmp_path, 3, 10)), tmp_path / "pictures")
    assert sorted(one.name for one in (tmp_path / "pictures").iterdir()) == ["frame-03.png", "frame-10.png"]


def test_a_plans_frames_and_one_alone_have_no_period(tmp_path: Path) -> None:
    assert Run.open(recorded(tmp_path / "recordings", 4)).frame_period_s is None
    with new_run(tmp_path) as writer:
        later = replace(frame(1), metadata=replace(frame(1).metadata, device_time_ns=20_000_123))
        writer.write([frame(0), later])
        assert Run.open(writer.path).frame_period_s is None
