"""Arrays that grow, colours, pictures of runs, and the words of what may not be written: tables."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import threading
from concurrent.futures import Future, wait
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from instrument.files.errors import FileError
from instrument.files.images import write_image
from instrument.plan import Part, Plan
from instrument.runs import frame_array, run_files, writer
from instrument.runs.frame_array import FrameArray, SyncPool, description_of
from instrument.runs.inspection import summary, verify
from instrument.runs.log import Gap
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import RunError
from instrument.runs.writer import RunWriter
from tests.instrument.files.test_atomic import open_below
from tests.instrument.runs.test_store import BENCH, frame, new_run


@pytest.mark.parametrize(
    ("shape", "axes"), [((6, 8), ["t", "y", "x"]), ((6, 8, 3), ["t", "c", "y", "x"])], ids=["grey", "colour"]
)
@pytest.mark.parametrize("data_type", ["uint8", "uint16", "float32"])
def test_an_array_says_what_it_holds(shape: tuple[int, ...], axes: list[str], data_type: str) -> None:
    described = description_of(5, shape, data_type)
    sides = [3, 6, 8] if len(shape) == 3 else [6, 8]
    assert described["shape"] == [5, *sides]
    assert described["chunk_grid"]["configuration"]["chunk_shape"] == [1, *sides]
    assert described["dimension_names"] == axes
    endian = {} if data_type == "uint8" else {"configuration": {"endian": "little"}}
    assert described["codecs"] == [{"name": "bytes"} | endian]
    array = FrameArray(Path("nowhere"), described)
    assert (array.n_frames, array.frame_shape, array.is_colour) == (5, shape, len(shape) == 3)
    assert array.frame_bytes == np.prod(shape) * np.dtype(data_type).itemsize


@pytest.mark.parametrize("shape", [[5, 6], [5, 3, 6, 8, 1], [5, 0, 8], [5, 3, 6, 0]])
def test_what_no_frames_have_is_refused(shape: list[int]) -> None:
    assert FrameArray(Path("nowhere"), description_of(1, (1, 1), "uint16")).frame_bytes == 2
    with pytest.raises(ValueError, match="no frames have the shape"):
        FrameArray(Path("nowhere"), {**description_of(1, (6, 8), "uint16"), "shape": shape})
    with pytest.raises(ValueError, match="and the type 'int64'"):
        FrameArray(Path("nowhere"), {**description_of(1, (6, 8), "uint16"), "data_type": "int64"})


def test_every_file_is_synced_and_the_first_failure_is_raised(tmp_path: Path) -> None:
    pool, file = SyncPool(2), (tmp_path / "a").open("w")
    try:
        pool.files([file.fileno()] * 3)
        pool.folders([tmp_path])
        with pytest.raises(OSError, match="Bad file descriptor"):
            pool.files([file.fileno(), 10**6])
        with pytest.raises(FileNotFoundError):
            pool.folders([tmp_path / "gone", tmp_path])
    finally:
        file.close()
        pool.close()


def test_after_ctrl_c_too_every_file_has_been_tried_before_it_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[int] = []

    def interrupted(tasks: list[Future[None]]) -> None:
        waits.append(len(tasks))
        if len(waits) == 1:
            raise KeyboardInterrupt
        wait(tasks)

    monkeypatch.setattr(frame_array, "wait", interrupted)
    pool = SyncPool(2)
    with pytest.raises(KeyboardInterrupt):
        pool.folders([tmp_path] * 3)
    pool.close()
    assert waits == [3, 3]


@pytest.mark.parametrize(
    ("first", "then", "grown"), [(0, 255, 256), (3, 256, 512), (0, 511, 512), (3, 600, 601)]
)
def test_a_recordings_array_grows_with_it_and_ends_with_its_last_frame(
    tmp_path: Path, first: int, then: int, grown: int
) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as writer:
        writer.start()
        writer.write([frame(first)])
        assert writer._array is not None
        assert writer._array.n_frames == 256
        for missed in ((0, first), (first + 1, then - first - 1)):
            if missed[1]:
                writer.gap(Gap(missed[0], missed[1], 0))
        writer.write([frame(then)])
        assert writer._array.n_frames == grown
        run = writer.finish(FinishReason.COMPLETED)
    assert run.array.n_frames == run.n_frames == then + 1
    assert sorted(run.records) == [first, then]
    assert np.array_equal(run.frame(then), frame(then).image)
    assert verify(run).is_sound


def test_a_photograph_and_a_run_are_summed_up(tmp_path: Path) -> None:
    write_image(tmp_path / "a.tif", np.zeros((4, 5), np.uint16))
    photo = summary(tmp_path / "a.tif")
    assert (photo.stored, photo.frames, photo.kind, photo.is_simulated) == (1, 1, "photograph", False)
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as writer:
        writer.start()
        writer.write([frame(0)])
        path = writer.finish(FinishReason.COMPLETED).path
    found = summary(path)
    assert (found.stored, found.frames, found.kind, found.became) == (1, 1, "recording", "completed")
    Run.open(path).array.chunk_path(0).unlink()
    assert summary(path).became == "completed, DAMAGED"


def test_an_array_keeps_what_was_written_and_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: dict[str, Any] = {"n_frames": 12, "frame_shape": (6, 8), "pixel_pitch_um": 2.5, "name": "a"}
    (tmp_path / ".frames.draft" / "left").mkdir(parents=True)
    array = FrameArray.create(tmp_path / "frames", dtype="uint16", **made)
    with pytest.raises(TypeError, match="not int64"):
        FrameArray.create(tmp_path / "other", dtype="int64", **made)
    with monkeypatch.context() as signals:
        signals.setattr(
            "instrument.runs.frame_array.group_of", lambda *_: (_ for _ in ()).throw(SystemExit(143))
        )
        with pytest.raises(SystemExit):
            FrameArray.create(tmp_path / "other", dtype="uint16", **made)
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
    scale = json.loads((array.path / "zarr.json").read_text())["attributes"]["ome"]["multiscales"][0]
    assert scale["datasets"][0]["coordinateTransformations"][0]["scale"] == [1, 2.5, 2.5]
    assert [axis["name"] for axis in scale["axes"]] == ["t", "y", "x"]
    images = {index: frame(index).image for index in (10, 2)}
    others = set(threading.enumerate())
    stored = array.write(list(images.items()))
    with monkeypatch.context() as fails:
        fails.setattr(SyncPool, "files", lambda *_: (_ for _ in ()).throw(OSError("no disk")))
        with pytest.raises(OSError, match="no disk"):
            array.write([(3, images[2])])

    def fail(words: str) -> None:
        if words == "folder gone":
            shutil.rmtree(array.chunk_path(4).parent)
        raise OSError(words)

    for words in ("disk full", "folder gone"):
        for owner, name in ((SyncPool, "files"), (os, "write")):
            with monkeypatch.context() as fails:
                fails.setattr(owner, name, lambda *_, words=words: fail(words))
                with pytest.raises(OSError, match=words):
                    array.write([(4, images[2])])
            assert not list(array.path.rglob("part"))
    assert not open_below(tmp_path)
    for _ in range(2):
        array.close()
    array.write([(3, images[2])])  # a pool of its own again
    array.close()
    assert not [one for one in set(threading.enumerate()) - others if one.name.startswith("sync")]
    array.chunk_path(3).unlink()
    array.describe(description_of(13, (6, 8), "uint16"), json.loads((array.path / "zarr.json").read_text()))
    assert (array.n_frames, FrameArray(array.path).n_frames) == (13, 13)
    array.resize(12)
    assert (array.n_frames, FrameArray(array.path).n_frames) == (12, 12)
    assert [chunk.n_bytes for chunk in stored] == [96, 96]
    assert array.checksum(10) == stored[0]
    assert not array.chunk_path(10).stat().st_mode & 0o111
    assert FrameArray.indices(array.path) == [2, 10]
    assert FrameArray.indices(tmp_path) == []
    assert not list(array.path.rglob("part"))
    half = array.chunk_path(5).with_name("part")
    half.parent.mkdir(parents=True)
    half.write_bytes(b"half")
    array.remove_half_written()
    assert not half.exists()
    for index, image in images.items():
        assert np.array_equal(array.read(index)[0], image)
        assert array.n_bytes(index) == 96
    array.chunk_path(2).write_bytes(bytes(40))
    with pytest.raises(FileError, match="has 40 bytes; frame 2 takes 96: it is damaged"):
        array.read(2)
    for index, image, words in (
        (12, images[2], "outside the array of 12"),
        (1, images[2].T, "stores uint16"),
    ):
        with pytest.raises(ValueError, match=words):
            array.write([(index, image)])


def test_an_arrays_name_is_on_the_disk_once_it_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is made under another name: what syncs the folder before knows that one alone."""
    synced: list[list[str]] = []
    monkeypatch.setattr(
        frame_array, "sync_folder", lambda path: synced.append([p.name for p in path.iterdir()])
    )
    FrameArray.create(
        tmp_path / "frames", n_frames=1, frame_shape=(6, 8), dtype="uint16", pixel_pitch_um=2.5, name="a"
    )
    assert synced == [["frames"]]


