"""Writing a run: the one owner of a run folder, which it makes, names and locks."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import re
import secrets
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

import numpy as np

from drivers.frame import FrameMetadata
from drivers.registry.claim import lock
from instrument.files.atomic import (
    clear_left,
    draft_folder,
    json_text,
    make_folder,
    sync_folder,
    write_bytes,
    write_json,
)
from instrument.files.record import plain
from instrument.plan import Plan
from instrument.runs.frame_array import FrameArray
from instrument.runs.frame_facts import descriptions
from instrument.runs.interrupts import interrupts_held
from instrument.runs.log import AppendOnlyLog, FrameRecord, Gap, log_line
from instrument.runs.repair import keep_beside, mend_files, settle_recording
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import (
    BENCH,
    BENCH_TOML,
    FRAMES,
    LOCK,
    LOG,
    PLAN,
    PROVENANCE,
    RUN_STATE,
    SLM_IMAGES,
    STATE,
    RunError,
    copies_of,
    log_size,
    refuse_within,
    slm_image_name,
)
from recon.arrays import Array

_PACKAGES = ("diffuserbench", "numpy", "scipy", "opencv-python-headless", "pydantic")


def provenance() -> dict[str, Any]:
    """Return what identifies the software and the machine, JSON-compatible."""
    return {
        "utc": datetime.now(UTC).isoformat(),
        "host": socket.gethostname(),
        "platform": platform.platform(),
        "python": sys.version.split()[0],
        "packages": {name: _version(name) for name in _PACKAGES},
        "git_commit": git_commit(),
        "command": sys.argv,
    }


def git_commit() -> str | None:
    """Return the commit of this program's checkout (``-dirty`` when changed), None outside one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        answer = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--match="],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


@contextlib.contextmanager
def _disk(path: Path, what: str) -> Iterator[None]:
    """Say what could not be done where the disk refuses it, and what to do about that."""
    remedies = {
        **dict.fromkeys(
            _FULL,
            "Free some disk space; diffuserbench resume continues a plan's run, and closes a recording.",
        ),
        **dict.fromkeys(_FORBIDDEN, "Choose a folder that you may write to."),
    }
    try:
        yield
    except OSError as error:
        remedy = remedies.get(error.errno or 0, "")
        raise RunError(path, f"{what}: {error.strerror}.", remedy) from error


_FULL, _FORBIDDEN = (errno.ENOSPC, errno.EDQUOT), (errno.EACCES, errno.EPERM, errno.EROFS)
_FIRST_CAPACITY = 256
"""Frames that a recording's array is made for at first; it doubles as needed."""


@dataclass(frozen=True, slots=True)
class FrameToStore:
    """A frame on its way to the disk."""

    index: int
    image: Array
    metadata: FrameMetadata
    average: int = 1


@dataclass(frozen=True, slots=True)
class BenchRecord:
    """What a run keeps about its bench.

    ``config`` is everything as used, ``toml`` the text of the file; ``devices`` who each device says it is;
    ``camera`` the camera's settings and ``stage`` the stage's position when the run was made.
    """

    config: Mapping[str, Any]
    toml: str
    devices: Mapping[str, str]
    simulated: bool
    pixel_pitch_um: float
    camera: Mapping[str, Any]
    stage: Mapping[str, float]


