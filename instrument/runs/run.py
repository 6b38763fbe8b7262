"""Reading a run: its plan, bench, state, log and frames.

The folder's format is in docs/reference/run-folder.md.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drivers.frame import FrameMetadata
from instrument.files.errors import FileError
from instrument.files.record import RecordFormat
from instrument.plan import Plan, Step
from instrument.runs.frame_array import FrameArray, StoredChunk
from instrument.runs.log import FrameRecord, Gap, read_lines

if TYPE_CHECKING:
    import zarr

    from instrument.bench.photograph import Progress


PLAN, BENCH, PROVENANCE, STATE = "plan.json", "bench.json", "provenance.json", "state.json"
BENCH_TOML, LOG, FRAMES, LOCK = "bench.toml", "log.jsonl", "frames.ome.zarr", "lock"
SLM_IMAGES = "slm"


class FinishReason(StrEnum):
    """Why a run ended."""

    COMPLETED = "completed"
    """Every step was done."""
    ABORTED = "aborted"
    """Somebody ended it between two steps, or with Ctrl-C or SIGTERM."""
    STOPPED = "stopped"
    """STOP was pressed."""
    FAILED = "failed"
    """A device, the disk or the program failed."""


class RunCondition(StrEnum):
    """What a run folder is, seen from outside."""

    RUNNING = "running"
    """A program is writing to it now."""
    CRASHED = "crashed"
    """The program that wrote to it ended without finishing it (kill, power cut)."""
    COMPLETED = "completed"
    ABORTED = "aborted"
    STOPPED = "stopped"
    FAILED = "failed"


class RunError(FileError):
    """A run folder that cannot be used as asked."""


RUN_STATE = RecordFormat("diffuserbench run", "run's state", error=RunError, numbered_before=True)
"""``state.json``; its version is that of the whole folder."""


@dataclass(frozen=True, slots=True)
class DamagedFrame:
    """A frame that the log calls written and that is not as it was written."""

    index: int
    problem: str


class Run:
    """A run folder, for reading. Nothing is changed; a run may be read while it is being written.

    Use :meth:`open`. ``records`` and ``state`` are read at once and stay as they were; open the run again
    to see more.

    Attributes
    ----------
    path : Path
    records : dict of int to FrameRecord
        What the log says is on the disk, by frame index (that of the plan's step, or of the recording's
        frame).
    gaps : tuple of Gap
        Frames of a recording that the camera or the disk lost: they have an index, but no data.
    events : tuple of mapping
        The log's other lines: started, paused, resumed, finished ...
    state : mapping
        The fields of ``state.json``.
    torn_bytes : int
        Length of the half line that a crash left at the end of the log.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.state: Mapping[str, Any] = RUN_STATE.read(path / STATE)
        size = (path / LOG).stat().st_size
        lines, whole = read_lines(path / LOG)
        self.torn_bytes = max(0, size - whole)
        self.records: dict[int, FrameRecord] = {}
        gaps: list[Gap] = []
        events: list[Mapping[str, Any]] = []
        for line in lines:
            if line.get("kind") == "frame":
                record = FrameRecord.from_json(line)
                self.records[record.index] = record
            elif line.get("kind") == "gap":
                gaps.append(Gap.from_json(line))
            else:
                events.append(line)
        RUN_STATE.warn_unknown(
            path / LOG, sorted({name for r in self.records.values() for name in r.unknown})
        )
        self.gaps = tuple(gaps)
        self.events = tuple(events)

    @classmethod
    def open(cls, path: Path | str) -> Run:
        """Open a run folder.

        Raises RunError when there is none, or it is not one of this program's.
        """
        path = Path(path)
        if not path.is_dir():
            raise RunError(path, "no such folder." if not path.exists() else "is no folder.")
        if not (path / STATE).is_file():
            raise RunError(path, f"is no run folder: it has no {STATE}.", "diffuserbench list shows runs.")
        try:
            return cls(path)
        except PermissionError as error:
            raise RunError(error.filename or path, "may not be read (permission denied).") from None
        except (FileNotFoundError, KeyError, TypeError, ValueError) as error:
            raise RunError(path, f"is damaged: {error!r}.") from error

    # What it is ----------------------------------------------------------------------------------
    @property
    def label(self) -> str:
        """The run's label."""
        return str(self.state["label"])

    @property
    def condition(self) -> RunCondition:
        """Whether the run is being written, crashed, or how it finished."""
        if self.state["state"] == "finished":
            return RunCondition(self.state["reason"])
        return RunCondition.RUNNING if self.is_locked() else RunCondition.CRASHED

    @property
    def reason(self) -> FinishReason | None:
        """Why the run ended; None while it runs or when it crashed."""
        return FinishReason(self.state["reason"]) if self.state["state"] == "finished" else None

    @property
    def error(self) -> str:
        """What went wrong in a failed run, in words; otherwise empty."""
        return str(self.state.get("error", ""))

    @property
    def is_simulated(self) -> bool:
        """Whether any device behind it was simulated."""
        return bool(self.state["simulated"])

    @cached_property
    def plan(self) -> Plan | None:
        """The plan; None for a recording."""
        path = self.path / PLAN
        if not path.exists():
            return None
        with RUN_STATE.damaged(path):
            plan, unknown = Plan.with_unknown(self._json(PLAN), path)
        RUN_STATE.warn_unknown(path, unknown)
        return plan.with_slm_images(lambda image: self.path / image)

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """Software versions, host, git commit, devices."""
        return self._json(PROVENANCE)

    @cached_property
    def bench(self) -> dict[str, Any]:
        """The bench's configuration as used, defaults included."""
        return self._json(BENCH)

    @property
    def start(self) -> Step:
        """The bench's state before the first step, as far as a plan may leave it as it is."""
        camera, stage = self.provenance["camera"], self.provenance["stage"]
        exposure_ms, gain = camera["exposure_ms"], camera["gain"]
        return Step(
            index=-1, part=-1, repeat=0, label="start", stage=stage, exposure_ms=exposure_ms, gain=gain
        )

    # Frames --------------------------------------------------------------------------------------
    @property
    def n_frames(self) -> int:
        """Number of frames: those of the plan, or those of a recording with its gaps."""
        if self.plan is not None:
            return len(self.plan)
        ends = [gap.first + gap.count for gap in self.gaps]
        return max([*ends, *(index + 1 for index in self.records)], default=0)

    @property
    def frame_period_s(self) -> float | None:
        """Mean time from frame to frame, lost ones counted; None where that means nothing."""
        if self.plan is not None or len(self.records) < 2:
            return None
        first, last = min(self.records), max(self.records)
        began, ended = self.records[first].metadata, self.records[last].metadata
        span_ns = ended.host_time_ns - began.host_time_ns
        if began.device_time_ns is not None and ended.device_time_ns is not None:
            span_ns = ended.device_time_ns - began.device_time_ns
        return span_ns / (last - first) / 1e9 if span_ns > 0 else None

    @property
    def has_frames(self) -> bool:
        """Whether any frame was ever stored."""
        return (self.path / FRAMES / "zarr.json").exists()

    @cached_property
    def array(self) -> FrameArray:
        """The stored frames."""
        if not self.has_frames:
            raise RunError(self.path, "has no frames yet.")
        return FrameArray(self.path / FRAMES)

    @property
    def frames(self) -> zarr.Array[Any]:
        """The frames as a Zarr array ``(t, y, x)`` or ``(t, c, y, x)``, read when sliced.

        Frames that were never stored (:meth:`missing`) read as zeros, or NaN in a float32 run.
        """
        import zarr

        return zarr.open_array(self.path / FRAMES / "0", mode="r", zarr_format=3)

    def frame(self, index: int | Step) -> npt.NDArray[Any]:
        """Return one stored frame, ``(height, width)`` or ``(height, width, 3)``.

        Raises RunError when it was not stored.
        """
        index = index.index if isinstance(index, Step) else index
        if index not in self.records:
            raise RunError(self.path, f"frame {index} was not stored ({self.condition}).")
        return self.array.read(index)

    def metadata(self, index: int | Step) -> FrameMetadata:
        """Return what is known about one stored frame."""
        return self.records[index.index if isinstance(index, Step) else index].metadata

    def steps(self, label: str | None = None) -> list[Step]:
        """Return the plan's steps, or those of one label, whether stored or not."""
        if self.plan is None:
            raise RunError(self.path, "is a recording; it has no plan.")
        return [step for step in self.plan.steps() if label in (None, step.label)]

    def images(self, label: str) -> npt.NDArray[Any]:
        """Return the frames of all steps of one label, stacked along the first axis.

        Raises RunError when there are none, or one was not stored.
        """
        steps = self.steps(label)
        if not steps:
            raise RunError(self.path, f"its plan has no steps labelled {label!r}.")
        return np.stack([self.frame(step) for step in steps])

    def missing(self) -> list[int]:
        """Return the frames that have a place but no data, in order: undone steps, a recording's gaps."""
        return [index for index in range(self.n_frames) if index not in self.records]

    def verify(self, index: int) -> DamagedFrame | None:
        """Read a recorded frame's file and hold it against the log; None when it is as it was written."""
        record = self.records[index]
        if not self.has_frames:
            return DamagedFrame(index, "the image array is gone")
        found = self.array.checksum(index)
        if found is None:
            return DamagedFrame(index, "its file is gone")
        if found != StoredChunk(record.n_bytes, record.crc32):
            return DamagedFrame(
                index,
                f"its file has {found.n_bytes} bytes and CRC-32 {found.crc32:08x}; "
                f"written were {record.n_bytes} bytes and {record.crc32:08x}",
            )
        return None

    def damaged(self, on_progress: Progress | None = None) -> tuple[DamagedFrame, ...]:
        """Read every recorded frame; return those that are not as they were written.

        ``on_progress`` is called with frames read and frames to read.
        """
        found = []
        for count, index in enumerate(sorted(self.records), start=1):
            found.append(self.verify(index))
            if on_progress is not None:
                on_progress(count, len(self.records))
        return tuple(frame for frame in found if frame is not None)

    def is_locked(self) -> bool:
        """Whether some program has the run open for writing."""
        try:
            handle = os.open(self.path / LOCK, os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(handle)
        return False

    def _json(self, name: str) -> dict[str, Any]:
        found = json.loads((self.path / name).read_text())
        if not isinstance(found, dict):
            raise ValueError(f"{name} holds no table")
        return found

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r}, {self.condition}, {len(self.records)} of {self.n_frames} frames)"
