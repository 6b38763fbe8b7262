"""Record a camera's stream to disk: every frame with its metadata, every lost frame as a gap."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.common.stream import FrameStream
from drivers.common.stream_reader import StreamReader
from drivers.errors import DeviceError, StoppedError
from drivers.frame import Frame, FrameMetadata
from instrument.bench.bench import Bench
from instrument.bench.lit import Lit
from instrument.files.atomic import SPARE_BYTES, free_bytes
from instrument.files.errors import BenchError, count, size
from instrument.files.record import plain
from instrument.runs.acquire import record_of
from instrument.runs.finish import end_run
from instrument.runs.log import Gap
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import RunError
from instrument.runs.writer import FrameToStore, RunWriter
from recon.base.declare import option, with_overrides


@dataclass(frozen=True, kw_only=True)
class RecordingOptions:
    """How long a recording goes on (whichever end comes first), and what it is called."""

    seconds: float | None = option(
        None, help="How long.", unit="s", least=0, flags=("--seconds", "-s"), group="Camera"
    )
    n_frames: int | None = option(
        None, help="How many frames, lost ones counted.", least=1, flags=("--frames", "-n"), group="Camera"
    )
    n_buffers: int | None = option(
        None,
        help="Frames that may wait in memory for the disk.",
        default_words="what fits into 256 MB",
        least=16,
        flags=("--buffers",),
        group="Camera",
    )
    label: str = option("recording", help="Becomes part of the folder's name.", group="Files")


def record(
    bench: Bench,
    folder: Path | str | None = None,
    options: RecordingOptions | None = None,
    *,
    on_progress: Callable[[RecordingStatus], None] | None = None,
    **overrides: Any,
) -> Run:
    """Record a camera's stream into a new run; see :class:`Recorder`.

    Light, stage and SLM of the open bench stay as they are until the end, when the bench is made safe. The
    run's folder is made in ``folder`` (None: the bench's own data folder); ``overrides`` are single options.

    Raises BenchError when neither ``n_frames`` nor ``seconds`` is given, or the disk has no room for
    ``n_frames``; DeviceError or RunError when the camera or the disk fails (what was recorded is kept).
    """
    options = with_overrides(options or RecordingOptions(), overrides)
    if options.n_frames is None and options.seconds is None:
        raise BenchError("Say how much to record: n_frames, seconds, or both.")
    return prepare_recording(bench, folder, options, on_progress=on_progress).execute()


def prepare_recording(
    bench: Bench,
    folder: Path | str | None = None,
    options: RecordingOptions | None = None,
    *,
    on_progress: Callable[[RecordingStatus], None] | None = None,
    **overrides: Any,
) -> Recorder:
    """Make a recording's folder and return its recorder, for those who end it by ``stop``; see ``record``."""
    options = with_overrides(options or RecordingOptions(), overrides)
    folder = Path(folder) if folder is not None else bench.config.data_folder
    frames = options.n_frames or 1
    need = frames * _frame_bytes(bench)
    if (free := free_bytes(folder)) < need + SPARE_BYTES:
        raise BenchError(
            f"{folder}: {count(frames, 'frame')} need {size(need)} and {size(SPARE_BYTES)} to "
            f"spare, but only {size(free)} are free. Free some, or choose another folder."
        )
    writer = RunWriter.create(folder, label=options.label, bench=record_of(bench))
    try:
        return Recorder(bench, writer, options, on_progress)
    except Exception as error:  # of a camera that was unplugged meanwhile
        end_run(bench, writer, FinishReason.FAILED, error)
        raise


def _frame_bytes(bench: Bench) -> int:
    return math.prod(bench.camera.frame_shape) * bench.camera.frame_dtype.itemsize


