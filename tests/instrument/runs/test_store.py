"""What a run folder says is on the disk is on the disk, whole, and readable by others' tools."""

from __future__ import annotations

import errno
import json
import os
import signal
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from ome_zarr_models.v05 import Image

from drivers.frame import FrameMetadata
from instrument.files.atomic import write_json
from instrument.plan import Part, Plan
from instrument.runs.frame_array import FrameArray
from instrument.runs.inspection import run_paths, verify
from instrument.runs.log import AppendOnlyLog, BadLine, FrameRecord, Gap, read_lines
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_files import RunError
from instrument.runs.writer import BenchRecord, FrameToStore, RunWriter, free_name

BENCH = BenchRecord(
    {"bench": {"name": "b"}},
    '[bench]\nname = "b"\n',
    {"camera": "mock"},
    True,
    6.5,
    {"exposure_ms": 1.0, "gain": 1.0},
    {},
)


def metadata(frame_id: int = 0) -> FrameMetadata:
    return FrameMetadata(
        frame_id=frame_id,
        device_time_ns=123,
        host_time_ns=456,
        utc=datetime(2026, 1, 2, 3, 4, 5, 678, tzinfo=UTC),
        exposure_ms=10.0,
        gain=1.0,
        pixel_format="Mono12",
        significant_bits=12,
        black_level=30.0,
        roi=(0, 0, 6, 8),
        binning=1,
        stage_position={"z_um": 5.0},
        led_pattern="off",
    )


def frame(index: int, shape: tuple[int, ...] = (6, 8)) -> FrameToStore:
    image = np.random.default_rng(index).integers(0, 4096, shape).astype(np.uint16)
    return FrameToStore(index, image, metadata(index))


def plan(n: int = 5, average: int = 1) -> Plan:
    return Plan(label="a test", parts=(Part(label="psf", repeats=n, average=average),))


def new_run(tmp_path: Path, **changes: object) -> RunWriter:
    given = {"label": "a test", "bench": BENCH, "plan": plan()} | changes
    return RunWriter.create(tmp_path, **given)  # type: ignore[arg-type]


def test_frames_come_back_as_they_went_with_all_their_metadata(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.write([frame(0), frame(1)])
        writer.write([frame(4)])
        run = writer.finish(FinishReason.ABORTED)
    assert run.condition is RunCondition.ABORTED
    assert run.missing() == [2, 3]
    for index in (0, 1, 4):
        assert np.array_equal(run.frame(index), frame(index).image)
        assert run.metadata(index) == metadata(index)
        assert run.verify(index) is None
    with pytest.raises(RunError, match="frame 2 was not stored"):
        run.frame(2)
    assert run.plan == plan()
    assert run.is_simulated
    assert run.provenance["packages"]["numpy"]
    assert run.path.name.endswith("a-test")
    assert (run.path / "bench.toml").read_text() == BENCH.toml


@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 3)])
@pytest.mark.parametrize("average", [1, 2])
def test_others_tools_read_the_frames(tmp_path: Path, shape: tuple[int, ...], average: int) -> None:
    with new_run(tmp_path, plan=plan(3, average)) as writer:
        writer.write([frame(0, shape), frame(2, shape)])
        run = writer.finish(FinishReason.COMPLETED)
    group = zarr.open_group(run.path / "frames.ome.zarr", mode="r")
    described = json.loads((run.path / "frames.ome.zarr" / "zarr.json").read_text())
    assert (described["zarr_format"], described["node_type"]) == (3, "group")
    image = Image.from_zarr(group)
    axes = image.ome_attributes.multiscales[0].axes
    assert [axis.name for axis in axes] == (["t", "y", "x"] if len(shape) == 2 else ["t", "c", "y", "x"])
    assert [axis.unit for axis in axes][-1] == "micrometer"
    transform = image.ome_attributes.multiscales[0].datasets[0].coordinateTransformations[0]
    assert transform.scale[-2:] == (6.5, 6.5) or list(transform.scale[-2:]) == [6.5, 6.5]
    stored = np.asarray(zarr.open_array(run.path / "frames.ome.zarr" / "0", mode="r")[:])
    assert stored.dtype == (np.float32 if average > 1 else np.uint16)
    expected = np.moveaxis(frame(2, shape).image, -1, 0) if len(shape) == 3 else frame(2).image
    assert np.array_equal(stored[2], expected)
    assert np.array_equal(run.frames[2], expected)
    assert np.all(np.isnan(stored[1]) if average > 1 else stored[1] == 0)
    assert np.array_equal(run.frame(2), frame(2, shape).image)


