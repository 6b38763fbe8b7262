"""Whatever happens to a file of a run: it is said, mended where that can be, and nothing whole is dropped."""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from instrument.cli import main
from instrument.files.errors import FileError
from instrument.plan import Part, Plan
from instrument.runs import writer
from instrument.runs.acquire import look, prepare, prepare_resume, settle
from instrument.runs.inspection import summary, verify
from instrument.runs.log import AppendOnlyLog
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_files import FRAMES, UNCHANGING, RunError
from instrument.runs.writer import FrameToStore, RunWriter, lock_run
from tests.instrument.runs.damages import DAMAGES, newer
from tests.instrument.runs.test_resume import open_mock_bench
from tests.instrument.runs.test_store import frame, new_run

pytestmark = pytest.mark.usefixtures("mock_drivers")

FILES = {
    "plan.json": "plan.json: ",
    "bench.json": "bench.json: ",
    "bench.toml": "bench.toml: ",
    "provenance.json": "provenance.json: ",
    "state.json": "state.json: ",
    "log.jsonl": "log",
    f"{FRAMES}/zarr.json": f"{FRAMES}/zarr.json: ",
    f"{FRAMES}/0/zarr.json": f"{FRAMES}/0/zarr.json: ",
    f"{FRAMES}/0/c/1/0/0": "frame 1: ",
}


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        pair for pair in product(FILES, DAMAGES) if pair != ("state.json", newer)
    ],  # which is refused, see below
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_each_damage_of_each_file_is_said_and_mended(
    tmp_path: Path, runs: tuple[Path, Path], name: str, damage: Callable[[Path, Path], None]
) -> None:
    path, other = tmp_path / "run", runs[1]
    shutil.copytree(runs[0], path)
    before = verify(Run.open(path))
    assert before.is_sound, before.lines()
    whole = {i: Run.open(path).frame(i) for i in range(3)}
    damage(path / name, other / name)
    unchanged = (
        path.joinpath(name).exists() and path.joinpath(name).read_bytes() == (runs[0] / name).read_bytes()
    )
    found = verify(Run.open(path))
    if unchanged:
        assert found.is_sound
        return
    words = "\n".join(found.lines())
    assert FILES[name] in words, words
    files = {p: p.read_bytes() for p in path.rglob("*") if p.is_file() and p.stat().st_size}

    if found.files and found.files[0].problem.startswith("is another run's"):
        with pytest.raises(RunError, match="another run's; nothing was changed"):
            RunWriter.reopen(path)
        (path / "log.jsonl").rename(path / "foreign.jsonl")  # as the sentence says
        found = verify(Run.open(path))
    with RunWriter.reopen(path) as writer:
        for index in found.todo:
            writer.write([FrameToStore(index, whole[index], frame(index).metadata)])
        writer.finish(FinishReason.COMPLETED)
    after = verify(Run.open(path))
    assert after.is_sound, after.lines()
    assert Run.open(path).condition is RunCondition.COMPLETED
    for index, image in whole.items():
        assert np.array_equal(Run.open(path).frame(index), image)
    assert Run.open(path).plan == Run.open(runs[0]).plan
    if name != "log.jsonl":  # whose whole lines stay in it
        kept = [p.read_bytes() for p in path.rglob("*") if p.is_file()]
        rewritten = path / "state.json", path / "log.jsonl", path / "damaged.json"
        assert all(data in kept for file, data in files.items() if file not in rewritten)


