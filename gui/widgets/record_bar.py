"""Recording from the live view: how long, how fast, how full the disk gets."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QHBoxLayout, QLabel, QLineEdit, QProgressBar, QPushButton, QWidget

from gui.jobs import BusyError, Job, JobContext
from gui.panel import Panel
from gui.widgets.number_edit import NumberEdit
from instrument.bench.photograph import Lit
from instrument.files.errors import FileError, size
from instrument.plan.abilities import SPARE_BYTES
from instrument.runs.acquire import free_bytes, there_now
from instrument.runs.recorder import Recorder, RecordingStatus, prepare_recording
from instrument.runs.run import Run

_DISK_MS = 5000
_SILENT_S = 4.0
"""A disk that takes longer is told as one that is silent."""


class RecordBar(QWidget):
    """Record button, length, label, disk gauge.

    Parameters
    ----------
    panel : Panel
        The live view.
    """

    def __init__(self, panel: Panel) -> None:
        super().__init__(panel)
        self._panel = panel
        self._session = panel.session
        self._recorder: Recorder | None = None
        self.job: Job | None = None
        self._looking: Job | None = None
        self._asked_s = 0.0
        self.button = QPushButton("● Record")
        self.button.setToolTip("Record every frame to the disk; again ends it (Ctrl+R)")
        self.button.clicked.connect(self.toggle)
        self.seconds = NumberEdit("s", 10.0, minimum=0.01, tip="How long to record, seconds")
        self.seconds.setFixedWidth(80)
        self.seconds.refused.connect(lambda why: panel.refused(None, why))
        self.label = QLineEdit("recording")
        self.label.setToolTip("Becomes part of the run folder's name")
        self.label.setFixedWidth(120)
        self.gauge = QProgressBar()
        self.gauge.setToolTip("How full the disk is")
        self.gauge.setFixedWidth(150)
        self.gauge.setRange(0, 1000)
        self.gauge.setFormat("…")
        self.note = QLabel()
        layout = QHBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.button)
        layout.addWidget(self.seconds)
        layout.addWidget(self.label)
        layout.addWidget(self.gauge)
        layout.addWidget(self.note, 1)
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._look_at_disk)
        self._timer.start(_DISK_MS)
        self._look_at_disk()

    def shutdown(self) -> None:
        """End the timer."""
        self._timer.stop()

    def toggle(self) -> None:
        """Start a recording, or end the one that runs."""
        if self.job is not None:
            if self._recorder is not None:
                self._recorder.stop()
            else:  # it waits for the camera, or has just begun
                self.job.cancel()
            return
        if not self._session.is_open("camera"):
            self._panel.refused(self.button, "The camera is not connected.")
            return
        if not self.seconds.submit():
            self.seconds.setFocus()
            return
        session = self._session
        seconds, label = self.seconds.value, self.label.text().strip() or "recording"

        def work(context: JobContext) -> Run:
            lit = Lit.now(session.bench)
            recorder = prepare_recording(
                session.bench, session.runs_folder, label=label, seconds=seconds, on_progress=context.report
            )
            self._recorder = recorder
            with session.live.watching(recorder.newest):
                run = recorder.execute()
            context.check()
            lit.put_back(session.bench)
            return run

        try:
            job = session.exclusive_job("Recording", work)
        except BusyError as error:
            self._panel.refused(self.button, str(error))
            return
        self.job = job
        self.button.setText("■ End")
        job.progressed.connect(self._show)
        job.succeeded.connect(self._done)
        job.failed.connect(lambda why: self._panel.refused(self.button, why))
        job.ended.connect(self._ended)

    def _show(self, value: object) -> None:
        status = cast(RecordingStatus, value)
        left_s = max(0, status.free_bytes - SPARE_BYTES) / max(status.bytes_per_s, 1.0)
        words = [
            f"{status.written} frames",
            f"{status.frames_per_s:.1f}/s",
            f"{status.bytes_per_s / 1e6:.0f} MB/s",
            f"disk lasts {_duration(left_s)}",
        ]
        if status.dropped_by_device:
            words.append(f"{status.dropped_by_device} dropped by the camera")
        if status.not_written:
            words.append(f"{status.not_written} lost: the disk is too slow")
        self.note.setText(" · ".join(words))

    def _done(self, run: Run) -> None:
        self.note.setText(f"{len(run.records)} frames in {run.path.name}")
        self._session.log("info", f"Recorded {len(run.records)} frames: {run.path}")
        self._session.run_finished.emit(run.path)

    def _ended(self) -> None:
        self.job, self._recorder = None, None
        self.button.setText("● Record")
        self._look_at_disk()

    def _look_at_disk(self) -> None:
        """Ask how full the disk is, in a job: one of a server that is silent would hold the window up."""
        if self._looking is not None:
            if time.monotonic() - self._asked_s > _SILENT_S:
                self._not_known(f"{self._session.runs_folder}: its disk has not answered yet.")
            return
        folder = self._session.runs_folder
        self._asked_s = time.monotonic()
        job = self._session.jobs.compute("Looking at the disk", lambda _: _disk_of(folder))
        job.quiet = True
        self._looking = job
        job.succeeded.connect(self._show_disk)
        job.failed.connect(self._not_known)
        job.ended.connect(self._looked)

    def _looked(self) -> None:
        self._looking = None

    def _show_disk(self, value: object) -> None:
        disk = cast(_Disk, value)
        if disk.problem:
            self._not_known(disk.problem)
            return
        self.gauge.setValue(round(1000 * disk.full))
        self.gauge.setFormat(f"{size(disk.free)} free")
        self.gauge.setToolTip(f"How full the disk is that holds {self._session.runs_folder}")

    def _not_known(self, why: str) -> None:
        self.gauge.setValue(0)
        self.gauge.setFormat("disk not known")
        self.gauge.setToolTip(why)


@dataclass(frozen=True, slots=True)
class _Disk:
    """A disk's full share and free bytes, or why they are not known."""

    full: float = 0.0
    free: int = 0
    problem: str = ""


def _disk_of(folder: Path) -> _Disk:
    try:
        free = free_bytes(folder)
        total = shutil.disk_usage(there_now(folder)).total
    except OSError as error:  # no such place, a drive taken away
        return _Disk(problem=f"{folder}: {error.strerror or error}")
    except FileError as error:
        return _Disk(problem=str(error))
    if not total:  # as some file systems of servers and user space have it
        return _Disk(problem=f"{folder}: its file system tells no size.")
    return _Disk(1 - free / total, free)


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h"