def test_a_frame_that_changed_on_the_disk_is_found(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.write([frame(i) for i in range(5)])
        run = writer.finish(FinishReason.COMPLETED)
    chunk = run.array.chunk_path(1)
    data = bytearray(chunk.read_bytes())
    data[7] ^= 1
    chunk.write_bytes(data)
    run.array.chunk_path(2).write_bytes(b"short")
    run.array.chunk_path(3).unlink()
    problems = {index: run.verify(index) for index in range(5)}
    assert [index for index, problem in problems.items() if problem] == [1, 2, 3]
    assert "CRC-32" in str(problems[1])
    assert "5 bytes" in str(problems[2])
    assert "gone" in str(problems[3])


def test_a_run_left_open_is_running_then_crashed(tmp_path: Path) -> None:
    writer = new_run(tmp_path)
    assert Run.open(writer.path).condition is RunCondition.RUNNING
    writer.write([frame(0)])
    with pytest.raises(RunError, match="another program"):
        RunWriter.reopen(writer.path)
    writer.close()
    assert Run.open(writer.path).condition is RunCondition.CRASHED
    with RunWriter.reopen(writer.path) as again:
        again.write([frame(1)])
        run = again.finish(FinishReason.COMPLETED)
    assert run.condition is RunCondition.COMPLETED
    assert sorted(run.records) == [0, 1]


def test_a_torn_line_is_forgotten_and_the_next_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    log = AppendOnlyLog(path)
    log.append([{"a": 1}, {"a": 2}])
    log.close()
    whole = path.read_bytes()
    for torn in (b'{"a": 3', b'{"a": 3}', b"\0\0\0\0\n"):
        path.write_bytes(whole + torn)
        assert read_lines(path) == ([{"a": 1}, {"a": 2}], [BadLine(3, torn)])
        log = AppendOnlyLog(path)
        log.append([{"a": 4}])
        log.close()
        records, _ = read_lines(path)
        assert records[:2] == [{"a": 1}, {"a": 2}]
        assert records[-1] == {"a": 4}


def test_an_interrupted_append_leaves_nothing_and_loses_nothing_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.jsonl"
    log = AppendOnlyLog(path)
    log.append([{"a": 1}])
    for interruption in (KeyboardInterrupt(), OSError(5, "broken")):

        def fail(_: int, error: BaseException = interruption) -> None:
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", fail)
            with pytest.raises(type(interruption)):
                log.append([{"a": 2}])
        assert read_lines(path)[0] == [{"a": 1}]
    log.append([{"a": 3}])
    log.close()
    assert read_lines(path)[0] == [{"a": 1}, {"a": 3}]


def test_ctrl_c_between_an_image_and_its_line_waits_for_the_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = FrameArray.write

    def interrupted(self: FrameArray, *images: Any) -> Any:
        stored = write(self, *images)
        signal.raise_signal(signal.SIGINT)
        return stored

    monkeypatch.setattr(FrameArray, "write", interrupted)
    writer = new_run(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        writer.write([frame(0)])
    run = writer.finish(FinishReason.ABORTED)
    assert set(run.records) == {0}
    assert verify(run).is_sound


@pytest.mark.parametrize(
    ("why", "said"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device"),
            "frame 0 could not be stored: No space left on device",
        ),
        (MemoryError("Unable to allocate 1 GiB"), "Unable to allocate 1 GiB"),
    ],
)
def test_ctrl_c_while_a_frame_cannot_be_stored_is_answered_and_says_why(
    why: Exception, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)
        raise why

    with new_run(tmp_path) as writer:
        monkeypatch.setattr(FrameArray, "write", full)
        with pytest.raises(KeyboardInterrupt) as caught:
            writer.write([frame(0)])
    assert said in caught.value.__notes__[0]


def test_a_frame_of_another_shape_or_place_is_refused(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.write([frame(0)])
        for wrong in (frame(1, (6, 9)), frame(5)):
            with pytest.raises(RunError, match="does not take a frame"):
                writer.write([wrong])
        run = writer.finish(FinishReason.COMPLETED)
    assert sorted(run.records) == [0]


def test_a_name_that_is_taken_gets_a_number_and_two_runs_of_one_second_two_folders(tmp_path: Path) -> None:
    for name in ("a.txt", "a-2.txt", "a-3.txt"):
        path = free_name(tmp_path, "a", ".txt")
        assert path.name == name
        path.touch()
    paths = set()
    for _ in range(3):
        with new_run(tmp_path / "runs") as writer:
            paths.add(writer.path)
    assert set((tmp_path / "runs").iterdir()) == paths
    assert len(paths) == 3


def test_what_is_no_image_is_not_stored_and_hidden_runs_are_none(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.start()
        with pytest.raises((TypeError, RunError), match="float64"):
            writer.write([FrameToStore(0, np.zeros((6, 8)), metadata())])  # type: ignore[arg-type]
        writer.write([frame(0)])
        writer.finish(FinishReason.ABORTED)
    record = Run.open(writer.path).records[0]
    assert record.shape_and_type() == ((6, 8), "uint16")
    assert replace(record, n_bytes=6 * 8 * 3).shape_and_type() == ((6, 8, 3), "uint8")
    with pytest.raises(ValueError, match="95 bytes are no image of 6 x 8 pixels"):
        replace(record, n_bytes=95).shape_and_type()
    (tmp_path / "no run").mkdir()
    assert run_paths(tmp_path) == [writer.path]
    writer.path.rename(tmp_path / ".hidden")
    assert run_paths(tmp_path) == run_paths(tmp_path / "missing") == []


BINNED = FrameToStore(2, frame(2).image, replace(metadata(2), binning=2))
ODD = FrameToStore(1, frame(1).image, replace(metadata(1), binning=2, roi=(1, 1, 13, 17)))


@pytest.mark.parametrize(
    ("steps", "frames", "gaps", "problem"),
    [
        (plan(3), (0, ODD, 2), (), ""),
        (plan(2), (frame(0, (6, 8, 3)), frame(1, (6, 8, 3))), (), ""),
        (plan(5), (0, 2), (), "marked as completed, but frames 1, 3-4 are not there"),
        (plan(2, 2), (0, 1), (), "frame 0 averages 1, planned were 2; frame 1 averages 1, planned were 2"),
        (plan(3), (0, 1, BINNED), (), "frame 2: its region (0, 0, 6, 8) at binning 2 is not 6 x 8 pixels"),
        (None, (0, 3), ((1, 2),), ""),
        (None, (0, 1), ((2, 2),), ""),
        (None, (0, 1, 2), ((1, 1),), "frames 1 are both stored and lost"),
        (None, (0, 3), (), "frames 1-2 are neither stored nor accounted for as lost"),
        (None, (0, 4), ((1, 2),), "frames 3 are neither stored nor accounted for as lost"),
    ],
)
def test_what_a_run_says_against_itself_is_found(
    tmp_path: Path,
    steps: Plan | None,
    frames: tuple[int | FrameToStore, ...],
    gaps: tuple[tuple[int, int], ...],
    problem: str,
) -> None:
    with new_run(tmp_path, plan=steps) as writer:
        writer.start()
        writer.write([frame(n) if isinstance(n, int) else n for n in frames])
        for first, count in gaps:
            writer.gap(Gap(first, count, 0))
        open_yet = "; ".join(verify(Run.open(writer.path)).problems)
        writer.finish(FinishReason.COMPLETED)
    assert "; ".join(verify(Run.open(writer.path)).problems) == problem
    assert open_yet == ("" if problem.startswith("marked") else problem)
    if steps is None:
        Run.open(writer.path).array.resize(9)
        assert "the image array is for 9 frames, the log knows" in "".join(
            verify(Run.open(writer.path)).problems
        )


def test_what_is_no_run_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no such folder"):
        Run.open(tmp_path / "nowhere")
    with pytest.raises(RunError, match="is no run folder"):
        Run.open(tmp_path)
    with new_run(tmp_path) as writer:
        path = writer.path
    state = json.loads((path / "state.json").read_text())
    write_json(path / "state.json", state | {"format": 99})
    with pytest.raises(RunError, match=r"version 99 is not known.*Update"):
        Run.open(path)
    (path / "state.json").write_text("{")
    (path / "log.jsonl").unlink()
    (path / "provenance.json").write_text("{")
    with pytest.raises(RunError, match="damaged"):
        Run.open(path)


@pytest.mark.parametrize("bits", [12.5, 0, 10**9, "12"])
def test_a_line_with_a_number_of_bits_that_no_pixel_has_is_none(bits: object) -> None:
    line = FrameRecord(0, 4, 0, 1, metadata()).to_json()
    assert FrameRecord.from_json(line).metadata == metadata()
    with pytest.raises(ValueError, match="no pixel has"):
        FrameRecord.from_json({**line, "metadata": {**line["metadata"], "significant_bits": bits}})
