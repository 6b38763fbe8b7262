"""Recordings of the live view: begun, ended, gone on with; how full the disk is."""

from __future__ import annotations

import shutil
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtWidgets import QLineEdit, QProgressBar, QWidget

from drivers.errors import StoppedError
from gui.background import NewestOnly
from gui.jobs import Job, JobCancelledError, JobContext
from gui.panel import Panel
from gui.widgets.building import button, every, fill, label
from gui.widgets.entry import NumberEdit
from gui.widgets.tab_order import hand_on
from instrument.bench.lit import Lit
from instrument.files.atomic import SPARE_BYTES, free_bytes, there_now
from instrument.files.errors import FileError, count, duration, size

if TYPE_CHECKING:
    from instrument.runs.recorder import Recorder, RecordingStatus
    from instrument.runs.recording_rest import RecordingRest
    from instrument.runs.run import Run

_DISK_MS = 5000
_LEFT = "recordings left as they are"
"""What is kept with the bench of those whose rest is offered no longer, by the names of their folders."""
_SILENT_S = 4.0
"""A disk that takes longer is called silent."""


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
        self._reader = NewestOnly(panel.jobs, "Looking at the disk", self._not_known)
        self._asked_s = 0.0
        tip = "Record every frame to the disk; again ends it (Ctrl+R)"
        self.button = button("● Record", tip, self.toggle)
        panel.only_with(("camera",), self.button)
        self.seconds = NumberEdit("s", 10.0, minimum=0.01, tip="How long to record, seconds")
        self.seconds.setFixedWidth(80)
        panel.heed(self.seconds)
        self.label = QLineEdit("recording")
        self.label.setAccessibleName("Name of the recording")
        self.label.setToolTip("Becomes part of the run folder's name")
        self.label.setFixedWidth(120)
        self.gauge = QProgressBar()
        self.gauge.setToolTip("How full the disk is")
        self.gauge.setFixedWidth(150)
        self.gauge.setRange(0, 1000)
        self.gauge.setFormat("…")
        self.note = label(yields=True)
        self._taken: Path | None = None
        self.look_button = button("Look at it…", "Show the recording, as far as it came", self._look_at_it)
        self.look_button.hide()
        self.rest_button = button("Go on with it", "Record what a recording lacks", self._go_on)
        self.rest_button.hide()
        tip = "Offer it no longer: what was taken is kept as it is"
        self.leave_button = button("Leave it", tip, self._leave)
        self.leave_button.hide()
        self.rest: RecordingRest | None = None
        """What a recording lacks that was cut, now or on an earlier day."""
        self._before: tuple[Path | None, str] = (None, "")
        """What was taken, and said of it, before the recording that runs."""
        self._rests = NewestOnly(panel.jobs, "Looking for a recording that was cut")
        parts = (self.button, self.seconds, self.label, self.gauge, (self.note, 1))
        fill(self, *parts, self.rest_button, self.leave_button, self.look_button, across=True)
        every(self, _DISK_MS, self._look_at_disk)
        self._look_at_disk()
        self._look_for_rest()
        panel.session.device_changed.connect(self._device_changed)

    def toggle(self) -> None:
        """Start a recording, or end the one that runs."""
        if self.job is not None:
            if self._recorder is not None:
                self._recorder.stop()
            else:  # it waits for the camera, or has just begun
                self.job.cancel()
            return
        if why := self._panel.lacks(("camera",)):
            self._panel.refused(None, why)
            return
        if not self.seconds.submit():
            self.seconds.setFocus()
            return
        self._begin(self.seconds.value or 0.0, self.label.text().strip() or "recording")

    def _go_on(self) -> None:
        """Record what a recording that was cut lacks, in the light that it had."""
        if (rest := self.rest) is not None and self.job is None:
            self._begin(rest.seconds, rest.label, rest)

    def _begin(self, seconds: float | None, label: str, rest: RecordingRest | None = None) -> None:
        session = self._session

        def work(context: JobContext) -> Run:
            from instrument.runs.recorder import RecordingOptions, prepare_recording

            frames = None if rest is None else rest.n_frames
            asked = RecordingOptions(label=label, seconds=seconds, n_frames=frames)

            def report(status: RecordingStatus) -> None:
                try:
                    context.report(status)
                except JobCancelledError:  # STOP, where Ctrl+C of the terminal ends a recording on purpose
                    raise StoppedError(session.bench.camera.name, "its recording was stopped.") from None

            with nullcontext() if rest is None else rest.set_up(session.bench):
                lit = Lit.now(session.bench)
                recorder = prepare_recording(session.bench, session.runs_folder, asked, on_progress=report)
            self._recorder, self._taken = recorder, recorder.path
            with session.live.watching(recorder.newest):
                run = recorder.execute()
            context.check()
            lit.put_back(session.bench)
            return run

        before = self._taken, self.note.text()
        self._taken = None  # the work tells it anew
        job = self._panel.begin(lambda: session.exclusive_job("Recording", work), self.button)
        if job is None:
            self._taken, _ = before
            return
        self.job, self._before = job, before
        self._rests.forget()
        self.note.clear()
        self.look_button.hide()
        self._show_rest(False)
        self.button.setText("■ End")
        self._panel.only_with((), self.button)  # whatever fails, it can be ended
        job.progressed.connect(self._show)
        job.succeeded.connect(self._done)
        job.failed.connect(lambda _: self._ended_early("by a fault"))
        job.cancelled.connect(lambda _: self._ended_early("before its time"))
        job.ended.connect(self._ended)

    def _show(self, status: RecordingStatus) -> None:
        left_s = max(0, status.free_bytes - SPARE_BYTES) / max(status.bytes_per_s, 1.0)
        words = [
            f"{status.written} frames",
            f"{status.frames_per_s:.1f}/s",
            f"{status.bytes_per_s / 1e6:.0f} MB/s",
            f"disk lasts {duration(left_s)}",
        ]
        if status.dropped_by_device:
            words.append(f"{status.dropped_by_device} dropped by the camera")
        if status.not_written:
            words.append(f"{status.not_written} lost: the disk is too slow")
        self.note.setText(" · ".join(words))

    def _done(self, run: Run) -> None:
        count = len(run.records)
        frames = f"{count} frame{'' if count == 1 else 's'}"
        self.rest = None
        self.note.setText(f"{frames} in {run.path.name}")
        self._session.log("info", f"Recorded {frames}: {run.path}")
        self._session.run_finished.emit(run.path)

    def _ended_early(self, how: str) -> None:
        """Say what is kept of a recording that was broken off; of the one before where it was refused."""
        if self._taken is None:
            self._taken, said = self._before
            self.note.setText(said)
            self._show_rest(self.rest is not None)
            return
        kept = self.note.text().partition(" · ")[0] or "no frame yet"
        self.note.setText(f"Ended {how} ({kept}); what was taken is kept in {self._taken.name}")
        self._session.run_finished.emit(self._taken)
        self.rest = None
        self._look_for_rest()

    def _look_for_rest(self) -> None:
        """Offer what the newest recording lacks where it was cut, by a kill or on an earlier day as well.

        Only with the camera that it was taken with, and so once a camera is connected.
        """
        folder, camera = self._session.runs_folder, self._session.bench.devices.get("camera")

        def read() -> RecordingRest | None:
            from instrument.runs.recording_rest import newest_rest

            return newest_rest(folder, camera.identity) if camera is not None and camera.is_open else None

        self._rests.ask(read, self._offer_rest)

    def _device_changed(self, kind: str) -> None:
        if kind == "camera" and self.job is None and self.rest is None and self._session.is_open(kind):
            self._look_for_rest()

    def _offer_rest(self, rest: RecordingRest | None) -> None:
        if rest is None or self.job is not None or rest.run.name in self._session.kept.of(_LEFT):
            return
        self.rest = rest
        lacks = [duration(rest.seconds)] if rest.seconds is not None else []
        lacks += [count(rest.n_frames, "frame")] if rest.n_frames is not None else []
        tip = (
            f"Record the {' or '.join(lacks)} that it lacks, in its light and settings, as a film of its own"
        )
        self.rest_button.setToolTip(tip)
        self._show_rest(True)
        if self._taken is None:  # of an earlier day
            self._taken = rest.run
            self.note.setText(f"{rest.run.name} did not end: {count(rest.stored, 'frame')} kept")
            self.look_button.show()

    def _show_rest(self, offered: bool) -> None:
        if not offered:
            hand_on(self.button, (self.rest_button, self.leave_button))
        self.rest_button.setVisible(offered)
        self.leave_button.setVisible(offered)

    def _leave(self) -> None:
        """Offer the rest no longer, on no other day either."""
        rest, self.rest = self.rest, None
        self._show_rest(False)
        if rest is not None:
            self._session.keep(_LEFT, rest.run.name, True)
            self.note.setText(f"{rest.run.name}: {count(rest.stored, 'frame')} kept")

    def _look_at_it(self) -> None:
        self._session.handed_on.emit("runs", self._taken)

    def _ended(self) -> None:
        self.job, self._recorder = None, None
        self.button.setText("● Record")
        self._panel.only_with(("camera",), self.button)
        self.look_button.setVisible(self._taken is not None)
        self._look_at_disk()

    def _look_at_disk(self) -> None:
        """Ask how full the disk is, in a job: one of a server that is silent would hold the window up."""
        if self._reader.is_reading:
            if time.monotonic() - self._asked_s > _SILENT_S:
                self._not_known(f"{self._session.runs_folder}: its disk has not answered yet.")
            return
        folder = self._session.runs_folder
        self._asked_s = time.monotonic()
        self._reader.ask(lambda: _disk_of(folder), self._show_disk)

    def _show_disk(self, disk: tuple[float, int] | str) -> None:
        if isinstance(disk, str):
            self._not_known(disk)
            return
        full, free = disk
        self.gauge.setValue(round(1000 * full))
        self.gauge.setFormat(f"{size(free)} free")
        self.gauge.setToolTip(f"How full the disk is that holds {self._session.runs_folder}")

    def _not_known(self, why: str) -> None:
        self.gauge.setValue(0)
        self.gauge.setFormat("disk not known")
        self.gauge.setToolTip(why)


def _disk_of(folder: Path) -> tuple[float, int] | str:
    """Return a disk's full share and its free bytes, or why they are not known."""
    try:
        free = free_bytes(folder)
        total = shutil.disk_usage(there_now(folder)).total
    except OSError as error:  # no such place, a drive taken away
        return f"{folder}: {error.strerror or error}"
    except FileError as error:
        return str(error)
    if not total:  # as some file systems of servers and user space have it
        return f"{folder}: its file system gives no size."
    return 1 - free / total, free
