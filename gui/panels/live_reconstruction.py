"""The live reconstruction: a picture of the newest frame, with its latency; refined on request."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QTimer
from PySide6.QtGui import QHideEvent
from PySide6.QtWidgets import QComboBox, QHBoxLayout, QLabel, QLineEdit, QPushButton, QVBoxLayout, QWidget

from gui.background import LiveFollower
from gui.forms.options_form import FOLDED, OptionsForm
from gui.jobs import Job, JobContext
from gui.panel import Panel
from gui.session import BenchSession
from gui.widgets.building import scrolled
from gui.widgets.dialogues import choose_path, elided
from gui.widgets.entry import NumberEdit
from gui.widgets.image_view import ImageView
from instrument.bench.photograph import LightState, light_of
from instrument.files.calibration_file import is_calibration, load_calibration, newest_calibration
from instrument.files.errors import BenchError, duration
from instrument.live.live import LiveResult
from instrument.reconstruction.job import find_calibration
from recon.base.declare import Imports, expression, options_of
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import ITERATIONS
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import LiveOptions
from recon.types import Calibration

_LOOK_MS = 50
_BUDGET_MS = 80.0
"""A picture's time: twelve a second leave half of a two-core machine to the camera and the window."""
_PROGRESS_S = 0.5
_NO_CALIBRATION = "Choose a calibration; the Sweeps panel makes one."
_ALL_DEPTHS = "all depths"
_WHITE = 99.8
"""Percentile of a picture that is shown white."""


@dataclass(frozen=True, slots=True)
class _Loaded:
    path: Path
    calibration: Calibration
    reconstructor: LiveReconstructor

    @property
    def z_um(self) -> float | None:
        return self.reconstructor.options.z_um


@dataclass(frozen=True, slots=True)
class _SoFar:
    iteration: int
    most_left_s: float
    """Time to the last iteration allowed: the picture mostly settles before."""
    image: npt.NDArray[np.float32]