class RunWriter:
    """A run folder open for writing, locked against a second writer.

    :meth:`create` or :meth:`reopen` one, :meth:`write` frames, :meth:`finish`. A frame for which ``write``
    has returned is on the disk with its metadata, and survives ``kill -9`` and a power cut.

    Attributes
    ----------
    mended : tuple of str
        What :meth:`reopen` did to the run's files, in words.
    """

    def __init__(self, path: Path, held: contextlib.ExitStack) -> None:
        self.path = path
        self.mended: tuple[str, ...] = ()
        self._held = held
        try:
            run = Run.open(path)
            self._state = dict(run.state)
            self._is_recording = run.plan is None
            self._n_frames = len(run.plan) if run.plan is not None else 0
            self._float = run.plan is not None and run.plan.averages
            self._pixel_pitch_um = float(run.provenance["pixel_pitch_um"])
            self._array: FrameArray | None = run.array if run.has_frames else None
            self._log = AppendOnlyLog(path / LOG)
        except BaseException:
            held.close()
            raise

    @classmethod
    def create(
        cls,
        parent: Path | str,
        *,
        label: str,
        bench: BenchRecord,
        plan: Plan | None = None,
        calibrations: Sequence[str] = (),
    ) -> RunWriter:
        """Make a new run folder in ``parent``, named by date, time and label.

        The folder appears under its name only when it is whole.

        Raises RunError when the folder cannot be written to, or is within another run.
        """
        parent = Path(parent)
        refuse_within(parent)
        with _disk(parent, "no run can be kept there"):
            parent.mkdir(parents=True, exist_ok=True)
            path = free_name(parent, dated_name(label))
            with draft_folder(path, locked=False) as draft, contextlib.ExitStack() as locks:
                locks.push(lock_run(draft))
                facts, identity = plain(bench), {"id": secrets.token_hex(8), "label": label}
                texts = {
                    BENCH: json_text(facts.pop("config")),
                    BENCH_TOML: facts.pop("toml"),
                    PROVENANCE: json_text(
                        {**identity, **provenance(), **facts, "calibrations": list(calibrations)}
                    ),
                }
                if plan is not None:
                    texts[PLAN] = plan_with_copies(plan, draft).to_json()
                for name, text in texts.items():
                    write_bytes(draft / name, text.encode())
                state = {
                    **identity,
                    "simulated": bench.simulated,
                    "state": "running",
                    "started_utc": datetime.now(UTC).isoformat(),
                    "pid": os.getpid(),
                }
                write_json(draft / STATE, RUN_STATE.stamped(state))
                write_bytes(draft / LOG, b"".join(map(log_line, copies_of(texts))))
                draft.rename(path)
                held = locks.pop_all()
            sync_folder(parent)
        return cls(path, held)

    @classmethod
    def reopen(cls, path: Path | str, *, log_bytes: int | None = None) -> RunWriter:
        """Open a run folder to continue it; its damaged files are made again (``mended`` says which).

        ``log_bytes`` is the log's size when the run was looked at: what was found then still holds.

        Raises RunError when it is no run, some program writes to it now or has since it was looked at, or its
        log is another run's.
        """
        path = Run.open(path).path
        with _disk(path, "cannot be continued"):
            held = lock_run(path)
            try:
                if log_bytes not in (None, log_size(path)):
                    raise RunError(path, "was written to while it was looked at.", "Try once more.")
                clear_left(path, again=True)
                mended = mend_files(path)
            except BaseException:
                held.close()
                raise
            writer = cls(path, held)
            writer.mended = tuple(mended)
        return writer

    def start(self, **fields: Any) -> None:
        """Note that frames are coming, now or again; ``fields`` go into the log."""
        self.note("started", **fields)
        self._set_state(state="running", reason=None, error="", pid=os.getpid())

    # Writing -------------------------------------------------------------------------------------
    def write(self, frames: Sequence[FrameToStore]) -> None:
        """Store frames with their metadata, and return once all of it is on the disk.

        Ctrl-C and SIGTERM wait until the frames have their lines, or cannot have them.

        Raises RunError when the disk is full or not writable, or a frame does not fit the run. What was on
        the disk before stays.
        """
        if not frames:
            return
        try:
            with interrupts_held() as held:
                self._store(frames)
        except Exception as error:
            held.answer(str(error))
            raise
        held.answer()

    def _store(self, frames: Sequence[FrameToStore]) -> None:
        try:
            with _disk(self.path, f"frame {frames[0].index} could not be stored"):
                array = self._array or self._make_array(frames)
                if self._is_recording and (last := max(f.index for f in frames)) >= array.n_frames:
                    array.resize(max(last + 1, 2 * array.n_frames))
                self._keep_images(array, frames)
                images = [(f.index, f.image.astype(np.float32) if self._float else f.image) for f in frames]
                stored = array.write(images)
                self._log.append(
                    FrameRecord(f.index, chunk.n_bytes, chunk.crc32, f.average, f.metadata).to_json()
                    for f, chunk in zip(frames, stored, strict=True)
                )
        except ValueError as error:
            raise RunError(self.path, f"does not take a frame: {error}") from error

    def _keep_images(self, array: FrameArray, frames: Sequence[FrameToStore]) -> None:
        """Keep beside what these frames are about to take the place of."""
        for frame in frames:
            image = array.chunk_path(frame.index)
            if os.path.lexists(image):  # a folder or a pipe, too
                keep_beside(self.path, str(image.relative_to(self.path)))

    def keep_text(self, name: str, text: str) -> None:
        """Write one more small file of the run, with its copy in the log."""
        with _disk(self.path, f"{name} could not be written"):
            write_bytes(self.path / name, text.encode())
        for copy in copies_of({name: text}):
            self._append(copy)

    def settle(self, damaged: Mapping[int, str]) -> list[str]:
        """Say in a recording's log what became of damaged frames (why, by frame) and of unlisted images."""
        with _disk(self.path, "its log could not be written"):
            return settle_recording(Run.open(self.path), self._log, damaged)

    def note(self, kind: str, **fields: Any) -> None:
        """Append an event to the log; ``utc`` is added."""
        self._append({"kind": kind, "utc": datetime.now(UTC).isoformat(), **fields})

    def gap(self, gap: Gap) -> None:
        """Append a gap of a recording to the log."""
        self._append(gap.to_json())

    def _describe(self) -> None:
        """Let the array say what the log tells of its frames; a recording's has as many as there are."""
        if self._array is None:
            return
        run = Run.open(self.path)
        if run.records:
            self._array.describe(*descriptions(run, run.n_frames))
        elif run.plan is None:
            self._array.resize(run.n_frames)

    def finish(self, reason: FinishReason, error: str = "") -> Run:
        """Say how the run ended, close its files, and return it for reading.

        A run that ended before, and was only mended, keeps the time of its end.
        """
        utc = datetime.now(UTC).isoformat()
        if self._state["state"] == "finished":
            utc = self._state.get("finished_utc", utc)
        ended = {"reason": reason.value, "error": error}
        try:
            with _disk(self.path, "its array could not be described"):
                self._describe()
            sums = self._array.description_sums() if self._array is not None else {}
            self.note("finished", **ended, descriptions=sums, utc=utc)
            self._set_state(state="finished", **ended, finished_utc=utc)
        finally:
            self.close()
        return Run.open(self.path)

    def close(self) -> None:
        """Close the run's files and release its lock, without finishing it; closing twice does nothing."""
        self._log.close()
        if self._array is not None:
            self._array.close()
        self._held.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Inside --------------------------------------------------------------------------------------
    def _make_array(self, frames: Sequence[FrameToStore]) -> FrameArray:
        first = frames[0]
        n_frames = max(_FIRST_CAPACITY, frames[-1].index + 1) if self._is_recording else self._n_frames
        self._array = FrameArray.create(
            self.path / FRAMES,
            n_frames=n_frames,
            frame_shape=first.image.shape,
            dtype=np.float32 if self._float else first.image.dtype,
            pixel_pitch_um=self._pixel_pitch_um,
            name=str(self._state["label"]),
        )
        return self._array

    def _append(self, record: Mapping[str, Any]) -> None:
        with _disk(self.path, "its log could not be written"):
            self._log.append([record])

    def _set_state(self, **changes: Any) -> None:
        with _disk(self.path, "its state could not be written"):
            write_json(self.path / STATE, RUN_STATE.stamped(self._state | changes))
        self._state.update(changes)


