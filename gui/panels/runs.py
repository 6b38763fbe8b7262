"""Past runs and photographs: what became of each, its frames, its calibration's verdict, the way on."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from PySide6.QtCore import QFileSystemWatcher, QSignalBlocker, Qt, QUrl
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import QSlider, QTableWidget, QWidget

from calibration_routines.plan_procedures import ResumeProcedure
from gui.background import NewestOnly
from gui.panel import Panel
from gui.procedure_run import ProcedureRun, RunBar, script
from gui.run_looks import Opened, Picture, look_into, read_frame
from gui.session import BenchSession
from gui.widgets.building import (
    Hint,
    after_rest,
    button,
    cell,
    fill,
    in_row,
    label,
    split,
    table,
    text_view,
)
from gui.widgets.image_view import ImageView
from gui.widgets.orientation import follow_orientation
from instrument.bench.photograph_file import PHOTOGRAPHS
from instrument.files.errors import count
from instrument.runs.inspection import RunSummary, runs_and_photographs, summary
from instrument.runs.run import RunCondition
from recon.base.as_python import Imports, expression

_COLUMNS = ("run", "became", "frames", "kind", "bench")
_REST_MS = 500
"""Rest after a change in the folder before it is read."""


class RunsPanel(Panel):
    """A list of runs and photographs, the newest first; a click opens one."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.run = ProcedureRun(session, self)
        self.summaries: list[RunSummary] = []
        self.opened: Opened | None = None
        self._opening: Path | None = None
        self._stored: list[int] = []
        self._can_resume = False
        self._reader = NewestOnly(session.jobs, "Reading a run")
        self._verifier = NewestOnly(session.jobs, "Verifying a run")
        self._lister = NewestOnly(session.jobs, "Reading the list of runs")
        self._wanted: Path | None = None

    def parts(self) -> Iterator[None]:
        """Make what holds the widgets, then those."""
        session = self.session
        left, top, below = QWidget(), QWidget(), QWidget()
        self.details = split(top, below, sizes=[480, 260], down=True)
        fill(self.body, split(left, self.details, sizes=[640, 560], firm=True))
        self._make_list()
        fill(left, self.where, (self.table, 1), (self.hint, 1), margins=(0, 0, 6, 0))
        yield
        self._make_details()
        yield
        fill(top, (self.view, 1), self.slider, self.frame_words, margins=(6, 0, 0, 0))
        yield
        uses = in_row((self.use_button, 1), (self.play_button, 1))
        others = in_row((self.export_button, 1), (self.verify_button, 1), (self.folder_button, 1))
        fill(below, (self.about, 1), self.bar, uses, others, margins=(6, 0, 0, 0))
        yield
        self._rest = after_rest(self, _REST_MS, self.read_folder)
        self._watcher = QFileSystemWatcher(self)
        self._watcher.directoryChanged.connect(lambda _: self._rest.start())
        session.run_finished.connect(lambda _: self._rest.start())
        self.run.succeeded.connect(
            lambda outcome: self.bar.show_end("; ".join(outcome.verdict), complete=outcome.good)
        )
        for early in (self.run.ended_early, self.run.failed):
            early.connect(lambda ended: self.bar.show_end(ended.words.splitlines()[0], complete=False))
        self.run.over.connect(self._over)
        self.read_folder()

    # The list ------------------------------------------------------------------------------------
    def read_folder(self) -> None:
        """Read the folder of runs again, in a job."""
        folder = self.session.runs_folder
        for watched in (folder, folder / PHOTOGRAPHS):
            if watched.is_dir() and str(watched) not in self._watcher.directories():
                self._watcher.addPath(str(watched))

        def read() -> list[RunSummary]:  # not to its end where the program ends
            return [summary(path) for path in runs_and_photographs(folder) if not self.session.is_closing]

        self._lister.ask(read, self._show_list)

    def open_run(self, path: Path) -> None:
        """Show a run, as soon as it is read."""
        self._close_run(f"Reading {path.name} …")
        self._opening = path
        self._reader.ask(lambda: look_into(path), self._show_run)

    def _show_run(self, opened: Opened | str) -> None:
        self._opening = None
        if isinstance(opened, str):
            self._close_run(opened)
            return
        self.opened = opened
        middle = len(opened.stored) // 2  # the first ones are dark
        with QSignalBlocker(self.slider):
            self.slider.setEnabled(len(opened.stored) > 1)
            self.slider.setVisible(bool(opened.stored))
            self.slider.setRange(0, max(0, len(opened.stored) - 1))
            self.slider.setValue(middle)
        self._stored = opened.stored
        self.about.setPlainText("\n".join(opened.about))
        self._can_resume = opened.can_resume
        self.bar.set_startable("" if self._can_resume else "There is nothing to go on with.")
        self.folder_button.setEnabled(True)
        run = opened.run
        self.verify_button.setEnabled(run is not None)
        self.use_button.setEnabled(opened.to_use is not None)
        is_photograph = opened.to_use is not None and opened.to_use.suffix == ".tif"
        self.use_button.setText("Reconstruct it…" if is_photograph else "Reconstruct with it…")
        self.play_button.setEnabled(run is not None and run.plan is None and bool(opened.stored))
        self.export_button.setEnabled(run is not None and bool(opened.stored))
        self._show_frame(middle)

    def as_python(self) -> str:
        """Return lines that read the run, or go on with it where it did not end."""
        opened, imports = self.opened, Imports()
        if opened is not None and self._can_resume:
            return script(ResumeProcedure(opened.path), self.session.config.path)
        if opened is not None and opened.run is None:
            imports.names.add(("instrument.bench.photograph_file", "read_snapshot"))
            lines = [f"taken = read_snapshot({expression(opened.path, imports)})", "print(taken.metadata)"]
        elif opened is not None:
            imports.names.add(("instrument.runs.run", "Run"))
            lines = [
                f"run = Run.open({expression(opened.path, imports)})",
                "print(run)",
                "for index in sorted(run.records):",
                "    frame, metadata = run.frame(index), run.metadata(index)",
            ]
        else:
            imports.names |= {("instrument.runs.inspection", name) for name in ("run_paths", "summary")}
            folder = expression(self.session.runs_folder, imports)
            lines = [f"for path in run_paths({folder}):", "    print(summary(path))"]
        return "\n".join([*imports.lines(), "", *lines, ""])

    def resume(self) -> None:
        """Go on with the run that is shown."""
        if self.opened is None or self.run.is_running:
            return
        path = self.opened.path
        if self.begin(lambda: self.run.start(f"Resuming {path.name}", ResumeProcedure(path))) is not None:
            self.bar.set_running(True)
            self.table.setEnabled(False)

    def take(self, path: Path) -> None:
        """Show a run that another panel hands on, and mark it in the list as soon as that is read."""
        self._wanted = path
        self.read_folder()

    # Making --------------------------------------------------------------------------------------
    def _make_list(self) -> None:
        self.table = table(_COLUMNS, "Click a run or photograph to open it", wide=0, row_px=26)
        self.table.setSelectionMode(QTableWidget.SelectionMode.SingleSelection)
        self.table.setWordWrap(False)  # it would leave out a word before it shows "…"
        self.table.verticalHeader().hide()
        self.table.currentCellChanged.connect(lambda row, *_: self._row_chosen(row))
        self.where = label(role="dim", yields=True)
        self.hint = Hint(
            "No run yet: each calibration, plan, recording and photograph is listed here.",
            "Calibrate…",
            lambda: self.session.handed_on.emit("sweeps", ""),
        )
        self.hint.hide()

    def _make_details(self) -> None:
        self.view = ImageView(name="Frame of the run")
        follow_orientation(self.session, "frames", self.view.orient)
        self.slider = QSlider(Qt.Orientation.Horizontal)
        self.slider.setToolTip("Frame of the run (arrow keys)")
        self.slider.setAccessibleName("Frame of the run")
        self.slider.valueChanged.connect(self._show_frame)
        self.slider.hide()
        self.frame_words = label(role="dim", yields=True)
        self.about = text_view(empty="What is in a run stands here, once it is clicked.")
        self.about.setAccessibleName("About the run")
        self.bar = RunBar(self.run, "Resume", small=True)
        self.bar.set_startable("No run is open.")
        self.bar.start.connect(self.resume)
        tip = "Show the run's files in the file manager"
        self.folder_button = button("Open folder", tip, self._open_folder, enabled=False)
        tip = "Reconstruct photographs with this run's calibration, or this photograph"
        self.use_button = button("Reconstruct with it…", tip, self._use, enabled=False)
        tip = "Play it as a film, follow regions, reconstruct it as a video"
        self.play_button = button("Play as a film…", tip, self._play, enabled=False)
        tip = "Write frames for other programs: TIFF, HDF5, NumPy, PNG, MP4"
        self.export_button = button("Export…", tip, self._export, enabled=False)
        tip = "Read every frame and hold it against its checksum; changes nothing"
        self.verify_button = button("Verify", tip, self._verify, enabled=False)

    # Inside --------------------------------------------------------------------------------------
    def _show_list(self, summaries: list[RunSummary]) -> None:
        wanted = self._wanted or self._opening or (self.opened and self.opened.path)
        self.summaries = summaries
        folder = self.session.runs_folder
        photographs = sum(listed.is_photograph for listed in summaries)
        said = count(len(summaries) - photographs, "run")
        said += f" and {count(photographs, 'photograph')}" if photographs else ""
        simulated = bool(summaries) and all(listed.is_simulated for listed in summaries)
        self.table.setColumnHidden(len(_COLUMNS) - 1, simulated)  # said once
        self.table.setColumnHidden(_COLUMNS.index("kind"), not photographs)
        said += ", SIMULATED," if simulated else ""
        self.where.setText(f"{said} in {folder.parent.name}/{folder.name}")
        self.where.setToolTip(str(folder))
        self.where.setVisible(bool(summaries))
        self.hint.setVisible(not summaries)
        self.details.setVisible(bool(summaries) or self.opened is not None)
        self.table.setVisible(bool(summaries))
        paths = [listed.path for listed in summaries]
        chosen = paths.index(wanted) if wanted in paths else -1
        with QSignalBlocker(self.table):
            self.table.setRowCount(len(summaries))
            for number, listed in enumerate(summaries):
                texts = (
                    _called(listed.path),
                    listed.became,
                    f"{listed.stored}"
                    if listed.stored == listed.frames
                    else f"{listed.stored} of {listed.frames}",
                    listed.kind,
                    "SIMULATED" if listed.is_simulated else "",
                )
                for place, text in enumerate(texts):
                    tip = listed.problem or (str(listed.path) if place == 0 else text)
                    warns = place == 1 and listed.became != RunCondition.COMPLETED
                    self.table.setItem(number, place, cell(text, tip, number=place == 2, warns=warns))
            self.table.setCurrentCell(chosen, 0) if chosen >= 0 else self.table.clearSelection()
        if chosen >= 0 and self._wanted is not None:
            self._wanted = None
            self.open_run(summaries[chosen].path)

    def _row_chosen(self, row: int) -> None:
        if 0 <= row < len(self.summaries) and not self.run.is_running:
            listed = self.summaries[row]
            if listed.condition is None:
                self._close_run(f"{listed.path}: {listed.problem}")
            else:
                self.open_run(listed.path)
                self.bar.clear()  # how another one ended

    def _close_run(self, why: str) -> None:
        self._reader.forget()
        self._verifier.forget()
        self.opened, self._opening, self._stored = None, None, []
        self.view.clear()
        self.slider.setEnabled(False)
        self.slider.hide()
        self.frame_words.clear()
        self.about.setPlainText(why)
        self._can_resume = False
        self.bar.set_startable("No run is open.")
        self.folder_button.setEnabled(False)
        self.verify_button.setEnabled(False)
        for each in (self.use_button, self.play_button, self.export_button):
            each.setEnabled(False)

    def _show_frame(self, number: int) -> None:
        opened = self.opened
        if opened is None or not self._stored:
            self.view.clear()
            self.frame_words.setText("No frames." if opened is not None else "")
            return
        index = self._stored[min(number, len(self._stored) - 1)]
        self._reader.ask(lambda: read_frame(opened, index), self._frame_read)

    def _frame_read(self, frame: Picture | str) -> None:
        if isinstance(frame, str):
            self.frame_words.setText(frame)
        else:
            self.view.show_image(frame.image, frame.low, frame.high, frame.full_scale)
            self.frame_words.setText(frame.words)

    def _use(self) -> None:
        if self.opened is not None:
            self.session.handed_on.emit("reconstructions", self.opened.to_use)

    def _play(self) -> None:
        if self.opened is not None:
            self.session.handed_on.emit("films", self.opened.path)

    def _export(self) -> None:
        if self.opened is not None:
            self.session.handed_on.emit("tasks", ("export", {"run": self.opened.path}))

    def _verify(self) -> None:
        """Read every frame of the run that is shown; ends early where another run is opened."""
        if self.opened is None:
            return
        path = self.opened.path
        self.verify_button.setEnabled(False)
        self.about.setPlainText(f"Reading every frame of {path.name} …")

        def watch(_: int, __: int) -> None:
            if self.session.is_closing or self.opened is None or self.opened.path != path:
                raise InterruptedError

        def show(opened: Opened | str) -> None:
            self._show_run(opened)
            self.read_folder()  # which marks what was found damaged

        self._verifier.ask(lambda: look_into(path, read=True, on_progress=watch), show)

    def _open_folder(self) -> None:
        if self.opened is not None:
            QDesktopServices.openUrl(QUrl.fromLocalFile(str(self.opened.folder)))

    def _over(self) -> None:
        self.bar.set_running(False)
        self.table.setEnabled(True)
        if self.opened is not None:
            self._wanted = self.opened.path
        self.read_folder()


_DATED = re.compile(r"\d{4}-(\d\d-\d\d)_(\d\d)-(\d\d)-(\d\d)_?(.*)")


def _called(path: Path) -> str:
    """Return what a run or photograph is called in the list: what distinguishes it first."""
    dated = _DATED.fullmatch(path.stem if path.suffix == ".tif" else path.name)
    if dated is None:
        return path.name
    day, hour, minute, second, name = dated.groups()
    return f"{day} {hour}:{minute}:{second} {name}".strip()
