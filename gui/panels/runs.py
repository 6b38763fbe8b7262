"""Past runs: what became of each, its frames, its calibration's verdict; those that did not end go on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QFileSystemWatcher, Qt, QTimer, QUrl
from PySide6.QtGui import QColor, QDesktopServices
from PySide6.QtWidgets import (
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QPlainTextEdit,
    QPushButton,
    QSizePolicy,
    QSlider,
    QSplitter,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)

from calibration_routines.plan_procedures import ResumeProcedure, lacks_result
from calibration_routines.procedure import Outcome
from calibration_routines.psf.sweep_plan import SWEEP
from gui.background_reading import NewestOnly
from gui.jobs import BusyError, Job, JobContext
from gui.panel import Panel
from gui.procedure_run import Ended, ProcedureRun, script
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.image_view import ImageView
from gui.widgets.run_bar import RunBar
from instrument.runs.inspection import RunSummary, run_paths, summary
from instrument.runs.run import Run, RunCondition

_COLUMNS = ("run", "became", "frames", "kind", "bench")
_LEVELS = (0.1, 99.9)
_REST_MS = 500
"""Rest after a change in the folder before it is read."""


@dataclass(frozen=True, slots=True)
class _Found:
    """A run that was read."""

    run: Run
    stored: list[int]
    about: list[str]
    can_resume: bool
    is_usable: bool


@dataclass(frozen=True, slots=True)
class _Picture:
    """A frame that was read, with its levels and what is said of it."""

    image: npt.NDArray[Any]
    low: float
    high: float
    full_scale: int
    words: str


class RunsPanel(Panel):
    """A list of runs, the newest first; a click opens one."""

    title = "Runs"
    table: QTableWidget
    where: QLabel
    view: ImageView
    slider: QSlider
    frame_words: QLabel
    about: QPlainTextEdit
    bar: RunBar
    folder_button: QPushButton
    use_button: QPushButton
    _left: QWidget
    _right: QSplitter

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.run = ProcedureRun(session, self)
        self.summaries: list[RunSummary] = []
        self.opened: Run | None = None
        self._opening: Path | None = None
        self._stored: list[int] = []
        self._reader = NewestOnly(session.jobs, "Reading a run")
        self._listing: Job | None = None
        self._again = False
        self._wanted: Path | None = None
        self._make_list()
        self._make_details()
        split = QSplitter()
        split.addWidget(self._left)
        split.addWidget(self._right)
        split.setSizes([560, 640])
        split.setChildrenCollapsible(False)
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(split)
        self._rest = QTimer(self)
        self._rest.setSingleShot(True)
        self._rest.setInterval(_REST_MS)
        self._rest.timeout.connect(self.read_folder)
        self._watcher = QFileSystemWatcher(self)
        self._watcher.directoryChanged.connect(lambda _: self._rest.start())
        session.run_finished.connect(self._run_finished)
        self.run.looked.connect(self.bar.show_situation)
        self.run.said.connect(lambda line: self.session.log("info", line))
        self.run.succeeded.connect(self._succeeded)
        self.run.ended_early.connect(self._ended_early)
        self.run.failed.connect(lambda why: self.refused(None, why))
        self.run.over.connect(self._over)
        self.read_folder()

    # The list ------------------------------------------------------------------------------------
    def read_folder(self) -> None:
        """Read the folder of runs again, in a job."""
        if self._listing is not None:
            self._again = True
            return
        folder = self.session.runs_folder
        if folder.is_dir() and str(folder) not in self._watcher.directories():
            self._watcher.addPath(str(folder))

        def work(context: JobContext) -> list[RunSummary]:
            found = []
            for path in reversed(run_paths(folder)):
                context.check()
                found.append(summary(path))
            return found

        self._listing = self.jobs.watch("Reading the list of runs", work)
        self._listing.succeeded.connect(self._show_list)
        self._listing.ended.connect(self._listed)

    def open_run(self, path: Path) -> None:
        """Show a run, as soon as it is read."""
        self._close_run(f"Reading {path.name} …")
        self._opening = path
        self._reader.ask(lambda: _look_into(path), self._show_run)

    def _show_run(self, found: _Found | str) -> None:
        self._opening = None
        if isinstance(found, str):
            self._close_run(found)
            return
        run = self.opened = found.run
        blocked = self.slider.blockSignals(True)
        self.slider.setEnabled(len(found.stored) > 1)
        self.slider.setRange(0, max(0, len(found.stored) - 1))
        middle = len(found.stored) // 2  # the first ones are dark
        self.slider.setValue(middle)
        self.slider.blockSignals(blocked)
        self._stored = found.stored
        self.about.setPlainText("\n".join(found.about))
        self._can_resume = found.can_resume and run.condition is not RunCondition.RUNNING
        self.bar.set_startable("" if self._can_resume else "There is nothing to go on with.")
        self.folder_button.setEnabled(True)
        self.use_button.setEnabled(found.is_usable)
        self._show_frame(middle)

    def as_python(self) -> str:
        """Return lines that read the run, or go on with it where it did not end."""
        if self.opened is None:
            return (
                "from pathlib import Path\n\nfrom instrument.runs.inspection import run_paths, summary\n\n"
                f"for path in run_paths(Path({str(self.session.runs_folder)!r})):\n    print(summary(path))\n"
            )
        if self._can_resume:
            return script(ResumeProcedure(self.opened.path), self.session.config.path)
        return (
            "from instrument.runs.run import Run\n\n"
            f"run = Run.open({str(self.opened.path)!r})\n"
            "print(run)\n"
            "for index in sorted(run.records):\n"
            "    frame, metadata = run.frame(index), run.metadata(index)\n"
        )

    def resume(self) -> None:
        """Go on with the run that is shown."""
        if self.opened is None or self.run.is_running:
            return
        path = self.opened.path
        try:
            self.run.start(f"Resuming {path.name}", ResumeProcedure(path))
        except BusyError as error:
            self.refused(None, str(error))
            return
        self.bar.set_running(True)
        self.table.setEnabled(False)

    def take(self, path: Path) -> None:
        """Show a run that another panel hands on, and mark it in the list as soon as that is read."""
        self._wanted = path
        self.read_folder()

    def shutdown(self) -> None:
        """End the timers."""
        self._rest.stop()
        self.run.shutdown()

    # Making --------------------------------------------------------------------------------------
    def _make_list(self) -> None:
        self.table = QTableWidget(0, len(_COLUMNS))
        self.table.setHorizontalHeaderLabels(_COLUMNS)
        self.table.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
        self.table.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        self.table.setSelectionMode(QTableWidget.SelectionMode.SingleSelection)
        self.table.setTabKeyNavigation(False)
        # What tells runs of a day apart stands at the end of their names.
        self.table.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.table.setToolTip("Click a run to open it")
        self.table.verticalHeader().hide()
        self.table.verticalHeader().setDefaultSectionSize(26)
        header = self.table.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        self.table.currentCellChanged.connect(lambda row, *_: self._row_chosen(row))
        self.where = QLabel()
        self.where.setObjectName("dim")
        self.where.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.where.setWordWrap(True)
        self._left = QWidget()
        column = QVBoxLayout(self._left)
        column.setContentsMargins(0, 0, 6, 0)
        column.addWidget(self.where)
        column.addWidget(self.table, 1)

    def _make_details(self) -> None:
        self._can_resume = False
        self.view = ImageView()
        self.slider = QSlider(Qt.Orientation.Horizontal)
        self.slider.setToolTip("Frame of the run (arrow keys)")
        self.slider.setAccessibleName("Frame of the run")
        self.slider.valueChanged.connect(self._show_frame)
        self.frame_words = QLabel()
        self.frame_words.setObjectName("dim")
        self.frame_words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.about = QPlainTextEdit()
        self.about.setReadOnly(True)
        self.about.setPlainText("Click a run to open it.")
        self.bar = RunBar("Resume")
        self.bar.set_startable("No run is open.")
        self.bar.start.connect(self.resume)
        self.bar.pause.connect(self.run.pause)
        self.bar.resume.connect(self.run.resume)
        self.bar.abort.connect(self.run.abort)
        self.folder_button = QPushButton("Open folder")
        self.folder_button.setToolTip("Show the run's files in the file manager")
        self.folder_button.setEnabled(False)
        self.folder_button.clicked.connect(self._open_folder)
        self.use_button = QPushButton("Reconstruct with it…")
        self.use_button.setToolTip("Reconstruct photographs with this run's calibration")
        self.use_button.setEnabled(False)
        self.use_button.clicked.connect(self._use)
        foot = QHBoxLayout()
        foot.addWidget(self.bar, 1)
        aside = QVBoxLayout()
        aside.addWidget(self.use_button)
        aside.addWidget(self.folder_button)
        aside.addStretch(1)
        foot.addLayout(aside)
        self._right = QSplitter(Qt.Orientation.Vertical)
        top = QWidget()
        column = QVBoxLayout(top)
        column.setContentsMargins(6, 0, 0, 0)
        column.addWidget(self.view, 1)
        column.addWidget(self.slider)
        column.addWidget(self.frame_words)
        below = QWidget()
        column = QVBoxLayout(below)
        column.setContentsMargins(6, 0, 0, 0)
        column.addWidget(self.about, 1)
        column.addLayout(foot)
        self._right.addWidget(top)
        self._right.addWidget(below)
        self._right.setSizes([480, 260])

    # Inside --------------------------------------------------------------------------------------
    def _show_list(self, summaries: list[RunSummary]) -> None:
        wanted = self._wanted or self._opening or (self.opened.path if self.opened is not None else None)
        self.summaries = summaries
        self.where.setText(f"{self.session.runs_folder}: {len(summaries)} runs")
        blocked = self.table.blockSignals(True)
        self.table.setRowCount(len(summaries))
        chosen = -1
        for row, found in enumerate(summaries):
            became = found.condition.value if found.condition is not None else "UNREADABLE"
            texts = (
                found.path.name,
                became,
                f"{found.stored} of {found.frames}",
                "recording" if found.is_recording else "plan",
                "SIMULATED" if found.is_simulated else "",
            )
            for column, text in enumerate(texts):
                item = QTableWidgetItem(text)
                if found.condition is not RunCondition.COMPLETED and column == 1:
                    item.setForeground(QColor(colours().warning))
                item.setToolTip(found.problem or (str(found.path) if column == 0 else text))
                self.table.setItem(row, column, item)
            if found.path == wanted:
                chosen = row
        self.table.setCurrentCell(chosen, 0) if chosen >= 0 else self.table.clearSelection()
        self.table.blockSignals(blocked)
        if chosen >= 0 and self._wanted is not None:
            self._wanted = None
            self.open_run(summaries[chosen].path)

    def _listed(self) -> None:
        self._listing = None
        if self._again:
            self._again = False
            self.read_folder()

    def _run_finished(self, _path: Path) -> None:
        self._rest.start()

    def _row_chosen(self, row: int) -> None:
        if 0 <= row < len(self.summaries) and not self.run.is_running:
            found = self.summaries[row]
            if found.condition is None:
                self._close_run(f"{found.path}: {found.problem}")
            else:
                self.open_run(found.path)

    def _close_run(self, why: str) -> None:
        self._reader.forget()
        self.opened, self._opening, self._stored = None, None, []
        self.view.clear()
        self.slider.setEnabled(False)
        self.frame_words.clear()
        self.about.setPlainText(why)
        self._can_resume = False
        self.bar.set_startable("No run is open.")
        self.folder_button.setEnabled(False)
        self.use_button.setEnabled(False)

    def _show_frame(self, number: int) -> None:
        run = self.opened
        if run is None or not self._stored:
            self.view.clear()
            self.frame_words.setText("No frames." if run is not None else "")
            return
        index = self._stored[min(number, len(self._stored) - 1)]
        self._reader.ask(lambda: _read_frame(run, index), self._frame_read)

    def _frame_read(self, found: _Picture | str) -> None:
        if isinstance(found, str):
            self.frame_words.setText(found)
        else:
            self.view.show_image(found.image, found.low, found.high, found.full_scale)
            self.frame_words.setText(found.words)

    def _use(self) -> None:
        if self.opened is not None:
            self.session.handed_on.emit("reconstructions", self.opened.path / SWEEP.result)

    def _open_folder(self) -> None:
        if self.opened is not None:
            QDesktopServices.openUrl(QUrl.fromLocalFile(str(self.opened.path)))

    def _succeeded(self, outcome: Outcome) -> None:
        self.bar.show_end("; ".join(outcome.verdict), complete=outcome.good)
        for line in outcome.verdict:
            self.session.log("info" if outcome.good else "warning", line)

    def _ended_early(self, ended: Ended) -> None:
        self.session.log("warning", ended.words)

    def _over(self) -> None:
        self.bar.set_running(False)
        self.table.setEnabled(True)
        if self.opened is not None:
            self._wanted = self.opened.path
        self.read_folder()


def _look_into(path: Path) -> _Found | str:
    """Read a run; the reason where it cannot be read."""
    try:
        run = Run.open(path)
        whole = run.condition is RunCondition.COMPLETED and not run.missing()
        can_resume = run.plan is not None and (not whole or lacks_result(run.path))
        return _Found(run, sorted(run.records), _about(run), can_resume, (path / SWEEP.result).is_dir())
    except Exception as error:  # noqa: BLE001 - whatever a damaged folder raises is told
        return str(error)


def _read_frame(run: Run, index: int) -> _Picture | str:
    """Read a frame; the reason where it cannot be read."""
    try:
        image, metadata = run.frame(index), run.metadata(index)
    except Exception as error:  # noqa: BLE001 - a damaged file is told, whatever it raises
        return str(error)
    low, high = np.percentile(image[::4, ::4], _LEVELS)
    words = [
        f"Frame {index} of {run.n_frames}",
        f"{metadata.exposure_ms:.4g} ms",
        metadata.led_pattern or "",
    ]
    place = ", ".join(_axis_words(axis, value) for axis, value in (metadata.stage_position or {}).items())
    return _Picture(
        image,
        float(low),
        float(max(high, low + 1)),
        (1 << metadata.significant_bits) - 1,
        ", ".join(word for word in (*words, place) if word),
    )


def _axis_words(axis: str, value: float) -> str:
    """Return an axis' name without its unit, and its value with it: ``x 100 µm``."""
    name, _, unit = axis.rpartition("_")
    return f"{name} {value:g} {unit.replace('um', 'µm')}" if name else f"{axis} {value:g}"