def plan_with_copies(plan: Plan, folder: Path) -> Plan:
    """Copy a plan's SLM images into a folder, so that the run can be continued and understood later."""
    if plan.slm_images:
        make_folder(folder / SLM_IMAGES)
    copies: dict[Path, Path] = {}
    for path in plan.slm_images:
        data = path.read_bytes()
        copies[path] = Path(SLM_IMAGES) / slm_image_name(data, path.suffix)
        write_bytes(folder / copies[path], data)
    return plan.with_slm_images(copies.__getitem__)


def lock_run(path: Path) -> contextlib.ExitStack:
    """Hold a run's locks until they are closed or the process ends, however it ends.

    The folder itself is locked, so that nothing is given away with a deleted file; so is the file ``lock``,
    for file systems that lock files only and for programs from before.
    """
    with contextlib.ExitStack() as held:
        for what, flags in ((path, os.O_RDONLY), (path / LOCK, os.O_RDWR | os.O_CREAT)):
            handle = os.open(what, flags, 0o644)
            held.callback(os.close, handle)
            try:
                free = lock(handle)
            except OSError:
                if what != path:
                    raise
                continue
            if not free:
                raise RunError(path, "another program is writing to this run.", "Wait until it ends.")
        return held.pop_all()


def dated_name(label: str) -> str:
    """Return a name for something made now: local date, time and what it is."""
    return f"{datetime.now().astimezone():%Y-%m-%d_%H-%M-%S}_{slug(label)}"


def free_name(parent: Path, name: str, suffix: str = "") -> Path:
    """Return a path for a new run or file, with a number before the suffix when its name is taken."""
    path, number = parent / f"{name}{suffix}", 1
    while path.exists() or any(parent.glob(f".{path.name}.*.part")):
        number += 1
        path = parent / f"{name}-{number}{suffix}"
    return path


def slug(label: str) -> str:
    """Return a label as part of a folder's name."""
    return re.sub(r"[^\w.+-]+", "-", label).strip("-.") or "run"