class LiveReconstructionPanel(Panel):
    """Reconstructs the live view's newest frame again and again; never slows the camera.

    The options are those of every reconstruction that apply to live pictures, folded away behind a button.
    """

    title = "Live reconstruction"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.follower = LiveFollower(session.live)
        self.loaded: _Loaded | None = None
        self._reading: Job | None = None
        """The newest job that loads a calibration; what older ones bring is dropped."""
        self._loading: Job | None = None
        """The newest job that prepares a preview; what older ones bring is dropped."""
        self._refining: Job | None = None
        self._holds = False
        self._shown: LiveResult | None = None
        self._logged: tuple[str, ...] = ()
        """Warnings of the reconstructor in use that are in the log already."""
        self.view = ImageView()
        self.file = QLineEdit()
        self.file.setPlaceholderText("calibration folder")
        self.file.setToolTip("A calibration, or a run that holds one; Enter loads it")
        self.file.returnPressed.connect(self.load)
        self.browse_button = QPushButton("…")
        self.browse_button.setToolTip("Choose a calibration folder")
        self.browse_button.clicked.connect(self._browse)
        self.plane = QComboBox()
        self.plane.setToolTip("Depth of the scene: which PSFs of the calibration are used")
        self.plane.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToContents)
        self.plane.activated.connect(self._rebuild)
        self.run_button = QPushButton("▶ Preview")
        self.run_button.setCheckable(True)
        self.run_button.setChecked(True)
        self.run_button.setToolTip("Reconstruct the newest frame again and again")
        self.run_button.toggled.connect(self._toggle)
        self.refine_button = QPushButton("Refine")
        self.refine_button.setToolTip("Reconstruct the newest frame with the full solver; again ends it")
        self.refine_button.clicked.connect(self.refine)
        self.budget = NumberEdit(
            "ms", _BUDGET_MS, minimum=5.0, maximum=5000.0, tip="Time for one picture: quality gives way"
        )
        self.budget.setFixedWidth(80)
        self.budget.submitted.connect(self._set_budget)
        self.budget.refused.connect(lambda why: self.refused(None, why))
        declared = (*options_of(ReconstructionOptions), *options_of(LiveOptions))
        own = ("z_um", "budget_ms")
        self.options = OptionsForm([o for o in declared if o.name not in own], folded=(*FOLDED, "Computing"))
        self.options.show_for("live picture")
        self.options.settled.connect(lambda _: self._rebuild())
        self.options.refused.connect(self.refused)
        folded = scrolled(self.options)
        folded.hide()
        self.options_button = QPushButton("Options")
        self.options_button.setCheckable(True)
        self.options_button.setToolTip("Prior, solver, camera model, background; how frames are binned")
        self.options_button.toggled.connect(folded.setVisible)
        self.status = QLabel(_NO_CALIBRATION)
        self.status.setWordWrap(True)
        self.status.setObjectName("dim")
        first = QHBoxLayout()
        first.addWidget(self.file, 1)
        first.addWidget(self.browse_button)
        first.addWidget(self.plane)
        second = QHBoxLayout()
        second.addWidget(self.run_button)
        second.addWidget(self.refine_button)
        second.addWidget(self.options_button)
        second.addStretch(1)
        second.addWidget(QLabel("within"))
        second.addWidget(self.budget)
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(first)
        layout.addWidget(self.view, 1)
        layout.addWidget(self.status)
        layout.addLayout(second)
        layout.addWidget(folded, 1)
        session.run_finished.connect(self._run_finished)
        self._timer = QTimer(self)
        self._timer.timeout.connect(self.look)
        self._timer.start(_LOOK_MS)
        self._find_newest()

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that reconstruct live with the same calibration."""
        path = self.session.config.path
        calibration = "calibration" if self.loaded is None else str(self.loaded.path)
        imports = Imports({("instrument.bench.bench", "open_bench"), ("instrument.live.live", "live_view")})
        options, live = (expression(asked, imports, indent="    ") for asked in self._asked(self.z_um))
        lines = (
            "",
            f"with open_bench({str(path) if path else None!r}) as bench:",
            f"    options = {options}",
            f"    settings = {live}",
            f"    with live_view(bench, {calibration!r}, options, settings) as live:",
            "        for result in live:",
            "            print(result.picture.quality, result.latency_ms)",
        )
        return "\n".join((*imports.lines(), *lines, ""))

    def shutdown(self) -> None:
        """End the timer, the preview and a refinement."""
        self._timer.stop()
        if self._refining is not None:
            self._refining.cancel()
        self._end_preview()

    @property
    def z_um(self) -> float | None:
        """The depth chosen, micrometres; None for all, and where the calibration has one PSF."""
        value = self.plane.currentData()
        return None if value is None else float(value)

    # The calibration -----------------------------------------------------------------------------
    def load(self) -> None:
        """Load the calibration in the field."""
        folder = Path(self.file.text().strip()).expanduser()
        self.status.setText(f"Loading {folder} …")

        def work(_: JobContext) -> tuple[Path, Calibration]:
            found = find_calibration(folder)
            return found, load_calibration(found)

        job = self.session.jobs.compute("Loading the calibration", work)
        job.quiet = True
        self._reading = job
        job.succeeded.connect(lambda value: self._got_calibration(job, value))
        job.failed.connect(lambda why: self._refuse(job, why))

    def _refuse(self, job: Job, why: str) -> None:
        if job in (self._reading, self._loading):
            self.refused(self.file, why)
            if self.loaded is None:
                self.status.setText(_NO_CALIBRATION)

    def _got_calibration(self, job: Job, value: object) -> None:
        if job is not self._reading:
            return
        path, calibration = cast(tuple[Path, Calibration], value)
        depths = _depths_um(calibration)
        self._build(path, calibration, depths[len(depths) // 2] if depths else None)

    def _rebuild(self) -> None:
        if self.loaded is not None:
            self._build(self.loaded.path, self.loaded.calibration, self.z_um)

    def _build(self, path: Path, calibration: Calibration, z_um: float | None) -> None:
        try:
            asked = self._asked(z_um)
        except BenchError as error:
            self.refused(None, str(error))
            return

        def work(_: JobContext) -> _Loaded:
            self.follower.stop()
            return _Loaded(path, calibration, LiveReconstructor(calibration, *asked))

        job = self.session.jobs.compute("Preparing the preview", work)
        job.quiet = True
        self._loading = job
        job.succeeded.connect(lambda value: self._ready(job, value))
        job.failed.connect(lambda why: self._not_ready(job, why))
        job.ended.connect(lambda: self._not_loading(job))

    def _asked(self, z_um: float | None) -> tuple[ReconstructionOptions, LiveOptions]:
        """Return the options as they stand here; BenchError where one cannot be read."""
        live = replace(self.options.make(LiveOptions), budget_ms=self.budget.value or _BUDGET_MS)
        return replace(self.options.make(ReconstructionOptions), z_um=z_um), live

    def _not_ready(self, job: Job, why: str) -> None:
        """Say why, and what goes on: the preview of before."""
        if job is not self._loading:
            return
        loaded = self.loaded
        if loaded is not None:
            self._show_depths(loaded)
            depth = f", {self.plane.currentText()}" if self.plane.count() else ""
            why = f"{why} The preview goes on as before: {loaded.path}{depth}."
        else:
            self.status.setText(_NO_CALIBRATION)
        self.refused(self.file, why)

    def _not_loading(self, job: Job) -> None:
        if job is self._loading:
            self._loading = None

    def _ready(self, job: Job, value: object) -> None:
        if job is not self._loading:
            return  # another depth was chosen meanwhile
        self.loaded = cast(_Loaded, value)
        self.accepted(self.file)
        self.file.setText(str(self.loaded.path))
        self._show_depths(self.loaded)
        self.follower.use(self.loaded.reconstructor)
        self.status.setText("Waiting for a frame …")

    def _show_depths(self, loaded: _Loaded) -> None:
        """List the depths of the calibration in use, with the one that is used."""
        depths: list[float | None] = list(_depths_um(loaded.calibration))
        depths += [None] if depths else []
        if [self.plane.itemData(i) for i in range(self.plane.count())] != depths:
            self.plane.clear()
            for z_um in depths:
                self.plane.addItem(_ALL_DEPTHS if z_um is None else f"z {z_um / 1e3:.4g} mm", z_um)
        if depths:
            self.plane.setCurrentIndex(depths.index(loaded.z_um))
        self.plane.setVisible(bool(depths))

    def _browse(self) -> None:
        start = self.file.text() or str(self.session.runs_folder)

        def chosen(path: Path) -> None:
            self.file.setText(str(path))
            self.load()

        choose_path(self, "folder", "Calibration", start, chosen)

    def _find_newest(self) -> None:
        """Begin with the newest calibration among the runs, if there is one."""
        newest = newest_calibration(self.session.runs_folder)
        if newest is not None:
            self.file.setText(str(newest))
            self.load()

    def _run_finished(self, path: Path) -> None:
        if self.loaded is None and (is_calibration(path) or any(path.glob("*/calibration.json"))):
            self.file.setText(str(path))
            self.load()

    def _set_budget(self, value: float) -> None:
        if self.loaded is not None:
            self.loaded.reconstructor.budget_ms = value

    # Pictures ------------------------------------------------------------------------------------
    def look(self) -> None:
        """Show the newest picture, if it is another than the one shown."""
        runs = self.run_button.isChecked() and self._refining is None and self._loading is None
        if runs and self.isVisible():
            self.follower.follow()
        if self._holds or not self.isVisible() or not runs:
            return
        if self.follower.problem:
            elided(self.status, self.follower.problem)
            return
        result = self.follower.newest()
        if result is None or result is self._shown:
            return
        self._shown = result
        self._show_picture(result.picture.image)
        how = self.follower.status
        self._log_new(() if how is None else how.warnings)
        rate = "" if how is None or not how.pictures_per_s > 0 else f", {how.pictures_per_s:.1f} pictures/s"
        passed = "" if how is None else f", {how.passed_over} frames passed over"
        dark = light_of(self.session.bench) is LightState.DARK
        warning = "Nothing is lit: this is a picture of noise. " if dark else ""
        self.status.setText(
            f"{warning}latency {result.latency_ms:.0f} ms{rate}{passed}\n{result.picture.quality}"
        )

    def _log_new(self, warnings: tuple[str, ...]) -> None:
        """Write each warning into the log once."""
        for warning in warnings:
            if warning not in self._logged:
                self.session.log("warning", f"Live reconstruction: {warning}")
        self._logged = warnings

    def _show_picture(self, image: npt.NDArray[Any]) -> None:
        sample = image[::3, ::3]
        self.view.show_image(image, 0.0, float(np.percentile(sample, _WHITE)) or 1.0)

    def _toggle(self, on: bool) -> None:
        self._holds = False
        if not on:
            self._end_preview()
            self.status.setText("The preview is off.")

    def _end_preview(self) -> None:
        self.session.jobs.watch("Ending the preview", lambda _: self.follower.stop())

    def hideEvent(self, event: QHideEvent) -> None:  # noqa: N802 - Qt's name
        """End the preview that nobody sees; it goes on when the panel is shown again."""
        super().hideEvent(event)
        if self._timer.isActive() and self.follower.is_following and not event.spontaneous():
            self._end_preview()

    # Refining ------------------------------------------------------------------------------------
    def refine(self) -> None:
        """Reconstruct the newest frame with the full solver; while it runs, end it."""
        if self._refining is not None:
            self._refining.cancel()
            return
        if self._holds:  # back to the preview
            self._holds = False
            self.refine_button.setText("Refine")
            return
        frame, loaded = self.session.live.newest(), self.loaded
        if loaded is None:
            self.refused(self.file, "Choose a calibration first.")
            return
        if frame is None:
            self.refused(None, "There is no frame yet: start the live view.")
            return
        image = np.array(frame.image)  # a copy: the ring's buffer is wanted back

        reconstructor = loaded.reconstructor

        def work(context: JobContext) -> tuple[Reconstruction, npt.NDArray[np.float32]]:
            self.follower.stop()
            shown_s = time.monotonic()

            def watch(record: Any, present: Any) -> None:
                nonlocal shown_s
                if not context.cancel.is_set() and time.monotonic() - shown_s > _PROGRESS_S:
                    shown_s = time.monotonic()
                    left = max(ITERATIONS - record.iteration, 0)
                    left_s = left * record.seconds / record.iteration
                    context.report(_SoFar(record.iteration, left_s, reconstructor.shown(present()).copy()))

            result = reconstructor.full(image, on_progress=watch, cancel=context.cancel)
            return result, reconstructor.shown(result.volume)

        job = self.session.jobs.compute("Refining the newest frame", work)
        self._refining = job
        self.refine_button.setText("■ End")
        self.status.setText(f"Refining frame {frame.metadata.frame_id} …")
        job.progressed.connect(self._refined_so_far)
        job.succeeded.connect(self._refined)
        job.failed.connect(lambda why: self.refused(None, why))
        job.ended.connect(self._refining_ended)

    def _refined_so_far(self, value: object) -> None:
        so_far = cast(_SoFar, value)
        self._show_picture(so_far.image)
        left = f"at most {duration(so_far.most_left_s)} left"
        self.status.setText(f"Refining: iteration {so_far.iteration} of at most {ITERATIONS}, {left}")

    def _refined(self, value: object) -> None:
        result, shown = cast(tuple[Reconstruction, npt.NDArray[np.float32]], value)
        self._holds = True
        self._show_picture(shown)
        reason = f", {result.stop_reason}"
        elided(
            self.status,
            f"Refined: {result.solver} with {result.prior}, {len(result.history)} iterations, "
            f"{result.seconds:.1f} s{reason}. {' '.join(result.warnings)}",
        )

    def _refining_ended(self) -> None:
        self._refining = None
        self.refine_button.setText("Back to the preview" if self._holds else "Refine")


def _depths_um(calibration: Calibration) -> list[float]:
    """Return the depths to choose from, ascending; none where there is but one, or none is known."""
    depths = np.unique(calibration.source_positions_um[:, 2])
    depths = depths[np.isfinite(depths)]
    return [float(z_um) for z_um in depths] if len(depths) > 1 else []
