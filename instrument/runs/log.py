"""The log of a run: lines of JSON that are on the disk once they were appended, and those about frames."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivers.frame import FrameMetadata
from instrument.files.atomic import sync_folder
from instrument.files.record import plain, value_of


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
        return cls(
            index=int(line["index"]),
            n_bytes=int(line["n_bytes"]),
            crc32=int(line["crc32"], 16),
            average=int(line["average"]),
            metadata=value_of(FrameMetadata, line["metadata"], unknown),
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


Json = Mapping[str, Any]


class AppendOnlyLog:
    """A file of JSON lines that only ever grows.

    A line counts once :meth:`append` has returned. A crash can leave one torn line at the end; opening the
    log for writing removes it (``torn_bytes`` says how much that was).
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        try:
            _, whole = read_lines(path)
            self._size = whole
            self.torn_bytes = os.fstat(self._handle).st_size - whole
            if self.torn_bytes:
                os.ftruncate(self._handle, whole)
                os.fsync(self._handle)
            sync_folder(path.parent)
        except BaseException:
            os.close(self._handle)
            raise

    def append(self, records: Iterable[Json]) -> None:
        """Append records and wait until they are on the disk; all of them, or (raising) none."""
        text = "".join(json.dumps(record, ensure_ascii=False) + "\n" for record in records)
        data = text.encode()
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
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            os.close(handle)


def read_lines(path: Path) -> tuple[list[dict[str, Any]], int]:
    """Return a log's records and how many of the file's bytes they fill.

    Reading ends at the first line that is not whole: after a crash, that is the torn one at the end.
    """
    records: list[dict[str, Any]] = []
    whole = 0
    with path.open("rb") as file:
        for line in file:
            if not line.endswith(b"\n"):
                break
            try:
                record = json.loads(line)
            except ValueError:
                break
            if not isinstance(record, dict):
                break
            records.append(record)
            whole += len(line)
    return records, whole
