"""Reading a run: its plan, bench, state, log and frames.

The folder's format is in docs/reference/run-folder.md.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.frame import FrameMetadata
from drivers.registry.claim import is_locked
from instrument.files.errors import FileError
from instrument.files.reading import parse_json, read_bytes
from instrument.files.record import value_of
from instrument.plan import Plan, Step
from instrument.runs.frame_array import FrameArray, description_of
from instrument.runs.log import UNREAD, FrameLine, FrameRecord, FrameRecords, Gap, Lost, Unlisted, read_lines
from instrument.runs.run_files import (
    BENCH,
    FRAMES,
    LOCK,
    LOG,
    PLAN,
    PROVENANCE,
    RUN_STATE,
    STATE,
    RunError,
    RunFiles,
    is_run,
    log_size,
)
from recon.arrays import Array

if TYPE_CHECKING:
    import zarr

    from instrument.bench.photograph import Progress


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
    records : FrameRecords
        What the log says is on the disk, by frame index (that of the plan's step, or of the recording's
        frame).
    gaps : tuple of Gap
        Frames of a recording that the camera or the disk lost: they have an index, but no data.
    events : tuple of mapping
        The log's other lines: started, paused, resumed, finished ...
    state : mapping
        The fields of ``state.json``.
    unlisted : dict of int to Unlisted
        Images without a line about them, which ``resume`` found and kept: nothing is known of their making.
    lost : dict of int to Lost
        Frames of a recording that were stored, and that ``resume`` found missing or damaged.
    bad_lines : list of BadLine
        What cannot be read of the log.
    files : RunFiles
        The small files.
    state_problem : str
        What is wrong with ``state.json``, whose ``state`` is then the log's; otherwise empty.
    log_bytes : int
        The log's size when it was read.
    log_is_foreign : bool
        Whether ``log.jsonl`` is another run's; nothing is taken from it then.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.log_bytes = log_size(path)
        try:
            lines, self.bad_lines = read_lines(path / LOG, unread=True)
        except FileNotFoundError:
            lines, self.bad_lines = [], []
        self.files = RunFiles.of_log(path, lines)
        stored, state_problem = self._stored_state()
        self.log_is_foreign = self.files.log_is_foreign((stored or {}).get("id"))
        if self.log_is_foreign:
            lines, self.files = [], RunFiles(path)
        self.records = FrameRecords(path / LOG)
        self.unlisted: dict[int, Unlisted] = {}
        self.lost: dict[int, Lost] = {}
        gaps: list[Gap] = []
        events: list[Mapping[str, Any]] = []
        for line in lines:
            self._take(line, gaps, events)
        first = next(iter(self.records.values()), None)  # whoever wrote it wrote the others
        RUN_STATE.warn_unknown(path / LOG, sorted(first.unknown if first is not None else ()))
        self.gaps = tuple(gaps)
        self.events = tuple(events)
        self.state_problem = state_problem
        self.state: Mapping[str, Any] = stored if stored is not None else self.state_by_log()

    def _take(self, line: Mapping[str, Any], gaps: list[Gap], events: list[Mapping[str, Any]]) -> None:
        """Take what a line of the log says; of several about one frame the last counts."""
        match line.get("kind"):
            case "frame":
                found = line.get(UNREAD)
                record = found if isinstance(found, FrameLine) else FrameRecord.from_json(line)
                self.records.add(record)
                self.lost.pop(record.index, None)
                self.unlisted.pop(record.index, None)
            case "gap":
                gaps.append(Gap.from_json(line))
            case "lost":
                lost = value_of(Lost, _fields(line))
                self.lost[lost.index] = lost
                self.records.pop(lost.index, None)
                self.unlisted.pop(lost.index, None)
            case "unlisted":
                unlisted = value_of(Unlisted, _fields(line))
                self.unlisted[unlisted.index] = unlisted
            case _:
                events.append(line)

    def _stored_state(self) -> tuple[dict[str, Any] | None, str]:
        """Return what ``state.json`` says; None and why, where it says nothing that makes sense.

        Raises RunError when it is of a version that is not known.
        """
        try:
            found = parse_json(read_bytes(self.path / STATE, error=RunError))
        except FileNotFoundError:
            return None, "is gone"
        except ValueError as error:
            return None, f"is no valid JSON ({error})"
        kind = found.get("format") if isinstance(found, dict) else None
        if kind != RUN_STATE.name and not isinstance(kind, int):
            return None, "is no state of a run"
        state = RUN_STATE.checked(found, self.path / STATE)
        missing = [name for name in ("label", "simulated", "state", "started_utc") if name not in state]
        if missing:
            return None, f"lacks {', '.join(missing)}"
        if state["state"] == "finished" and state.get("reason") not in set(FinishReason):
            return None, f"names no reason for the end: {state.get('reason')!r:.40}"
        return state, ""

    def state_by_log(self) -> dict[str, Any]:
        """Return the state that the log and the other files tell of; raises RunError where they do not."""
        provenance = self.files.table(PROVENANCE)
        label = provenance.get("label", self.plan.label if self.plan is not None else self.path.name)
        state = {
            "label": label,
            "simulated": bool(provenance["simulated"]),
            "state": "running",
            "started_utc": provenance["utc"],
        }
        if "id" in provenance:
            state["id"] = provenance["id"]
        ends = [event for event in self.events if event.get("kind") in ("started", "finished")]
        last: Mapping[str, Any] = ends[-1] if ends else {}
        if last.get("kind") == "finished":
            state |= {
                "state": "finished",
                "reason": last["reason"],
                "error": last["error"],
                "finished_utc": last["utc"],
            }
        return state

    @classmethod
    def open(cls, path: Path | str) -> Run:
        """Open a run folder.

        Raises RunError when there is none, or it is not one of this program's.
        """
        path = Path(path)
        if not path.is_dir():
            found = "is no folder" if path.exists() else "no such folder"
            raise RunError(path, f"{found}; a run's folder is expected.", "diffuserbench list shows runs.")
        if not is_run(path):
            raise RunError(path, f"is no run folder: it has no {STATE}.", "diffuserbench list shows runs.")
        try:
            return cls(path)
        except PermissionError as error:
            raise RunError(error.filename or path, "may not be read (permission denied).") from None
        except (OSError, LookupError, TypeError, ValueError, AttributeError) as error:
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
    def is_being_written(self) -> bool:
        """Whether some program is at work on the run, so that a line of its log may be half there."""
        return self.condition is RunCondition.RUNNING

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
        if self.files.text(PLAN) is None:
            if any("steps" in event for event in self.events if event.get("kind") == "started"):
                raise RunError(path, "is gone, and the log has no copy of it.", "Put it back from a backup.")
            return None
        with RUN_STATE.damaged(path):
            plan, unknown = Plan.with_unknown(self.files.table(PLAN), path)
        RUN_STATE.warn_unknown(path, unknown)
        return plan.with_slm_images(lambda image: self.path / image)

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """Software versions, host, git commit, devices."""
        return self.files.table(PROVENANCE)

    @cached_property
    def bench(self) -> dict[str, Any]:
        """The bench's configuration as used, defaults included."""
        return self.files.table(BENCH)

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
        return max([*ends, *(index + 1 for index in (*self.records, *self.unlisted, *self.lost))], default=0)

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
        return FrameArray.is_there(self.path / FRAMES)

    @cached_property
    def array(self) -> FrameArray:
        """The stored frames.

        Raises RunError when there are none yet, or nothing says any more what they are.
        """
        if not self.has_frames:
            raise RunError(self.path, "has no frames yet.")
        first = next(iter(self.records.values()), None)
        try:
            array = FrameArray(self.path / FRAMES)
            if first is None or array.frame_bytes == first.n_bytes:
                return array
        except (OSError, LookupError, TypeError, ValueError, FileError) as error:
            if first is None:
                raise RunError(self.path / FRAMES, f"is damaged: {error}.") from error
        try:
            return FrameArray(self.path / FRAMES, description_of(self.n_frames, *first.shape_and_type()))
        except ValueError as error:
            raise RunError(self.path / LOG, f"is damaged: frame {first.index}: {error}.") from error

    @property
    def frames(self) -> zarr.Array[Any]:
        """The frames as a Zarr array ``(t, y, x)`` or ``(t, c, y, x)``, read when sliced.

        Frames that were never stored (:meth:`missing`) read as zeros, or NaN in a float32 run.
        """
        import zarr

        return zarr.open_array(self.path / FRAMES / "0", mode="r", zarr_format=3)

    def frame(self, index: int | Step) -> Array:
        """Return one stored frame, ``(height, width)`` or ``(height, width, 3)``.

        Raises RunError when it was not stored, or its checksum is not that of what was stored.
        """
        index = index.index if isinstance(index, Step) else index
        if index not in self.records and index not in self.unlisted:
            why = f"is lost: {self.lost[index].why}" if index in self.lost else "was not stored"
            raise RunError(self.path, f"frame {index} {why} ({self.condition}).")
        image, crc32 = self.array.read(index)
        if crc32 != (written := self._written(index)[1]):
            raise RunError(
                self.path,
                f"frame {index} is damaged: its file has the CRC-32 {crc32:08x}; written was {written:08x}.",
                "diffuserbench resume RUN takes it again; a recording's it marks as lost.",
            )
        return image

    def metadata(self, index: int | Step) -> FrameMetadata:
        """Return what is known about one stored frame."""
        return self.records[index.index if isinstance(index, Step) else index].metadata

    def steps(self, label: str | None = None) -> list[Step]:
        """Return the plan's steps, or those of one label, whether stored or not."""
        if self.plan is None:
            raise RunError(self.path, "is a recording; it has no plan.")
        return [step for step in self.plan.steps() if label in (None, step.label)]

    def images(self, label: str) -> Array:
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
        if not self.has_frames:
            return DamagedFrame(index, "the image array is gone")
        n_bytes, crc32 = self._written(index)
        there = self.array.n_bytes(index)
        if there is not None and there != n_bytes:
            return DamagedFrame(index, f"its file has {there} bytes; written were {n_bytes}")
        found = self.array.checksum(index)
        if found is None:
            return DamagedFrame(index, "its file is gone")
        if found.crc32 != crc32:
            return DamagedFrame(index, f"its file has the CRC-32 {found.crc32:08x}; written was {crc32:08x}")
        return None

    def _written(self, index: int) -> tuple[int, int]:
        """Return the size and the CRC-32 of a frame as it was written."""
        if (record := self.records.get(index)) is not None:
            return record.n_bytes, record.crc32
        return self.unlisted[index].n_bytes, int(self.unlisted[index].crc32, 16)

    def damaged(
        self, on_progress: Progress | None = None, *, read: bool = True, noted: Collection[int] = ()
    ) -> tuple[DamagedFrame, ...]:
        """Return the frames that are not as they were written.

        ``on_progress`` is called with frames read and frames to read. ``read``: False only looks at the
        files' sizes, and reads the ``noted`` ones, that an earlier reading found damaged.
        """
        checked = []
        listed = sorted({*self.records, *self.unlisted})
        for count, index in enumerate(listed, start=1):
            unread = not read and index not in noted and self.has_frames
            if unread and self.array.n_bytes(index) == self._written(index)[0]:
                continue
            checked.append(self.verify(index))
            if on_progress is not None:
                on_progress(count, len(listed))
        return tuple(frame for frame in checked if frame is not None)

    def without_a_line(self) -> list[int]:
        """Return the images on the disk that no line of the log is about, in order."""
        known = {*self.records, *self.unlisted, *self.lost}
        return [index for index in FrameArray.indices(self.path / FRAMES) if index not in known]

    def is_locked(self) -> bool:
        """Whether some program has the run open for writing: its folder is locked, or its file ``lock``."""
        return is_locked(self.path) or is_locked(self.path / LOCK)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r}, {self.condition}, {len(self.records)} of {self.n_frames} frames)"


def _fields(line: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in line.items() if name != "kind"}