def test_frames_that_came_at_one_time_have_no_period() -> None:
    def period_s(*times_ns: int | None) -> float | None:
        metadata = [
            SimpleNamespace(host_time_ns=9 * n, device_time_ns=time) for n, time in enumerate(times_ns)
        ]
        records = {3 * n: SimpleNamespace(metadata=one) for n, one in enumerate(metadata)}
        run: Any = SimpleNamespace(plan=None, records=records)
        return Run.frame_period_s.fget(run)  # type: ignore[attr-defined]

    assert period_s(7, 7) is None
    assert period_s(7) is None
    assert period_s(0, 6_000_000) == pytest.approx(0.002)
    assert period_s(None, 6_000_000) == pytest.approx(3e-9)


def test_a_plan_without_slm_images_makes_no_folder_for_them_and_others_are_copied(tmp_path: Path) -> None:
    run, image = tmp_path / "run", tmp_path / "a.png"
    run.mkdir()
    bare = Plan(label="p", parts=(Part(label="a"),))
    assert writer.plan_with_copies(bare, run) == bare
    assert list(run.iterdir()) == []
    image.write_bytes(b"an image")
    (copy,) = writer.plan_with_copies(
        Plan(label="p", parts=(Part.model_validate({"label": "a", "slm_image": str(image)}),)), run
    ).slm_images
    assert not copy.is_absolute()
    assert (run / copy).read_bytes() == b"an image"


