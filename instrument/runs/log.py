"""The log of a run: lines of JSON that are on the disk once they were appended, and those about frames.

Each line ends in the CRC-32 of what stands before it, so that a changed number is noticed like a broken line.
Lines without one are of runs made before there were any.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from drivers.frame import FrameMetadata
from instrument.files.atomic import sync_folder
from instrument.files.reading import parse_json, require_file, require_plausible, stored_bytes
from instrument.files.record import plain, value_of
from instrument.runs.run_files import RunError


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """A frame that is on the disk."""

    index: int
    """Place in the image array: index of the plan's step, or number of the recording's frame."""
    n_bytes: int
    crc32: int
    """Size and CRC-32 of its chunk's file."""
    average: int
    """Number of exposures whose mean it is."""
    metadata: FrameMetadata
    unknown: Mapping[str, Any] = field(default_factory=dict)
    """Metadata that a newer version of this program has added: kept, and not used."""

    def shape_and_type(self) -> tuple[tuple[int, ...], str]:
        """Return the image's shape, ``(height, width)`` or ``(height, width, 3)``, and its type.

        Raises ValueError when its size is no such image's.
        """
        height, width = (side // self.metadata.binning for side in self.metadata.roi[2:])
        for shape in ((height, width), (height, width, 3)):
            for kind in ("uint8", "uint16", "float32"):
                if 0 < self.n_bytes == math.prod(shape) * np.dtype(kind).itemsize:
                    return shape, kind
        raise ValueError(f"{self.n_bytes} bytes are no image of {height} x {width} pixels")

    def to_json(self) -> dict[str, Any]:
        """Return the log line."""
        return {
            "kind": "frame",
            "index": self.index,
            "n_bytes": self.n_bytes,
            "crc32": f"{self.crc32:08x}",
            "average": self.average,
            "metadata": {**plain(self.metadata), **self.unknown},
        }

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> FrameRecord:
        """Return what :meth:`to_json` wrote."""
        unknown: dict[str, Any] = {}
        metadata = value_of(FrameMetadata, line["metadata"], unknown)
        one = metadata
        whole = (*one.roi, one.binning, one.frame_id, one.host_time_ns, one.dropped_before)
        if not all(isinstance(number, int) for number in (*whole, one.device_time_ns or 0)):
            raise TypeError(f"not all of {whole} and {one.device_time_ns!r} are whole numbers")
        if metadata.binning < 1:
            raise ValueError(f"there is no binning {metadata.binning}")
        if not (isinstance(bits := metadata.significant_bits, int) and 1 <= bits <= 64):
            raise ValueError(f"no pixel has {bits!r} bits")
        return cls(
            index=int(line["index"]),
            n_bytes=int(line["n_bytes"]),
            crc32=int(line["crc32"], 16),
            average=int(line["average"]),
            metadata=metadata,
            unknown=unknown,
        )


@dataclass(frozen=True, slots=True)
class Gap:
    """Frames of a recording that are lost: those from ``first`` on, and why."""

    first: int
    """Number of the first frame lost."""
    by_device: int
    """Frames that the camera or its driver lost."""
    not_written: int
    """Frames that came while the disk was too slow."""

    @property
    def count(self) -> int:
        """Number of frames lost, all following each other."""
        return self.by_device + self.not_written

    def to_json(self) -> dict[str, Any]:
        """Return the log line."""
        return {"kind": "gap", **plain(self)}

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> Gap:
        """Return what :meth:`to_json` wrote."""
        return value_of(cls, line)


@dataclass(frozen=True, slots=True)
class Unlisted:
    """An image without the line that says what it is: found by ``resume``, and kept where it is."""

    index: int
    n_bytes: int
    crc32: str


@dataclass(frozen=True, slots=True)
class Lost:
    """A recording's frame that was stored, and is missing or damaged now."""

    index: int
    why: str


Json = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class BadLine:
    """A piece of a log that cannot be read, or is not as it was written."""

    number: int
    """Of the line in the file, from 1."""
    data: bytes

    @property
    def is_torn(self) -> bool:
        """Whether it is the half line that a crash left at the end."""
        return not self.data.endswith(b"\n")


_CLOSED = -1
GONE = "it was deleted or moved meanwhile"


class AppendOnlyLog:
    """A file of JSON lines that only ever grows.

    A line counts once :meth:`append` has returned. A crash can leave one torn line at the end; what is
    appended then begins on a line of its own.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            self._size = os.fstat(self._handle).st_size
            if self._size and os.pread(self._handle, 1, self._size - 1) != b"\n":
                self._size += os.write(self._handle, b"\n")
            sync_folder(path.parent)
        except BaseException:
            os.close(self._handle)
            raise

    def append(self, records: Iterable[Json]) -> None:
        """Append records and wait until they are on the disk; all of them, or (raising) none."""
        data = b"".join(log_line(record) for record in records)
        if not os.fstat(self._handle).st_nlink:  # what is written to it now nobody can read
            raise FileNotFoundError(errno.ENOENT, GONE, str(self.path))
        try:
            written = 0
            while written < len(data):
                written += os.write(self._handle, data[written:])
            os.fsync(self._handle)
        except BaseException:  # Ctrl-C too: half a line would hide all that follow it
            os.ftruncate(self._handle, self._size)
            raise
        self._size += len(data)

    def close(self) -> None:
        """Close the file; closing twice does nothing."""
        if self._handle != _CLOSED:
            handle, self._handle = self._handle, _CLOSED
            os.close(handle)


_SUM = "line_crc32"
_SUM_BEGINS = f', "{_SUM}": "'.encode()
_BEGINS = re.compile(rb'\{"kind": "')
_LONGEST_LINE = 1 << 26
"""Bytes; what is longer is no line of ours, and is read in pieces."""


def log_line(record: Json) -> bytes:
    """Return a record as its line in the log."""
    text = json.dumps(record, ensure_ascii=False).encode()
    return text[:-1] + b'%s%08x"}\n' % (_SUM_BEGINS, zlib.crc32(text))


@dataclass(frozen=True, slots=True)
class FrameLine:
    """A frame's line as it was written, by its checksum; what it says is read when it is asked for."""

    index: int
    line: bytes

    def record(self) -> FrameRecord:
        """Read it; raises LookupError, TypeError or ValueError where it says nothing of a frame."""
        return FrameRecord.from_json(parse_json(self.line))


class FrameRecords(MutableMapping[int, FrameRecord]):
    """Records by the frames' indices; of a log in ``path``. A hundred thousand are not read for one."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[int, FrameRecord | FrameLine] = {}

    def add(self, found: FrameRecord | FrameLine) -> None:
        """Take what a log says of a frame; the last counts."""
        self._known[found.index] = found

    def __getitem__(self, index: int) -> FrameRecord:
        found = self._known[index]
        if isinstance(found, FrameLine):
            try:
                found = found.record()
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                raise RunError(self._path, f"is damaged: frame {index}: {error!r}.") from error
            self._known[index] = found
        return found

    def __setitem__(self, index: int, record: FrameRecord) -> None:
        self._known[index] = record

    def __delitem__(self, index: int) -> None:
        del self._known[index]

    def __contains__(self, index: object) -> bool:
        return index in self._known

    def __iter__(self) -> Iterator[int]:
        return iter(self._known)

    def __len__(self) -> int:
        return len(self._known)


UNREAD = "unread"
_FRAME = re.compile(rb'\{"kind": "frame", "index": (\d{1,15}), ')


def _frame_line(line: bytes) -> FrameLine | None:
    """Return a frame's line that is as it was written; None for every other."""
    begins = _FRAME.match(line)
    if begins is None:
        return None
    before, _, digits = line.rpartition(_SUM_BEGINS)
    if digits != b'%08x"}\n' % zlib.crc32(b"}", zlib.crc32(before)):
        return None
    return FrameLine(int(begins[1]), line)


def read_lines(path: Path, *, unread: bool = False) -> tuple[list[dict[str, Any]], list[BadLine]]:
    """Return a log's records, and the pieces of it that are none.

    What a bad byte spoils is one record: where it joined two lines, both are told apart again. ``unread``:
    frames' lines whose checksums are right are not read; their records hold a :class:`FrameLine` as
    :data:`UNREAD`.
    """
    records: list[dict[str, Any]] = []
    bad: list[BadLine] = []
    require_plausible(path, require_file(path, error=RunError), stored_bytes(path), error=RunError)
    with path.open("rb") as file:
        for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), b""), start=1):
            if line.endswith(b"\r\n"):  # a program that copied it as text: what it says is whole
                line = line[:-2] + b"\n"
            if unread and (frame := _frame_line(line)) is not None:
                records.append({"kind": "frame", UNREAD: frame})
                continue
            record = _record(line) if line.endswith(b"\n") else None
            if record is not None:
                records.append(record)
                continue
            for piece in _pieces(line):
                record = _record(piece) if len(piece) < len(line) else None
                if record is not None:
                    records.append(record)
                else:
                    bad.append(BadLine(number, piece))
    return records, bad


def _pieces(line: bytes) -> Iterator[bytes]:
    """Cut a line where a record may begin within it."""
    starts = [0, *(found.start() for found in _BEGINS.finditer(line) if found.start() > 0), len(line)]
    return (line[a:b] for a, b in pairwise(starts))


def _record(line: bytes) -> dict[str, Any] | None:
    """Return a line's record; None where it is none, or not what was written."""
    end = line.rfind(b"}") + 1
    before, found, digits = line[: end - 1].rpartition(_SUM_BEGINS)
    text = before + b"}" if found else line[:end]
    if len(line) - end > 1 or (found and digits != b'%08x"' % zlib.crc32(text)):
        return None
    try:
        record = parse_json(text)
        if not found and isinstance(record, dict) and record.get("kind") == "frame":
            FrameRecord.from_json(record).shape_and_type()
    except (LookupError, TypeError, ValueError, AttributeError):
        return None
    return record if isinstance(record, dict) else None