_log = logging.getLogger(__name__)
_RING_BYTES = 256 * 2**20
"""Memory that waits for a slow disk, unless ``n_buffers`` says otherwise."""
_FEWEST_BUFFERS, _MOST_BUFFERS = 16, 512
_BATCH = 32
"""Frames synced to the disk together, at most; at most a quarter of the ring."""
_DISK_CHECK_S = 1.0
_FEWEST_FREE_BYTES = SPARE_BYTES // 2
_LOOK_S = 0.1
"""How soon a stop is seen while no frame comes."""


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    """A snapshot of a recording."""

    written: int
    """Frames on the disk."""
    numbered: int
    """Those and the lost ones: the number of the next frame."""
    dropped_by_device: int
    """Frames that the camera or its driver lost."""
    not_written: int
    """Frames lost because the disk was slower than the camera."""
    waiting: int
    """Frames in memory on their way to the disk; more than ``n_buffers`` never are."""
    n_buffers: int
    seconds: float
    """Since the first frame."""
    frames_per_s: float
    bytes_per_s: float
    """Mean rates of what was written."""
    saturated_fraction: float
    """Of the newest frame."""
    free_bytes: int
    """Left on the disk."""


class Recorder:
    """Records until a number of frames or seconds is reached, or until ``stop``.

    Memory is that of the stream's ring: when the disk is slower than the camera, frames are lost there and
    counted, and nothing grows. A lost frame keeps its number: the recording's array has a gap. The bench's
    light is as the caller set it; ``writer`` is of a run without a plan. ``on_progress`` is called with the
    status after every batch of frames, at once when frames were lost.
    """

    def __init__(
        self,
        bench: Bench,
        writer: RunWriter,
        options: RecordingOptions,
        on_progress: Callable[[RecordingStatus], None] | None = None,
    ) -> None:
        self._bench = bench
        self._writer = writer
        self._n_frames, self._seconds = options.n_frames, options.seconds
        fitting = _RING_BYTES // _frame_bytes(bench)
        self.n_buffers = options.n_buffers or min(_MOST_BUFFERS, max(_FEWEST_BUFFERS, fitting))
        self._batch = min(_BATCH, self.n_buffers // 4)
        self.on_progress = on_progress
        self._stopping = threading.Event()
        self._stream: FrameStream | None = None
        self._surroundings: FrameMetadata | None = None
        self._next = 0
        self._written = self._bytes = self._by_device = self._not_written = 0
        self._began_s = math.inf
        self._disk_checked_s = -math.inf
        self._free_bytes: int

    @property
    def path(self) -> Path:
        """The recording's folder."""
        return self._writer.path

    def stop(self) -> None:
        """End the recording after the frames being written; callable from any thread."""
        self._stopping.set()

    def newest(self) -> Frame | None:
        """Return the newest frame, at once; None before the first. Callable from any thread."""
        stream = self._stream  # which the recording's own thread lets go of
        return None if stream is None else stream.newest()

    def execute(self) -> Run:
        """Record; returns the finished run, whose ``reason`` says how it ended.

        Raises DeviceError or RunError when the camera or the disk fails (what was recorded is kept, the run
        marked as failed, the bench made safe); KeyboardInterrupt or SystemExit after the run was marked as
        aborted and the bench made safe.
        """
        try:
            return self._execute()
        finally:
            self._stream = None  # its buffers go at once, whoever keeps the recorder

    def _execute(self) -> Run:
        try:
            stream = self._stream = FrameStream(self._bench.camera, self.n_buffers)
            reader = stream.reader()
            self._writer.start(
                drops_counted_by=self._bench.camera.drops_counted_by,
                n_buffers=self.n_buffers,
                seconds=self._seconds,
                n_frames=self._n_frames,
                lit=plain(Lit.now(self._bench)),
            )
            with stream:
                self._record(reader)
        except StoppedError:
            return end_run(self._bench, self._writer, FinishReason.STOPPED, None)
        except Exception as error:
            end_run(self._bench, self._writer, FinishReason.FAILED, error)
            raise
        except BaseException as error:
            end_run(self._bench, self._writer, FinishReason.ABORTED, error)
            raise
        return end_run(self._bench, self._writer, FinishReason.COMPLETED, None)

    def _record(self, reader: StreamReader) -> None:
        while not self._is_done():
            frame = reader.next_frame(_LOOK_S)
            if frame is None:
                if not reader.is_running:  # STOP, from another thread
                    raise StoppedError(self._bench.camera.name, "its stream was stopped.")
                continue
            self._began_s = min(self._began_s, time.monotonic())
            batch: list[FrameToStore] = []
            gaps: list[Gap] = []
            failure: DeviceError | None = None
            while frame is not None:
                self._place(frame, reader, batch, gaps)
                if len(batch) == self._batch or self._next == self._n_frames:
                    break
                try:
                    frame = reader.next_frame(0.0)
                except DeviceError as error:  # the frames that came before it are stored first
                    failure, frame = error, None
            self._bench.require_light()  # else nobody knows what lit these frames
            self._store(batch, gaps, reader)
            if failure is not None:
                raise failure

    def _place(self, frame: Frame, reader: StreamReader, batch: list[FrameToStore], gaps: list[Gap]) -> None:
        by_device, not_written = reader.missed
        if self._n_frames is not None:  # a gap at the end is no longer than the recording
            left = self._n_frames - self._next
            by_device = min(by_device, left)
            not_written = min(not_written, left - by_device)
        if by_device or not_written:
            gaps.append(Gap(self._next, by_device, not_written))
            self._by_device += by_device
            self._not_written += not_written
            self._next += by_device + not_written
            self._say_lost(gaps[-1])
        if self._next != self._n_frames:
            batch.append(FrameToStore(self._next, frame.image, self._with_surroundings(frame.metadata)))
            self._next += 1

    def _with_surroundings(self, metadata: FrameMetadata) -> FrameMetadata:
        """Add stage, LEDs and SLM, which stay as they are during a recording and so are asked once."""
        if self._surroundings is None:
            self._surroundings = self._bench.with_surroundings(metadata)
        return metadata.among(self._surroundings)

    def _store(self, batch: list[FrameToStore], gaps: list[Gap], reader: StreamReader) -> None:
        for gap in gaps:
            self._writer.gap(gap)
        self._writer.write(batch)
        self._written += len(batch)
        self._bytes += sum(frame.image.nbytes for frame in batch)
        self._check_disk()
        if self.on_progress is not None:
            newest = batch[-1].metadata.saturated_fraction if batch else 0.0
            self.on_progress(self._status(reader, newest))

    def _say_lost(self, gap: Gap) -> None:
        """Tell of the first loss at once; the status counts the others."""
        first = self._by_device + self._not_written == gap.count
        _log.log(
            logging.WARNING if first else logging.DEBUG,
            "Frames lost from frame %d on: %d by the camera, %d because the disk was too slow.",
            gap.first,
            gap.by_device,
            gap.not_written,
        )

    def _check_disk(self) -> None:
        if time.monotonic() - self._disk_checked_s < _DISK_CHECK_S:
            return
        self._disk_checked_s = time.monotonic()
        self._free_bytes = free_bytes(self._writer.path)
        if self._free_bytes < _FEWEST_FREE_BYTES:
            raise RunError(
                self._writer.path,
                f"the disk is nearly full ({self._free_bytes / 1e6:.0f} MB left); the recording was ended.",
                "All frames before are kept. Free some space, or record to another disk.",
            )

    def _is_done(self) -> bool:
        if self._stopping.is_set() or self._next == self._n_frames:
            return True
        return self._seconds is not None and time.monotonic() - self._began_s >= self._seconds

    def _status(self, reader: StreamReader, saturated_fraction: float) -> RecordingStatus:
        seconds = max(1e-9, time.monotonic() - self._began_s)
        return RecordingStatus(
            written=self._written,
            numbered=self._next,
            dropped_by_device=self._by_device,
            not_written=self._not_written,
            waiting=reader.status.waiting,
            n_buffers=self.n_buffers,
            seconds=seconds,
            frames_per_s=self._written / seconds,
            bytes_per_s=self._bytes / seconds,
            saturated_fraction=saturated_fraction,
            free_bytes=self._free_bytes,
        )