def test_a_broken_checkout_has_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(*_: object, **how: object) -> SimpleNamespace:
        assert (how["capture_output"], how["text"], how["check"]) == (True, True, True)
        return SimpleNamespace(stdout="abc-dirty\n")

    with monkeypatch.context() as answered:
        answered.setattr(writer.subprocess, "run", answer)
        assert writer.git_commit() == ("abc-dirty" if (Path(__file__).parents[3] / ".git").exists() else None)
    monkeypatch.setattr(writer, "__file__", str(tmp_path / "instrument" / "runs" / "writer.py"))
    assert writer.git_commit() is None
    (tmp_path / ".git").mkdir()
    assert writer.git_commit() is None


def test_a_closed_run_has_no_open_file_and_no_thread(tmp_path: Path) -> None:
    before = set(threading.enumerate())

    def left() -> tuple[list[str], list[str]]:
        """Return the files of this run, and the threads, that are there now: other tests may leave theirs."""
        threads = [t.name for t in set(threading.enumerate()) - before if t.name.startswith("sync")]
        return open_below(tmp_path), threads

    with RunWriter.create(tmp_path, label="r", bench=BENCH) as opened:
        opened.start()
        opened.write([frame(0)])
        opened.keep_text("more.txt", "what a routine knows")
        assert all(left())
    assert left() == ([], [])
    assert (opened.path / "more.txt").read_text() == "what a routine knows"


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "diffuserbench resume continues"),
        (errno.EROFS, "may write to"),
        (errno.EIO, "[.]$"),
        (None, "could not be written: None[.]$"),
    ],
)
def test_what_a_disk_refuses_is_said_with_what_to_do(number: int | None, remedy: str) -> None:
    refusal = OSError() if number is None else OSError(number, "no")
    with pytest.raises(RunError, match=remedy), writer._disk(Path("r"), "it could not be written"):
        raise refusal