def _about(run: Run) -> list[str]:
    """Return what is known of a run, a line each."""
    lines = [str(run.path), f"{run.condition}: {len(run.records)} of {run.n_frames} frames"]
    lines[1] += "  SIMULATED" if run.is_simulated else ""
    if run.error:
        lines.append(run.error)
    if run.plan is not None:
        parts: dict[str, int] = {}
        for part in run.plan.parts:
            parts[part.label] = parts.get(part.label, 0) + len(part)
        lines.append(f"Plan {run.plan.label}: " + ", ".join(f"{n} {label}" for label, n in parts.items()))
    devices = run.provenance.get("devices")
    if isinstance(devices, Mapping):
        lines += [f"{kind}: {identity}" for kind, identity in devices.items()]
    if SWEEP.is_of(run.path):
        lines += _calibration_lines(run.path)
    return lines


def _calibration_lines(run: Path) -> list[str]:
    file = run / SWEEP.result / "calibration.json"
    if not file.is_file():
        return ["A sweep without its calibration: Resume makes it."]
    try:
        quality: dict[str, Any] = json.loads(file.read_text("utf-8"))["quality"]
        psfs = quality["psfs"]
        found = [f"z = {q['z_um'] / 1e3:.4g} mm: {text}" for q in psfs for text in q["findings"]]
        verdict = "good" if quality["good"] else "with findings"
    except (OSError, ValueError, KeyError, TypeError) as error:
        return [f"Calibration {file.parent} cannot be read: {error!r}"]
    return [f"Calibration {file.parent}: {len(psfs)} PSFs, {verdict}", *found]
