"""The log's lines about frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.frame import FrameMetadata
from instrument.files.record import plain, value_of


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """A frame that is on the disk.

    Attributes
    ----------
    index : int
        Place in the image array: index of the plan's step, or number of the recording's frame.
    n_bytes, crc32 : int
        Size and CRC-32 of its chunk's file.
    average : int
        Number of exposures whose mean it is.
    metadata : FrameMetadata
    unknown : mapping
        Metadata that a newer version of this program has added: kept, and not used.
    """

    index: int
    n_bytes: int
    crc32: int
    average: int
    metadata: FrameMetadata
    unknown: Mapping[str, Any] = field(default_factory=dict)

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
    """Frames of a recording that are lost: those from ``first`` on, and why.

    Attributes
    ----------
    first : int
        Number of the first frame lost.
    by_device : int
        Frames that the camera or its driver lost.
    not_written : int
        Frames that came while the disk was too slow.
    """

    first: int
    by_device: int
    not_written: int

    @property
    def count(self) -> int:
        """Number of frames lost, all following each other."""
        return self.by_device + self.not_written

    def to_json(self) -> dict[str, Any]:
        """Return the log line."""
        return {
            "kind": "gap",
            "first": self.first,
            "by_device": self.by_device,
            "not_written": self.not_written,
        }

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> Gap:
        """Return what :meth:`to_json` wrote."""
        return cls(int(line["first"]), int(line["by_device"]), int(line["not_written"]))