def test_a_recording_that_ends_before_its_first_frame_has_none(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as opened:
        opened.start()
        run = opened.finish(FinishReason.COMPLETED)
    assert run.n_frames == 0
    assert run.missing() == []


def test_a_run_that_is_not_given_is_let_go_and_one_that_goes_on_ends_anew(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path / "a" / "b", label="r", bench=BENCH) as opened:
        opened.start()
        opened.write([frame(0)])
        path = opened.finish(FinishReason.STOPPED, "why").path
    with pytest.raises(RunError, match="was written to while it was looked at"):
        RunWriter.reopen(path, log_bytes=1)
    (path / "bench.toml").write_text("changed")
    for start, reason in ((False, FinishReason.STOPPED), (True, FinishReason.COMPLETED)):
        ended = Run.open(path).state["finished_utc"]
        with RunWriter.reopen(path, log_bytes=Run.open(path).log_bytes) as again:
            assert len(again.mended) == (not start)
            if start:
                again.start()
                state = Run.open(path).state
                assert (state["state"], state["reason"], state["error"]) == ("running", None, "")
                kept = list((path / "kept").rglob("*"))
                again.write([frame(0)])  # in its own place
                (image,) = (p for p in (path / "kept").rglob("*") if p not in kept and p.is_file())
                assert image.stat().st_size == frame(0).image.nbytes, "what it replaces is kept beside"
            state = again.finish(reason).state
        assert (state["finished_utc"] == ended) != start
        assert state["reason"] == reason
        assert Run.open(path).events[-1]["descriptions"] == Run.open(path).array.description_sums()
    assert len(list((path / "kept").iterdir())) == 2
    (path / "provenance.json").unlink()
    (path / "log.jsonl").write_bytes(b"")
    for _ in range(2):  # the first try leaves no lock
        with pytest.raises(RunError, match=r"provenance.json: is gone"):
            RunWriter.reopen(path)


def test_frames_of_one_batch_may_lie_far_apart_and_an_array_without_frames_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as opened:
        opened.write([frame(0)])
        opened.write([frame(300), frame(1)])
        assert verify(Run.open(opened.path)).frames == 3
    for plan, n_frames in ((None, 0), (Plan(label="p", parts=(Part(label="a", repeats=4),)), 4)):
        with RunWriter.create(tmp_path, label="q", bench=BENCH, plan=plan) as opened:
            with monkeypatch.context() as fails:
                fails.setattr("instrument.runs.log.AppendOnlyLog.append", lambda *_: 1 / 0)
                with pytest.raises(ZeroDivisionError):
                    opened.write([frame(2)])
            assert opened.finish(FinishReason.FAILED).array.n_frames == n_frames


@pytest.mark.parametrize(
    ("folder", "file", "error"),
    [
        (True, True, None),
        (None, True, None),
        (False, True, RunError),
        (True, False, RunError),
        (True, None, OSError),
    ],
)
def test_a_run_is_held_by_its_folder_and_its_file_or_where_folders_have_no_locks_by_its_file(
    folder: bool | None,
    file: bool | None,
    error: type[Exception] | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def lock(handle: int) -> bool:
        free = folder if Path(f"/proc/self/fd/{handle}").is_dir() else file
        if free is None:
            raise OSError(errno.ENOLCK, "no locks here")
        return free

    monkeypatch.setattr(writer, "lock", lock)
    with pytest.raises(error) if error else contextlib.nullcontext():
        held = writer.lock_run(tmp_path)
        assert len(open_below(tmp_path)) == 2
        held.close()
    assert not open_below(tmp_path)
    assert (tmp_path / "lock").exists() == (folder is not False)


def test_a_text_too_long_for_the_log_has_no_copy_and_no_log_no_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_files, "_LONGEST_COPY", 6)
    texts = {"as long": "\u00b5\u00b5\u00b5", "longer": "\u00b5\u00b5\u00b5!"}  # in bytes
    assert [line["name"] for line in run_files.copies_of(texts)] == ["as long"]
    assert run_files.log_size(tmp_path) == 0
    (tmp_path / "log.jsonl").write_text("12345")
    assert run_files.log_size(tmp_path) == 5


def test_a_frames_folders_are_synced_up_to_the_arrays_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[list[Path]] = []
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as opened:
        opened.start()
        opened.write([frame(0)])
        array = opened._array
        assert array is not None
        monkeypatch.setattr(array._sync, "folders", lambda folders: synced.append(list(folders)))
        opened.write([frame(1), frame(2)])
    top = array.path / "0" / "c"
    images = [array.chunk_path(index) for index in (1, 2)]
    assert set(synced[0]) == {f for image in images for f in image.parents if f.is_relative_to(top)}
    assert len(synced) == 1
    assert top in synced[0]


@pytest.mark.parametrize(("first", "made"), [(0, 256), (255, 256), (256, 257), (600, 601)])
def test_a_recordings_array_is_made_for_its_first_frames(tmp_path: Path, first: int, made: int) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as opened:
        opened.start()
        opened.write([frame(first)])
        assert opened._array is not None
        assert opened._array.n_frames == made


def test_images_without_a_line_in_the_log_are_an_array_as_it_says_itself(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as opened:
        opened.start()
        opened.write([frame(0)])
        path = opened.finish(FinishReason.STOPPED).path
    log = path / "log.jsonl"
    log.write_text("".join(line for line in log.read_text().splitlines(True) if "crc32" not in line))
    run = Run.open(path)
    assert not run.records
    assert run.array.frame_shape == frame(0).image.shape
    (path / "frames.ome.zarr" / "0" / "zarr.json").write_text("{}")
    with pytest.raises(RunError, match=r"frames.ome.zarr: is damaged"):
        _ = Run.open(path).array


def test_what_a_run_cannot_be_read_without_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with new_run(tmp_path) as opened:
        opened.start(steps=5)
        with pytest.raises(RunError, match="has no frames yet"):
            _ = Run.open(opened.path).array
        opened.write([frame(0)])
        path = opened.finish(FinishReason.STOPPED).path
    (path / "frames.ome.zarr" / "0" / "zarr.json").write_text("{}")
    assert Run.open(path).array.frame_shape == frame(0).image.shape

    def refuse(*_: object) -> None:
        raise ValueError("no frames have that shape")

    with monkeypatch.context() as damaged:
        damaged.setattr("instrument.runs.run.description_of", refuse)
        with pytest.raises(RunError, match=r"log.jsonl: is damaged: frame 0: no frames have that shape"):
            _ = Run.open(path).array
    log = path / "log.jsonl"
    (path / "plan.json").unlink()
    log.write_text("".join(line for line in log.read_text().splitlines(True) if '"plan.json"' not in line))
    with pytest.raises(RunError, match=r"plan.json: is gone, and the log has no copy of it"):
        _ = Run.open(path).plan


def test_a_recordings_damaged_frames_are_marked_as_lost_in_words(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, label="r", bench=BENCH) as opened:
        opened.start()
        opened.write([frame(0), frame(1)])
        assert opened.settle({}) == []
        (words,) = opened.settle({1: "damaged"})
        assert words == "marked as lost: frame 1"
