"""What a line of a run's log may say: which numbers are a frame's, and which pieces are lines."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from instrument.files.errors import FileError
from instrument.runs import log as log_module
from instrument.runs.log import (
    UNREAD,
    AppendOnlyLog,
    BadLine,
    FrameLine,
    FrameRecord,
    FrameRecords,
    Gap,
    log_line,
    read_lines,
)
from instrument.runs.run_files import RunError
from tests.instrument.files.test_atomic import open_below
from tests.instrument.runs.test_store import metadata

RECORD = FrameRecord(3, 96, 0xFF, 2, metadata(3))


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({}, None),
        ({"device_time_ns": None}, None),
        ({"device_time_ns": 0}, None),
        ({"device_time_ns": 1.5}, TypeError),
        ({"host_time_ns": 1.5}, TypeError),
        ({"frame_id": "3"}, TypeError),
        ({"dropped_before": None}, TypeError),
        ({"roi": [0, 0, 6, 8.5]}, TypeError),
        ({"roi": [0, 0, 6]}, ValueError),
        ({"binning": 1.0}, TypeError),
        ({"binning": 0}, ValueError),
        ({"binning": 2}, None),
        ({"significant_bits": 0}, ValueError),
        ({"significant_bits": 1}, None),
        ({"significant_bits": 64}, None),
        ({"significant_bits": 65}, ValueError),
        ({"significant_bits": 12.0}, ValueError),
    ],
)
def test_numbers_that_no_frame_has_are_refused(
    changes: dict[str, Any], error: type[Exception] | None
) -> None:
    line = RECORD.to_json()
    line["metadata"] |= changes
    if error is None:
        read = FrameRecord.from_json(line)
        assert read.to_json() == line
        assert (read.index, read.n_bytes, read.crc32, read.average) == (3, 96, 255, 2)
    else:
        with pytest.raises(error):
            FrameRecord.from_json(line)


@pytest.mark.parametrize(
    ("n_bytes", "binning", "shape", "kind"),
    [
        (48, 1, (6, 8), "uint8"),
        (96, 1, (6, 8), "uint16"),
        (192, 1, (6, 8), "float32"),
        (144, 1, (6, 8, 3), "uint8"),
        (288, 1, (6, 8, 3), "uint16"),
        (576, 1, (6, 8, 3), "float32"),
        (24, 2, (3, 4), "uint16"),
        (4, 4, (1, 2), "uint16"),
        (1, 6, (1, 1), "uint8"),
        (0, 1, None, ""),
        (0, 16, None, ""),  # of no height
        (4, 16, None, ""),
        (47, 1, None, ""),
        (49, 1, None, ""),
        (384, 1, None, ""),
    ],
)
def test_an_images_shape_and_type_follow_from_its_size(
    n_bytes: int, binning: int, shape: tuple[int, ...] | None, kind: str
) -> None:
    record = replace(RECORD, n_bytes=n_bytes, metadata=replace(metadata(), binning=binning))
    if shape is None:
        with pytest.raises(ValueError, match=f"{n_bytes} bytes are no image of"):
            record.shape_and_type()
    else:
        assert record.shape_and_type() == (shape, kind)


def test_lost_frames_of_both_kinds_are_counted() -> None:
    gap = Gap(7, 2, 3)
    assert gap.count == 5
    assert Gap.from_json({"first": 7, "by_device": 2, "not_written": 3}) == gap


NOTE = {"kind": "note", "text": "ä"}
FRAME = RECORD.to_json()
WITHOUT_SUM = b'{"kind": "note", "text": "old"}\n'
OLD = {"kind": "note", "text": "old"}
LARGE = FRAME | {"metadata": FRAME["metadata"] | {"binning": 0}}


@pytest.mark.parametrize(
    ("data", "records", "bad"),
    [
        (b"", [], []),
        (log_line(NOTE), [NOTE], []),
        (WITHOUT_SUM + log_line(NOTE), [OLD, NOTE], []),
        (log_line(NOTE)[:-1], [], [(1, 0)]),  # torn just before its end
        (log_line(NOTE) + b'{"kind": "no', [NOTE], [(2, 0)]),
        (log_line(NOTE).replace(b"n", b"m", 1), [], [(1, 0)]),
        (log_line(NOTE)[:-11] + b'00000000"}\n', [], [(1, 0)]),
        (log_line(NOTE)[:-1] + b" x\n" + log_line(FRAME), [FRAME], [(1, 0)]),
        (b"junk" + log_line(NOTE), [NOTE], [(1, 0)]),
        (b"?" + log_line(NOTE), [NOTE], [(1, 0)]),
        (log_line(FRAME) + log_line(NOTE) + log_line(FRAME), [FRAME, NOTE, FRAME], []),
        (log_line(FRAME).replace(b"96", b"97"), [], [(1, 0)]),
        (b"junk\n" + log_line(NOTE) + b"\n" + log_line(NOTE), [NOTE, NOTE], [(1, 0), (3, 0)]),
        (log_line(NOTE)[:-1] + log_line(FRAME), [NOTE, FRAME], []),
        (log_line(NOTE)[:-1] + b"?" + log_line(FRAME), [NOTE, FRAME], []),
        (log_line(NOTE)[:-1] + b"??" + log_line(FRAME), [FRAME], [(1, 0)]),
        (b'["kind"]\n', [], [(1, 0)]),
        (b'{"kind": "frame", "index": 1}\n', [], [(1, 0)]),  # no sum, and says nothing of a frame
    ],
)
def test_what_of_a_log_can_be_read_is_read_and_the_rest_is_kept(
    tmp_path: Path, data: bytes, records: list[dict[str, Any]], bad: list[tuple[int, int]]
) -> None:
    (tmp_path / "log").write_bytes(data)

    def told(record: dict[str, Any]) -> dict[str, Any]:
        found = record.get(UNREAD)
        record = found.record().to_json() if isinstance(found, FrameLine) else record
        return {name: value for name, value in record.items() if name != "line_crc32"}

    for unread in (False, True):
        found, pieces = read_lines(tmp_path / "log", unread=unread)
        assert [told(record) for record in found] == records
        assert [piece.number for piece in pieces] == [number for number, _ in bad]
        assert all(piece.data in data for piece in pieces)
        assert not any(UNREAD in record for record in found) or unread
    assert not BadLine(1, b"a\n").is_torn
    assert BadLine(1, b"a").is_torn


def test_only_whole_lines_of_frames_are_left_unread_and_a_hollow_log_is_not_read(tmp_path: Path) -> None:
    path, frame = tmp_path / "log", log_line(FRAME)
    path.write_bytes(frame + log_line(NOTE) + frame + frame.replace(b"96", b"97") + frame[:-1])
    found, bad = read_lines(path, unread=True)
    assert [record.get(UNREAD) for record in found] == [FrameLine(3, frame), None, FrameLine(3, frame)]
    assert [piece.number for piece in bad] == [4, 5]
    os.truncate(path, 10 << 30)
    with pytest.raises(FileError, match="made to fill the memory"):
        read_lines(path)


def test_a_frames_line_is_read_when_it_is_asked_for_and_named_where_it_says_nothing(tmp_path: Path) -> None:
    records = FrameRecords(tmp_path / "log.jsonl")
    records.add(FrameLine(3, log_line(FRAME)))
    records.add(FrameLine(4, log_line(LARGE)))
    records[5] = replace(RECORD, index=5)
    assert (sorted(records), len(records), 4 in records, 6 in records) == ([3, 4, 5], 3, True, False)
    assert records[3] == RECORD
    assert records[3] is records[3]
    with pytest.raises(RunError, match=r"log.jsonl: is damaged: frame 4: ValueError.*no binning 0"):
        records[4]
    del records[4]
    assert sorted(records) == [3, 5]


def test_a_log_only_grows_by_whole_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"torn")
    syncs: list[Path] = []
    monkeypatch.setattr(log_module, "sync_folder", syncs.append)
    log = AppendOnlyLog(path)
    assert syncs == [tmp_path]
    first, second, third = ({"kind": "note", "text": text} for text in ("räume", "b", "c"))
    log.append([first, second])
    whole = b"torn\n" + log_line(first) + log_line(second)
    assert path.read_bytes() == whole
    assert "räume".encode() in whole
    write, synced = os.write, []
    monkeypatch.setattr(os, "fsync", synced.append)
    monkeypatch.setattr(os, "write", lambda handle, data: write(handle, data[:7]))  # a few bytes at a time
    log.append([third])
    whole += log_line(third)
    assert (path.read_bytes(), len(synced)) == (whole, 1)
    monkeypatch.setattr(os, "fsync", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        log.append([first])
    assert path.read_bytes() == whole  # all of them or none
    path.unlink()
    with pytest.raises(FileNotFoundError, match="was deleted or moved meanwhile"):
        log.append([first])
    handle = log._handle
    for _ in range(2):
        log.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(handle)
    monkeypatch.undo()
    for before, after in ((b"", b""), (b"whole\n", b"whole\n")):
        path.write_bytes(before)
        AppendOnlyLog(path).close()
        assert path.read_bytes() == after
        assert not path.stat().st_mode & 0o111
    path.unlink()
    monkeypatch.setattr(log_module, "sync_folder", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        AppendOnlyLog(path)
    assert not open_below(tmp_path)
    assert not path.stat().st_mode & 0o111