def piped(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def hollow(path: Path) -> None:
    os.truncate(path, 20 << 30)


@pytest.mark.parametrize("puts", [piped, endless, a_folder, hollow])
@pytest.mark.parametrize("name", [*FILES, "lock", "damaged.json"])
def test_what_is_no_file_in_a_files_place_is_said_and_not_waited_for(
    tmp_path: Path, runs: tuple[Path, Path], name: str, puts: Callable[[Path], None]
) -> None:
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    whole = [Run.open(path).frame(index) for index in range(3)]
    (path / name).touch()
    puts(path / name)
    if name in ("log.jsonl", "state.json"):
        with pytest.raises(RunError, match=name):
            Run.open(path)
        assert summary(path).problem
        return
    if name in FILES:
        found = verify(Run.open(path))
        assert FILES[name] in "\n".join(found.lines())
        for index in found.todo:
            with pytest.raises(FileError, match=r"damaged|file is expected"):
                Run.open(path).frame(index)
        with RunWriter.reopen(path) as again:
            again.write([FrameToStore(i, whole[i], frame(i).metadata) for i in found.todo])
            again.finish(FinishReason.COMPLETED)
    assert verify(Run.open(path)).is_sound
    assert all(np.array_equal(Run.open(path).frame(index), whole[index]) for index in range(3))


def test_a_bad_byte_in_a_log_costs_its_line_at_most(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.start(steps=5)
        writer.write([frame(i) for i in range(5)])
        path = writer.finish(FinishReason.COMPLETED).path
    log = path / "log.jsonl"
    data = log.read_bytes()
    first = data.index(b'{"kind": "frame", "index": 2')
    end = data.index(b"\n", first)
    for place in (*range(first, end, 7), end):
        for value in (data[place] ^ 1, 0, ord("\n"), ord("{"), ord('"')):
            if value == data[place]:
                continue
            changed = bytearray(data)
            changed[place] = value
            log.write_bytes(changed)
            lacking = set(range(5)) - set(Run.open(path).records)
            assert lacking <= {2}, (place, value)
            if not lacking:  # only the sum's own name or the line's end can be spared
                assert Run.open(path).metadata(2) == frame(2).metadata


def test_a_newer_versions_state_is_refused_and_left(tmp_path: Path, runs: tuple[Path, Path]) -> None:
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    newer(path / "state.json", path)
    text = (path / "state.json").read_text()
    with pytest.raises(RunError, match="Update diffuserbench"):
        RunWriter.reopen(path)
    assert (path / "state.json").read_text() == text


def test_an_older_runs_log_without_sums_and_copies_gets_them(tmp_path: Path, runs: tuple[Path, Path]) -> None:
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    lines = [json.loads(line) for line in (path / "log.jsonl").read_text().splitlines()]
    old = [{k: v for k, v in line.items() if k != "line_crc32"} for line in lines if line["kind"] != "file"]
    (path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in old))
    assert verify(Run.open(path)).is_sound
    RunWriter.reopen(path).close()
    mended = (path / "log.jsonl").read_text().count('"kind": "file"')
    assert mended == len(UNCHANGING)
    RunWriter.reopen(path).close()
    assert (path / "log.jsonl").read_text().count('"kind": "file"') == mended, "once"
    (path / "plan.json").unlink()
    assert Run.open(path).plan == Run.open(runs[0]).plan


def test_the_first_image_beyond_a_plan_is_kept_beside(tmp_path: Path, runs: tuple[Path, Path]) -> None:
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    run = Run.open(path)
    assert run.plan is not None
    last, beyond = (run.array.chunk_path(index) for index in (len(run.plan) - 1, len(run.plan)))
    shutil.copytree(last.parents[1], beyond.parents[1])
    RunWriter.reopen(path).close()
    assert not beyond.is_file()
    assert [kept.read_bytes() for kept in (path / "kept").rglob("*") if kept.is_file()] == [last.read_bytes()]
    assert last.is_file()


def test_a_resumed_runs_log_says_what_was_found(tmp_path: Path) -> None:
    plan = Plan(label="p", parts=(Part(label="a", repeats=3),))
    with open_mock_bench() as bench:
        path = prepare(bench, plan, tmp_path).execute().path
        Run.open(path).array.chunk_path(1).unlink()
        prepare_resume(bench, path).execute()
    (found,) = [event["text"] for event in Run.open(path).events if event["kind"] == "found"]
    assert "file is gone" in found


def test_a_label_that_no_step_has_is_named(runs: tuple[Path, Path]) -> None:
    with pytest.raises(RunError, match="no steps labelled 'psf2'"):
        Run.open(runs[0]).images("psf2")


@pytest.mark.parametrize("unlockable", ["folder", "file"])
def test_where_folders_cannot_be_locked_the_file_is(
    tmp_path: Path, runs: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, unlockable: str
) -> None:
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    lock = writer.lock

    def sometimes(handle: int) -> bool:
        if stat.S_ISDIR(os.fstat(handle).st_mode) == (unlockable == "folder"):
            raise OSError("no locks here")
        return lock(handle)

    monkeypatch.setattr(writer, "lock", sometimes)
    if unlockable == "file":
        with pytest.raises(OSError, match="no locks here"):
            lock_run(path)
    else:
        with lock_run(path), pytest.raises(RunError, match="another program"):
            lock_run(path)


def test_what_verify_says_that_resume_does_is_what_it_does(runs: tuple[Path, Path], tmp_path: Path) -> None:
    path = tmp_path / "run"
    shutil.copytree(runs[0], path)
    assert look(path).remedy() == ""
    ended = Run.open(path).state["finished_utc"]
    (path / "provenance.json").write_text("{")
    chunk = Run.open(path).array.chunk_path(len(Run.open(path).records))  # beyond the plan
    chunk.parent.mkdir(parents=True)
    chunk.write_bytes(b"an image of nothing")
    found = look(path)
    assert not found.todo
    assert found.remedy() == (
        "diffuserbench resume makes its files again, moves the images beyond the plan's away; "
        "what it replaces is kept beside."
    )
    said = "\n".join(settle(path, found))  # no bench is opened
    assert "provenance.json was made again" in said
    assert "beyond the plan's, are kept" in said
    assert look(path).is_sound
    assert {p.read_bytes() for p in (path / "kept").iterdir()} == {b"{", b"an image of nothing"}
    assert Run.open(path).state["finished_utc"] == Run.open(path).state_by_log()["finished_utc"] == ended
    shutil.copy(runs[1] / "log.jsonl", path)
    foreign = look(path)
    assert foreign.remedy().startswith("Put the run's own log back")
    with pytest.raises(RunError, match="another run's; nothing was changed"):
        RunWriter.reopen(path)
    (path / "log.jsonl").unlink()
    assert "begins a new log, takes frames" in look(path).remedy()
    with pytest.raises(RunError, match="still to be taken"):
        settle(path)
    (path / "slm").mkdir(exist_ok=True)
    (path / "slm" / "no-image").mkdir()
    assert look(path).remedy().startswith("Put slm/no-image back from a backup")


def test_a_log_that_was_copied_as_text_of_another_system_is_whole(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.start(steps=5)
        writer.write([frame(i) for i in range(3)])
        path = writer.finish(FinishReason.ABORTED).path
    log = path / "log.jsonl"
    log.write_bytes(log.read_bytes().replace(b"\n", b"\r\n"))
    run = Run.open(path)
    assert not run.bad_lines
    assert [run.metadata(i) for i in range(3)] == [frame(i).metadata for i in range(3)]
    assert verify(run).is_sound, verify(run).lines()
    again = AppendOnlyLog(log)
    again.append([replace(run.records[2], index=3).to_json()])
    again.close()
    assert sorted(Run.open(path).records) == [0, 1, 2, 3]


def test_images_without_a_line_are_counted_alike_by_resume_and_verify(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with new_run(tmp_path, plan=None) as writer:
        writer.start()
        writer.write([frame(i) for i in range(4)])
        path = writer.finish(FinishReason.COMPLETED).path
    log = path / "log.jsonl"
    data = bytearray(log.read_bytes())
    data[data.index(b'"frame", "index": 3') + 20] = 7
    log.write_bytes(data)
    assert main(["resume", str(path)]) == 0
    assert "with 4 of 4 frames, 1 of them without metadata" in capsys.readouterr().out
    assert main(["verify", str(path)]) == 0
    assert "4 of 4 frames read back" in capsys.readouterr().out


def test_a_recording_keeps_images_without_a_line_and_marks_the_rest_as_lost(tmp_path: Path) -> None:
    with new_run(tmp_path, plan=None) as writer:
        writer.start()
        writer.write([frame(i) for i in range(8)])
        path = writer.finish(FinishReason.COMPLETED).path
    log, chunks = path / "log.jsonl", path / FRAMES / "0/c"
    data = bytearray(log.read_bytes())
    data[data.index(b'"frame", "index": 3') + 20] = 7
    log.write_bytes(data)
    (chunks / "5/0/0").write_bytes(b"short")
    (chunks / "6/0/0").unlink()
    (path / f".{FRAMES}.draft" / "0").mkdir(parents=True)  # as a kill leaves it
    found = verify(Run.open(path))
    assert [f.index for f in found.damaged] == [5, 6]
    assert found.without_a_line == (3,)
    assert "marks frames 5-6 as lost" in found.remedy()
    said = "\n".join(settle(path))
    assert "marked as lost: frames 5-6" in said
    assert not (path / f".{FRAMES}.draft").exists()
    assert "images of frame 3" in said
    run = Run.open(path)
    assert verify(run).is_sound, verify(run).lines()
    assert run.condition is RunCondition.COMPLETED
    assert sorted(run.records) == [0, 1, 2, 4, 7]
    assert np.array_equal(run.frame(3), frame(3).image)
    assert run.n_frames == run.array.n_frames == 8
    assert (chunks / "5/0/0").read_bytes() == b"short"
    with pytest.raises(RunError, match="frame 6 is lost: its file is gone"):
        run.frame(6)
    assert settle(path) == []
    (chunks / "3/0/0").write_bytes(bytes(96))
    assert [f.index for f in verify(Run.open(path)).damaged] == [3]
    open_files = len(list(Path("/proc/self/fd").iterdir()))
    again = AppendOnlyLog(log)
    again.append([replace(Run.open(path).records[4], index=3).to_json()])
    again.close()
    again.close()
    assert len(list(Path("/proc/self/fd").iterdir())) == open_files
    assert not Run.open(path).unlisted


def test_a_completed_run_takes_damaged_frames_again_and_keeps_the_old(tmp_path: Path) -> None:
    images = [tmp_path / f"{value}.png" for value in range(2)]
    for value, image in enumerate(images):
        cv2.imwrite(str(image), np.full((4, 6), 40 + value, np.uint8))
    plan = Plan(label="p", parts=(Part(label="a", slm_images=tuple(images), repeats=2),))
    with open_mock_bench() as bench:
        path = prepare(bench, plan, tmp_path / "runs").execute().path
    chunk = Run.open(path).array.chunk_path(2)
    chunk.write_bytes(spoilt := bytes(chunk.stat().st_size))
    with open_mock_bench() as bench:
        findings = look(path)
        runner = prepare_resume(bench, path, findings)
        assert findings.todo == (2,)
        run = runner.execute()
    assert verify(run).is_sound
    assert [p.read_bytes() for p in (path / "kept").iterdir()] == [spoilt]
    slm = next((path / "slm").iterdir())
    slm.write_bytes(images[0].read_bytes()[:-3])
    chunk.unlink()
    with open_mock_bench() as bench, pytest.raises(RunError, match="not the image that the run began with"):
        prepare_resume(bench, path)
