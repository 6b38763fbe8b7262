"""From an open bench to a recording: check the disk, make the folder, record."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from instrument.bench.bench import Bench
from instrument.files.errors import BenchError
from instrument.plan.abilities import SPARE_BYTES
from instrument.runs.acquire import free_bytes, record_of
from instrument.runs.recorder import Recorder, RecordingStatus
from instrument.runs.run import Run
from instrument.runs.writer import RunWriter


def record(
    bench: Bench,
    folder: Path | str | None = None,
    *,
    label: str = "recording",
    n_frames: int | None = None,
    seconds: float | None = None,
    n_buffers: int | None = None,
    on_progress: Callable[[RecordingStatus], None] | None = None,
) -> Run:
    """Record a camera's stream into a new run; see :class:`Recorder`.

    Parameters
    ----------
    bench : Bench
        Open; light, stage and SLM stay as they are until the end, when the bench is made safe.
    folder : path, optional
        Where the run's folder is made; None means the bench's own data folder.
    label : str
        Becomes part of the folder's name.
    n_frames, seconds
        The end, whichever comes first; one of them is needed.
    n_buffers, on_progress
        As in :class:`Recorder`.

    Raises
    ------
    BenchError
        When neither ``n_frames`` nor ``seconds`` is given, or the disk has no room for ``n_frames``.
    DeviceError, RunError
        When the camera or the disk fails; what was recorded is kept.
    """
    if n_frames is None and seconds is None:
        raise BenchError("Say how much to record: n_frames, seconds, or both.")
    return prepare_recording(
        bench,
        folder,
        label=label,
        n_frames=n_frames,
        seconds=seconds,
        n_buffers=n_buffers,
        on_progress=on_progress,
    ).execute()


def prepare_recording(
    bench: Bench,
    folder: Path | str | None = None,
    *,
    label: str = "recording",
    n_frames: int | None = None,
    seconds: float | None = None,
    n_buffers: int | None = None,
    on_progress: Callable[[RecordingStatus], None] | None = None,
) -> Recorder:
    """Make a recording's folder and return its recorder, for those who end it by ``stop``."""
    folder = Path(folder) if folder is not None else bench.config.data_folder
    camera = bench.camera
    need = (n_frames or 1) * math.prod(camera.frame_shape) * camera.frame_dtype.itemsize
    if (free := free_bytes(folder)) < need + SPARE_BYTES:
        raise BenchError(
            f"{folder}: {n_frames or 1} frames need {need / 1e9:.2f} GB and {SPARE_BYTES / 1e9:.2f} GB to "
            f"spare, but only {free / 1e9:.2f} GB are free. Free some, or choose another folder."
        )
    writer = RunWriter.create(folder, label=label, bench=record_of(bench))
    return Recorder(
        bench, writer, n_frames=n_frames, seconds=seconds, n_buffers=n_buffers, on_progress=on_progress
    )
