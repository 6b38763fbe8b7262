"""The live view kept running: begun whenever the camera is free, tried again where it does not start."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from PySide6.QtCore import QObject, QTimer

from drivers.errors import StoppedError
from gui.jobs import BusyError, Job, JobRunner, words_for
from instrument.live.live_camera import LiveCamera

_AGAIN_S = 1.0
"""After which a live view that did not start is tried again; doubled each time it does not, up to:"""
_LONGEST_AGAIN_S = 30.0


class LiveUpkeep(QObject):
    """Starts the live view, holds it, and begins it again after a run or a start that failed.

    Parameters
    ----------
    jobs : JobRunner
    live : LiveCamera
    may : callable
        Whether the camera is open, and nothing is about to end.
    parent : QObject
        Its timer goes with it.
    """

    def __init__(self, jobs: JobRunner, live: LiveCamera, may: Callable[[], bool], parent: QObject) -> None:
        super().__init__(parent)
        self._jobs, self._live, self._may = jobs, live, may
        self.wanted = True
        """Whether the live view is to run whenever nothing else needs the camera."""
        self.failure = ""
        """Why it does not start although the camera is open; empty: it does, or was not tried."""
        self._job: Job | None = None
        self._again = QTimer(self)
        self._again.setSingleShot(True)
        self._again.timeout.connect(self.start)
        self._again_s = _AGAIN_S

    def start(self) -> None:
        """Start the live view; it also goes on by itself after a run."""
        self.wanted = True
        if self._may() and not self._jobs.is_busy("camera"):
            with contextlib.suppress(BusyError):  # a run goes on: the live view does after it
                self._job = self._jobs.device(
                    "Starting the live view", lambda _: self._live.start(), {"camera"}, quiet=True
                )

    def hold(self) -> None:
        """End the live view until it is started again."""
        self.give_up()
        if self._live.is_running:
            with contextlib.suppress(BusyError):  # a run has ended it already
                self._jobs.device("Ending the live view", lambda _: self._live.stop(), {"camera"}, quiet=True)

    def give_up(self) -> None:
        """Want it no longer; what runs is ended by somebody else."""
        self.wanted = False
        self.forget_failure()

    def goes_on(self) -> None:
        """Start it where it is wanted and does not run: what needed the camera may be over."""
        if self.wanted and not self._live.is_running:
            self.start()

    def forget_failure(self) -> None:
        """Try no more by itself: the camera's state says what is wrong from here on."""
        self.failure, self._again_s = "", _AGAIN_S
        self._again.stop()

    def is_start(self, job: Job) -> bool:
        """Whether a job is the start that was tried last."""
        return job is self._job

    def was_told(self, job: Job) -> bool:
        """Whether a job is a start that failed for the reason that the one before had."""
        return self.is_start(job) and job.error is not None and self.failure == words_for(job.error)

    def tried(self, job: Job) -> None:
        """Try again later where the live view did not start: the camera may only have been busy."""
        self._job = None
        if job.error is None or not self._may():
            self.forget_failure()
        elif job.state.value != "cancelled" and self.wanted:
            if not isinstance(job.error, StoppedError):
                self.failure = words_for(job.error)
            self._again.start(round(1e3 * self._again_s))
            self._again_s = min(2 * self._again_s, _LONGEST_AGAIN_S)
