"""What is said of a run that was looked at, and what ``resume`` would do about it: tables."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from instrument.files.errors import FileError
from instrument.runs import repair
from instrument.runs.inspection import Verification, runs_and_photographs, summary, verify
from instrument.runs.log import AppendOnlyLog, FrameRecord
from instrument.runs.repair import file_problems, keep_beside
from instrument.runs.run import DamagedFrame, FinishReason, Run, RunCondition
from instrument.runs.run_files import (
    FileProblem,
    RunError,
    RunFiles,
    is_run,
    note_damage,
    noted_damage,
    refuse_own_files,
)
from instrument.runs.writer import RunWriter
from tests.instrument.runs.test_store import frame, metadata, new_run, plan

SOUND: dict[str, Any] = {
    "log_bytes": 1,
    "condition": RunCondition.COMPLETED,
    "is_recording": False,
    "frames": 9,
    "todo": (),
    "damaged": (),
    "without_a_line": (),
    "files": (),
    "problems": (),
}
BAD = (DamagedFrame(1, "its file is gone"), DamagedFrame(2, "its file is gone"))
LOG_GONE = FileProblem("log.jsonl", "is gone", remedy="begins a new log")
FOREIGN = FileProblem("log.jsonl", "is another run's")
PLAN_GONE = FileProblem("plan.json", "is gone", "{}", "makes its files again")
BENCH_GONE = FileProblem("bench.json", "is gone", "{}", "makes its files again")
SLM = FileProblem("slm/a.png", "cannot be read")
AWAY, AGAIN = "moves the images beyond the plan's away", "makes its files again"


@pytest.mark.parametrize(
    ("changes", "does"),
    [
        ({}, ""),
        ({"problems": ("frames 1 are both stored and lost",)}, ""),
        ({"todo": (1, 2, 5)}, "takes frames 1-2, 5"),
        ({"damaged": BAD, "todo": (1, 2)}, "takes frames 1-2"),
        ({"without_a_line": (1,), "todo": (1,)}, "takes frame 1"),
        ({"without_a_line": (1, 9), "todo": (1,)}, f"{AWAY}, takes frame 1"),
        ({"without_a_line": (9,)}, AWAY),
        ({"files": (PLAN_GONE, LOG_GONE, BENCH_GONE)}, f"{AGAIN}, begins a new log"),
        ({"files": (PLAN_GONE,), "todo": (3,)}, f"{AGAIN}, takes frame 3"),
        ({"files": (SLM, PLAN_GONE)}, AGAIN),
        ({"files": (SLM,)}, ""),
        ({"files": (SLM, PLAN_GONE), "todo": (3,)}, "!Put slm/a.png back from a backup"),
        ({"files": (FOREIGN, PLAN_GONE), "todo": (3,)}, "!Put the run's own log back, or move this one away"),
        ({"is_recording": True, "damaged": BAD}, "marks frames 1-2 as lost"),
        ({"is_recording": True, "without_a_line": (7,)}, "keeps the images without a line"),
        (
            {"is_recording": True, "without_a_line": (7,), "damaged": BAD[:1], "files": (PLAN_GONE,)},
            f"{AGAIN}, marks frame 1 as lost, keeps the images without a line",
        ),
    ],
)
def test_what_resume_would_do_is_said(changes: dict[str, Any], does: str) -> None:
    found = Verification(**SOUND | changes)
    if does.startswith("!"):
        assert found.remedy().startswith(f"{does[1:]}: resume ")
    else:
        assert found.remedy() == (
            f"diffuserbench resume {does}; what it replaces is kept beside." if does else ""
        )
    assert found.is_sound == (not set(changes) - {"todo", "is_recording"})
    assert len(found.lines()) == sum(
        len(changes.get(name, ())) for name in ("damaged", "files", "problems")
    ) + bool(found.without_a_line)


def test_what_was_found_is_told_in_lines() -> None:
    found = Verification(
        **SOUND | {"todo": (1, 9), "damaged": BAD[:1], "without_a_line": (4, 5), "files": (SLM,)}
    )
    lines = ["frame 1: its file is gone", "images without their line in the log: frames 4-5", f"{SLM}"]
    assert found.lines() == lines
    assert str(found).splitlines() == [
        "completed: 9 frames safely stored, 2 to do, first step 1",
        *(f"  {line}" for line in lines),
    ]
    assert str(Verification(**SOUND)) == "completed: 9 frames safely stored, 0 to do"
    assert str(Verification(**SOUND | {"is_recording": True})) == "completed: 9 frames safely stored"


# The files -----------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A completed run of a plan of three frames."""
    with new_run(tmp_path_factory.mktemp("runs"), plan=plan(3)) as writer:
        writer.start(steps=3)
        writer.write([frame(i) for i in range(3)])
        return writer.finish(FinishReason.COMPLETED).path


