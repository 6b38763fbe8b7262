"""The window's last line: what runs, what somebody waits for, what was told last."""

from __future__ import annotations

from typing import cast

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QStatusBar, QWidget

from gui.jobs import Job
from gui.session import BenchSession
from gui.widgets.building import label, share_bar
from gui.words import in_the_window
from instrument.bench.config import Kind
from recon.base.compiling import being_compiled

_BAR_PX = 140
_LOOK_MS = 300


class StatusLine(QStatusBar):
    """Says which job runs, or how the last one ended; errors until their cause is gone, others where told."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setSizeGripEnabled(False)
        self._session = session
        self.words = label("Ready", yields=True)
        self.words.setContentsMargins(3, 0, 0, 0)
        self.setContentsMargins(4, 1, 8, 2)
        self.progress = share_bar(0)
        self.progress.setFixedWidth(_BAR_PX)
        self.progress.hide()
        self.compiling = label(role="dim")
        """What is compiled while a job is waited for: once on a machine, and for up to a minute."""
        self.addWidget(self.progress)
        self.addWidget(self.words, 1)
        self.addPermanentWidget(self.compiling)
        self._look = QTimer(self, interval=_LOOK_MS)
        self._look.timeout.connect(self._show_compiling)
        self._problem = ""
        """The warning or error that was told last."""
        self._stays = False
        """Whether it holds whatever panel is in front: an error that is no panel's own."""
        session.jobs.job_started.connect(self._started)
        session.jobs.job_ended.connect(self._ended)
        session.logged.connect(self._show_problem)
        session.device_changed.connect(self._forget_problem)

    @property
    def jobs(self) -> list[Job]:
        """What runs and would be missed: runs, moves, photographs, computations."""
        return [job for job in self._session.jobs.jobs if not job.quiet]

    def _started(self, job: Job) -> None:
        if job.quiet:
            return
        if job.exclusive or not job.lanes:
            self.progress.show()
        self.words.setText(f"{job.title} …")
        self._look.start()

    def _ended(self, job: Job) -> None:
        if job.quiet:
            return
        if not job.lanes and self._problem.startswith(f"{job.title}: "):  # its panel says it, too
            self._stays = False
        running = self.jobs
        self.progress.setVisible(any(j.exclusive or not j.lanes for j in running))
        if running:
            self.words.setText(f"{running[0].title} …")
            return
        self._look.stop()
        self.compiling.clear()
        if self.words.text() == f"{job.title} …":  # what was told meanwhile stays
            became = {"succeeded": job.became, "cancelled": "ended early"}.get(job.state.value, "failed")
            self.words.setText(f"{job.title}: {became}")

    def _show_compiling(self) -> None:
        name = being_compiled()
        self.compiling.setText("" if name is None else f"compiling {name}, once on this machine")

    def _show_problem(self, level: str, text: str) -> None:
        if level in ("warning", "error"):
            self._problem, self._stays = text, level == "error"
            self.words.setText(self._shown_problem)

    @property
    def _shown_problem(self) -> str:
        return self._problem.splitlines()[0] if self._problem else ""

    def leave_panel(self) -> None:
        """Take away what concerned the panel that was in front: it says so itself, and the log keeps it."""
        if self._problem and not self._stays and self.words.text() == self._shown_problem:
            self.words.setText(f"{self.jobs[0].title} …" if self.jobs else "Ready")

    def _forget_problem(self, kind: str) -> None:
        """Take a device's failure away that is over; the log keeps it."""
        session = self._session
        device = session.bench.devices.get(cast(Kind, kind))
        mended = device is not None and session.is_open(kind) and in_the_window(device.name) in self._problem
        if mended and self.words.text() == self._shown_problem:
            self.words.setText("Ready")