def in_json(name: str, change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        found = json.loads((path / name).read_text())
        change(found)
        (path / name).write_text(json.dumps(found))

    return damage


def in_log(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda path: (path / "log.jsonl").write_bytes(change((path / "log.jsonl").read_bytes())) and None


ARRAY, GROUP = "frames.ome.zarr/0/zarr.json", "frames.ome.zarr/zarr.json"


def scale(group: dict[str, Any]) -> Any:
    return group["attributes"]["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"][0][
        "scale"
    ]


@pytest.mark.parametrize(
    ("damage", "problems"),
    [
        (lambda _: None, []),
        (lambda path: (path / "log.jsonl").unlink(), ["log.jsonl: is gone"]),
        (in_log(lambda data: data + b'{"ki'), ["log.jsonl: it ends in a half line of 4 bytes"]),
        (in_log(lambda data: b"ab\n" + data), ["log.jsonl: line 1 cannot be read (3 bytes)"]),
        (lambda path: (path / "plan.json").unlink(), ["plan.json: is gone"]),
        (lambda path: (path / "plan.json").write_bytes(b"\xff"), ["plan.json: is no text file any more"]),
        (lambda path: (path / "bench.toml").write_text("x"), ["bench.toml: is not as it was written"]),
        (lambda path: (path / "state.json").write_text("[1]"), ["state.json: is no state of a run"]),
        (in_json("state.json", lambda state: state.pop("label")), ["state.json: lacks label"]),
        (
            in_json("state.json", lambda state: state.update(reason="tired")),
            ["state.json: names no reason for the end: 'tired'"],
        ),
        (
            in_json("state.json", lambda state: state.update(label="b", simulated=False, reason="stopped")),
            [
                "state.json: says what the log does not: label is 'b', not 'a test'; "
                "simulated is False, not True; reason is 'stopped', not 'completed'"
            ],
        ),
        (in_json("state.json", lambda state: state.update(state="running")), []),
        (lambda path: (path / ARRAY).unlink(), [f"{ARRAY}: is gone"]),
        (lambda path: (path / ARRAY).write_text("{"), [f"{ARRAY}: is damaged"]),
        (in_json(ARRAY, lambda array: array["shape"].insert(0, 9)), [f"{ARRAY}: is not as it was written"]),
        (
            in_json(ARRAY, lambda array: array.update(more=1)),
            [f"{ARRAY}: is not as it was written"],
        ),  # its sum
        (lambda path: (path / GROUP).unlink(), [f"{GROUP}: is gone"]),
        (lambda path: (path / GROUP).write_text("[]"), [f"{GROUP}: is damaged"]),
        (
            in_json(GROUP, lambda group: scale(group).__setitem__(1, 9.0)),
            [f"{GROUP}: is not as it was written"],
        ),
        (lambda path: (path / "slm").mkdir(), []),
    ],
)
def test_a_file_that_is_not_as_it_was_is_named(
    tmp_path: Path, whole: Path, damage: Callable[[Path], None], problems: list[str]
) -> None:
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    damage(path)
    assert [str(problem) for problem in file_problems(Run.open(path))] == problems
    assert all(problem.remedy for problem in file_problems(Run.open(path)))
    found = summary(path)
    assert (found.stored, found.frames) == (0 if problems == ["log.jsonl: is gone"] else 3, 3)
    assert found.is_damaged == (bool(problems))


def test_a_line_that_is_being_written_is_no_problem(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.start()
        with (writer.path / "log.jsonl").open("ab") as log:
            log.write(b"abc")
        assert file_problems(Run.open(writer.path)) == []
        assert not verify(Run.open(writer.path)).without_a_line
        assert summary(writer.path).became == "running"
    assert [str(one) for one in file_problems(Run.open(writer.path))] == [
        "log.jsonl: it ends in a half line of 3 bytes"
    ]


def test_a_recording_that_goes_on_is_held_against_what_it_has_so_far(tmp_path: Path) -> None:
    with new_run(tmp_path, plan=None) as writer:
        writer.start()
        assert verify(Run.open(writer.path)).is_sound
        writer.write([frame(0)])
        assert verify(Run.open(writer.path)).is_sound
        assert (summary(writer.path).kind, summary(writer.path).frames) == ("recording", 1)


def test_frames_beyond_the_plan_are_told(tmp_path: Path, whole: Path) -> None:
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    log = AppendOnlyLog(path / "log.jsonl")
    log.append([FrameRecord(3, 96, 0, 1, metadata(3)).to_json()])
    log.close()
    assert "the log has frames 3, beyond the plan's 3" in verify(Run.open(path)).problems


def test_a_run_is_one_by_its_state_or_by_its_log_with_its_provenance(tmp_path: Path) -> None:
    for names, found in (
        (("state.json",), True),
        (("log.jsonl",), False),
        (("provenance.json",), False),
        (("log.jsonl", "provenance.json"), True),
    ):
        folder = tmp_path / "-".join(names)
        folder.mkdir()
        for name in names:
            (folder / name).write_text("")
        assert is_run(folder) == found
        for name, refused in (("plan.json", found), ("kept", found), ("mine.txt", False)):
            for path in (folder / name, folder / name / "deeper" / "a.txt"):
                if refused:
                    with pytest.raises(FileError, match=f"is a run, and {name} is part of it"):
                        refuse_own_files(path)
                else:
                    refuse_own_files(path)


def test_what_a_file_held_comes_from_its_copy_or_from_itself(tmp_path: Path) -> None:
    files = RunFiles(tmp_path, {"plan.json": '{"a": 1}', "routine.json": '{"b": 1}'})
    assert files.table("plan.json") == {"a": 1}
    assert files.text("routine.json") is None  # which may be put right by hand
    (tmp_path / "routine.json").write_text('{"b": 2}')
    (tmp_path / "plan.json").write_text('{"a": 1}')
    assert files.table("routine.json") == {"b": 2}
    assert files.problems() == []
    for data, words in ((b"\xff", "it holds no text"), (b"[]", "it holds no table"), (b"{", "no valid JSON")):
        (tmp_path / "other.json").write_bytes(data)
        with pytest.raises(RunError, match=words):
            files.table("other.json")
    with pytest.raises(RunError, match=r"gone.json: is gone, and the log has no copy of it"):
        files.table("gone.json")
    (tmp_path / "routine.json").write_text("[]")
    assert [str(one) for one in RunFiles(tmp_path, files.copies).problems()] == [
        "routine.json: is not as it was written"
    ]


def test_damage_is_noted_and_the_note_goes_with_it(tmp_path: Path) -> None:
    assert noted_damage(tmp_path) == (set(), set())
    note_damage(tmp_path, [3, 5])
    assert noted_damage(tmp_path) == ({3, 5}, set())
    note_damage(tmp_path, [], ["calibration"])
    assert noted_damage(tmp_path) == (set(), {"calibration"})
    note_damage(tmp_path, [])
    assert not list(tmp_path.iterdir())
    note_damage(tmp_path, [])


def test_what_is_kept_beside_never_takes_the_place_of_what_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(repair, "sync_folder", synced.append)
    kept = [keep_beside(tmp_path, "a/b", bytes([n])) for n in range(12)]
    assert [path.read_bytes() for path in kept] == [bytes([n]) for n in range(12)]
    assert all(path.parent == tmp_path / "kept" and path.name.endswith("_a_b") for path in kept)
    (tmp_path / "file").write_bytes(b"moved")
    assert keep_beside(tmp_path, "file").read_bytes() == b"moved"
    assert synced == [tmp_path, tmp_path / "kept"]
    assert not (tmp_path / "file").exists()


def test_runs_and_photographs_are_listed_newest_first(tmp_path: Path) -> None:
    for name in ("2026-01-01_00-00-00_a", "2099-01-01_00-00-00_b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "state.json").write_text("{")
    (tmp_path / "photographs").mkdir()
    for name in ("p.tif", ".hidden.tif", "p.txt"):
        (tmp_path / "photographs" / name).write_text("")
    found = [path.name for path in runs_and_photographs(tmp_path)]
    assert found == ["2099-01-01_00-00-00_b", "p.tif", "2026-01-01_00-00-00_a"]
    unreadable = summary(tmp_path / "2026-01-01_00-00-00_a")
    assert (unreadable.became, unreadable.kind, unreadable.is_damaged) == ("UNREADABLE", "plan", False)
    assert unreadable.problem


def test_a_run_is_continued_with_what_was_done_to_its_files_in_words(tmp_path: Path, whole: Path) -> None:
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    with RunWriter.reopen(path) as writer:
        assert writer.mended == ()
    (path / "plan.json").unlink()
    (path / "bench.json").write_text("{")
    (path / "slm").mkdir()
    (path / "slm" / "a.png").write_bytes(b"not what its name says")
    half = Run.open(path).array.chunk_path(1).with_name("part")
    half.write_bytes(b"half")
    (path / "state.json").write_text("[1]")
    with RunWriter.reopen(path) as writer:
        assert not half.exists()
        assert (path / "slm" / "a.png").exists()
        assert (
            writer.mended[0] == "plan.json was made again" or writer.mended[1] == "plan.json was made again"
        )
        assert any(
            words.startswith("bench.json was made again; the old one is kept in kept/")
            for words in writer.mended
        )
        names = sorted(words.partition(" ")[0] for words in writer.mended)
        assert names == ["bench.json", "plan.json", "state.json"]
    with (path / "log.jsonl").open("ab") as log:
        log.write(b"junk\n")
    with RunWriter.reopen(path) as writer:
        (words,) = writer.mended
    assert words.startswith("what could not be read of the log was cut out and is kept in kept/")
    assert (path / words.rpartition(" ")[2]).read_bytes() == b"junk\n"


def test_steps_in_time_that_are_known_at_a_runs_end_are_no_damage_before(tmp_path: Path) -> None:
    with new_run(tmp_path, plan=None) as writer:
        writer.start()
        for index in range(2):
            shot = frame(index)
            later = replace(shot.metadata, device_time_ns=3 * 10**9 * index, host_time_ns=index)
            writer.write([replace(shot, metadata=later)])
    for _ in range(2):
        assert Run.open(writer.path).frame_period_s == 3.0
        assert verify(Run.open(writer.path)).is_sound
        with RunWriter.reopen(writer.path) as again:
            assert again.mended == ()
            again.finish(FinishReason.STOPPED)


def test_who_looks_at_sizes_only_reads_nothing_that_is_whole(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run"
    shutil.copytree(whole, path)
    read: list[int] = []
    look = Run.verify
    monkeypatch.setattr(Run, "verify", lambda run, index: read.append(index) or look(run, index))
    assert verify(Run.open(path), read=False).is_sound
    assert read == []
    chunk = Run.open(path).array.chunk_path(1)
    data = chunk.read_bytes()
    chunk.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    assert verify(Run.open(path), read=False).is_sound  # of the right size, and not read yet
    assert not verify(Run.open(path)).is_sound
    read.clear()
    assert [frame.index for frame in verify(Run.open(path), read=False).damaged] == [1]
    assert read == [1]
    chunk.write_bytes(data[:-1])
    assert [frame.index for frame in verify(Run.open(path), read=False).damaged] == [1]
    chunk.write_bytes(data)
    assert verify(Run.open(path), read=False).is_sound
    assert noted_damage(path) == (set(), set())
