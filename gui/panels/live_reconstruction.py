"""The live reconstruction: a picture of the newest frame, with its latency; refined on request."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from PySide6.QtGui import QHideEvent
from PySide6.QtWidgets import QComboBox, QWidget

from drivers.frame import FrameMetadata
from gui.background import NewestOnly
from gui.forms.options_form import FOLDED, OptionsForm
from gui.jobs import Job, JobContext
from gui.live_calibration import calibration_of, depths_um, last_or_newest
from gui.live_depth import DepthSeeker
from gui.live_doubts import LiveDoubts
from gui.live_follower import LiveFollower
from gui.panel import Panel, on_bench
from gui.session import BenchSession
from gui.widgets.building import Hint, button, choice, every, fill, in_row, label, offer, scrolled
from gui.widgets.dialogues import elided, path_field
from gui.widgets.entry import NumberEdit
from gui.widgets.image_view import ImageView
from gui.widgets.orientation import OrientationButton, follow_orientation
from instrument.files.calibration_file import calibration_name, find_calibration, load_calibration
from instrument.files.errors import BenchError, count, duration
from instrument.live.light_log import NOTHING_LIT
from instrument.live.live import LiveResult
from recon.arrays import Array, Float32Array
from recon.base.as_python import Imports, expression
from recon.base.declare import options_of
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import ITERATIONS
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import LiveOptions
from recon.types import Calibration

_LOOK_MS = 50
_BUDGET_MS = 80.0
"""A picture's time: twelve a second leave half of a two-core machine to the camera and the window."""
"""Without a frame for longer than this and three exposures, the picture is called old."""
_TELL_S = 0.5
"""Figures below the picture are written this often, at most: each time the panel is laid out and painted."""
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
    image: Float32Array


def _lines(words: tuple[str, str]) -> str:
    return "\n".join(filter(None, words))


class LiveReconstructionPanel(Panel):
    """Reconstructs the live view's newest frame again and again; never slows the camera.

    The options are those of every reconstruction that apply to live pictures, folded away behind a button.
    """

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.follower = LiveFollower(session.live, lambda frame: session.lights.during(frame) != NOTHING_LIT)
        self.loaded: _Loaded | None = None
        self._reader = NewestOnly(session.jobs, "Loading the calibration", self._refuse)
        self._loading: Job | None = None
        """The newest job that prepares a preview; what older ones bring is dropped."""
        self._refining: Job | None = None
        self._holds = False
        self._shown: LiveResult | None = None
        self._telling = self._told = ("", "")
        """How quickly the picture shown came, and what it is worth; what of that is written."""
        self._told_s = 0.0
        self._seeker = DepthSeeker(session, self._use_depth)
        self._doubts = LiveDoubts(session)
        self._logged: tuple[str, ...] = ()
        """Warnings of the reconstructor in use that are in the log already."""

    @classmethod
    def prepare(cls) -> None:
        """Look for methods that installed packages add: the form offers them."""
        for offered in options_of(ReconstructionOptions):
            _ = offered.words

    def wholes(self) -> list[QWidget]:
        """Return the form's halves: it has most of the panel's widgets."""
        return self.options.wholes()

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        session = self.session
        self.view = ImageView(name="Reconstruction of the newest frame")
        follow_orientation(session, "results", self.view.orient)
        yield
        self.file, self.browse_button = path_field(
            "calibration folder",
            "A calibration, or a run that holds one",
            self.load,
            browse="folder",
            start=session.runs_folder,
        )
        self.plane = choice((), "Depth of the scene: which PSFs of the calibration are used")
        self.plane.hide()  # until a calibration has several
        self.plane.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToContents)
        self.plane.activated.connect(self._seeker.leave)
        self.plane.activated.connect(self._rebuild)
        tip = "Reconstruct the newest frame again and again"
        self.run_button = button("▶ Preview", tip, checkable=True)
        self.run_button.setChecked(True)
        self.run_button.toggled.connect(self._toggle)
        tip = "Reconstruct the newest frame with the full solver; again ends it"
        self.refine_button = button("Refine", tip, self.refine, enabled=False)
        tip = "Time for one picture: quality gives way"
        self.budget = NumberEdit("ms", _BUDGET_MS, minimum=5.0, maximum=5000.0, tip=tip)
        self.budget.setFixedWidth(80)
        self.budget.submitted.connect(self._set_budget)
        self.heed(self.budget)
        declared = (*options_of(ReconstructionOptions), *options_of(LiveOptions))
        own = ("z_um", "budget_ms")
        asked = [o for o in declared if o.name not in own]
        self.options = OptionsForm(asked, folded=(*FOLDED, "Computing"), whole=False)
        folded = scrolled(self.options)
        folded.hide()
        yield
        tip = "Prior, solver, camera model, background; how frames are binned"
        self.options_button = button("Options", tip, checkable=True)
        self.options_button.toggled.connect(folded.setVisible)
        tip = "Turn and mirror reconstructed pictures, in every panel."
        self.turn_button = OrientationButton(session, "results", tip)
        self.status = label(_NO_CALIBRATION, "dim", wraps=True)
        yield
        self.hint = Hint(
            "No calibration yet: with one, what the camera sees becomes a picture as it comes.",
            "Calibrate…",
            lambda: session.handed_on.emit("sweeps", ""),
        )
        first = in_row((self.file, 1), self.browse_button, self.plane)
        switches = (self.run_button, self.refine_button, self.options_button)
        second = in_row(*switches, self.turn_button, None, label("within"), self.budget)
        fill(self.body, first, (self.view, 1), (self.hint, 1), self.status, second, (folded, 1))
        yield
        yield from self.options.parts()
        self.options.show_for("live picture")
        self.options.settled.connect(lambda _: self._rebuild())
        self.options.refused.connect(self.refused)
        yield
        session.run_finished.connect(self._run_finished)
        self._timer = every(self, _LOOK_MS, self.look)
        folder = session.runs_folder
        self._load(_NO_CALIBRATION, lambda: last_or_newest(session.kept, folder))

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that reconstruct live with the same calibration."""
        calibration = "calibration" if self.loaded is None else str(self.loaded.path)
        imports = Imports({("instrument.live.live", "live_view")})
        options, live = (expression(asked, imports, indent="    ") for asked in self._asked(self.z_um))
        lines = (
            f"options = {options}",
            f"settings = {live}",
            f"with live_view(bench, {calibration!r}, options, settings) as live:",
            "    for result in live:",
            "        print(result.picture.quality, result.latency_ms)",
        )
        return on_bench(self.session.config.path, lines, imports)

    def shutdown(self) -> None:
        """End the timer, the preview and a refinement."""
        super().shutdown()
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
        self._reader.forget()
        # Another reader: none waits for an older calibration.
        self._reader = NewestOnly(self.jobs, "Loading the calibration", self._refuse)
        self._load(f"Loading {folder} …", lambda: find_calibration(folder))

    def take(self, what: Path) -> None:
        """Use the calibration that another panel hands on."""
        self.file.setText(str(what))
        self.load()

    def _load(self, words: str, find: Callable[[], Path | None]) -> None:
        """Load the calibration that is found in a job's thread, if one is."""
        self.status.setText(words)

        def read() -> tuple[Path, Calibration] | None:
            found = find()
            return None if found is None else (found, load_calibration(found))

        self._reader.ask(read, self._got_calibration)

    @property
    def options_form(self) -> OptionsForm:
        """The form whose fields messages are about."""
        return self.options

    def _refuse(self, why: str) -> None:
        self.refused(self.file, why)
        if self.loaded is None:
            self.hint.say(self.in_its_words(why))
            self.status.setText(_NO_CALIBRATION)

    def _got_calibration(self, read: tuple[Path, Calibration] | None) -> None:
        if read is not None:
            path, calibration = read
            depths = depths_um(calibration)
            self._seeker.begin()
            self._build(path, calibration, depths[len(depths) // 2] if depths else None)

    def _use_depth(self, z_um: float) -> None:
        if self.loaded is not None:
            self._build(self.loaded.path, self.loaded.calibration, z_um)

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
        self._call_old("another preview is being prepared")
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
        self._refuse(why)

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
        path = str(self.loaded.path)
        if self.session.kept.of("live").get("calibration") != path:
            self.session.keep("live", "calibration", path)  # the last one that worked
        self.status.setText("Waiting for a frame …")

    def _show_depths(self, loaded: _Loaded) -> None:
        """List the depths of the calibration in use, with the one that is used."""
        depths: list[float | None] = list(depths_um(loaded.calibration))
        depths += [None] if depths else []
        if [self.plane.itemData(i) for i in range(self.plane.count())] != depths:
            offer(self.plane, [(_ALL_DEPTHS if z is None else f"z {z / 1e3:.4g} mm", z) for z in depths])
        if depths:
            self.plane.setCurrentIndex(depths.index(loaded.z_um))
        self.plane.setVisible(bool(depths))

    def _run_finished(self, path: Path) -> None:
        if self.loaded is None:
            self._load(_NO_CALIBRATION, lambda: calibration_of(path))

    def _set_budget(self, value: float) -> None:
        if self.loaded is not None:
            self.loaded.reconstructor.budget_ms = value

    # Pictures ------------------------------------------------------------------------------------
    def look(self) -> None:
        """Show the newest picture, if it is another than the one shown."""
        self.hint.setVisible(self.loaded is None)
        self.refine_button.setEnabled(self.loaded is not None or self._refining is not None)
        self.view.setVisible(self.loaded is not None)
        self.status.setVisible(self.loaded is not None or self._reader.is_reading)  # else the hint says it
        runs = self.run_button.isChecked() and self._refining is None and self._loading is None
        if runs and self.isVisible():
            self.follower.follow()
        if self._holds or not self.isVisible() or not runs:
            return
        if self.follower.problem:
            elided(self.status, self.follower.problem)
            self._call_old("the preview has ended, see below")
            return
        silent = self._doubts.of_silence(self._shown)
        if silent and self.session.live.stream is None:
            self._call_old(silent)
            return
        result = self.follower.newest()
        if result is None or result is self._shown:
            if silent:
                self._call_old(silent)
            if self.status.text() == _lines(self._told):  # nothing else was said since
                self._tell(self._telling)
            return
        self._shown = result
        self._show_picture(result.picture.image)
        how = self.follower.status
        self._log_new(() if how is None else how.warnings)
        rate = "" if how is None or not how.pictures_per_s > 0 else f", {how.pictures_per_s:.1f} pictures/s"
        passed = "" if how is None else f", {count(how.passed_over, 'frame')} passed over"
        if silent:  # the old frame's picture goes on to be refined
            self._call_old(silent)
        else:
            if self.loaded is not None:
                self._seeker.see(result, self.loaded.reconstructor)
            self.view.caution_against(self._doubts.of(result, self._seeker.words))
        self.view.set_caption(self._caption(result.metadata))
        # What is doubted stands over the picture.
        worth = result.picture.quality.removeprefix(result.picture.said).removeprefix(": ")
        late = (
            f"{result.latency_ms:.0f} ms" if result.latency_ms < 1000 else f"{result.latency_ms / 1e3:.2f} s"
        )
        self._tell((f"latency {late}{rate}{passed}", worth))

    def _tell(self, words: tuple[str, str]) -> None:
        """Write below the picture what is told of it; where only figures are new, not at once."""
        self._telling, now_s = words, time.monotonic()
        written = self.status.text() == _lines(self._told)
        soon = words[1] == self._told[1] and now_s < self._told_s + _TELL_S
        if written and (soon or words == self._told):
            return
        self._told, self._told_s = words, now_s
        self.status.setText(_lines(words))

    def _call_old(self, why: str) -> None:
        """Say over the picture that it stays while no other comes: of frames, or of the preview."""
        if self._shown is not None:
            doubt = self._doubts.of(self._shown, self._seeker.words)
            self.view.caution_against(". ".join(filter(None, (f"Old picture: {why}", doubt))), old=True)

    def _caption(self, frame: FrameMetadata) -> str:
        """Say of which frame a picture is, and with which calibration it was made."""
        made = "" if self.loaded is None else f", calibration: {calibration_name(self.loaded.path)}"
        return self.session.describe_frame(frame) + made

    def _log_new(self, warnings: tuple[str, ...]) -> None:
        """Write each warning into the log once."""
        for warning in warnings:
            if warning not in self._logged:
                self.session.log("warning", f"Live reconstruction: {warning}")
        self._logged = warnings

    def _show_picture(self, image: Array) -> None:
        sample = image[::3, ::3]
        self.view.show_image(image, 0.0, float(np.percentile(sample, _WHITE)) or 1.0)

    def _toggle(self, on: bool) -> None:
        self._holds = False
        if not on:
            self._end_preview()
            self.status.setText("The preview is off.")
            self._call_old("the preview is off")

    def _end_preview(self) -> None:
        self.follower.end()  # when the window closes, the job may not be begun any more
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
            return
        if frame is None:
            self.refused(None, "There is no frame yet: start the live view.")
            return
        image = np.array(frame.image)  # a copy: the ring's buffer is wanted back
        reconstructor = loaded.reconstructor

        def work(context: JobContext) -> tuple[Reconstruction, Float32Array]:
            self.follower.stop()

            def watch(record: Any, present: Any) -> None:
                left_s = max(ITERATIONS - record.iteration, 0) * record.seconds / record.iteration
                context.offer(lambda: _SoFar(record.iteration, left_s, reconstructor.shown(present()).copy()))

            result = reconstructor.full(image, on_progress=watch, cancel=context.cancel)
            return result, reconstructor.shown(result.volume)

        job = self.session.jobs.compute("Refining the newest frame", work)
        self._refining = job
        self.refine_button.setText("■ End")
        self.view.caution_against(
            f"In the making, from the frame of {frame.metadata.utc.astimezone():%H:%M:%S}"
        )
        self.view.set_caption(self._caption(frame.metadata))
        self.status.setText(f"Refining frame {frame.metadata.frame_id} …")
        job.progressed.connect(self._refined_so_far)
        job.succeeded.connect(self._refined)
        job.succeeded.connect(lambda _: self.view.caution_against(self._refined_doubt(frame.metadata)))
        job.failed.connect(lambda why: self.refused(None, why))
        job.ended.connect(self._refining_ended)

    def _refined_so_far(self, value: object) -> None:
        so_far = cast(_SoFar, value)
        self._show_picture(so_far.image)
        left = f"at most {duration(so_far.most_left_s)} left"
        self.status.setText(f"Refining: iteration {so_far.iteration} of at most {ITERATIONS}, {left}")

    def _refined(self, value: object) -> None:
        result, shown = cast(tuple[Reconstruction, Float32Array], value)
        self._holds = True
        self._show_picture(shown)
        elided(
            self.status,
            f"Refined: {result.solver} with {result.prior}, {len(result.history)} iterations, "
            f"{result.seconds:.1f} s, {result.stop_reason}. {self.in_its_words(' '.join(result.warnings))}",
        )

    def _refined_doubt(self, frame: FrameMetadata) -> str:
        """Return what was doubtful about the frame that was refined, as its preview had it."""
        shown = self._shown
        if shown is not None and shown.metadata.frame_id == frame.frame_id:
            return self._doubts.of(shown, self._seeker.words)
        return self._doubts.of_frame(frame)

    def _refining_ended(self) -> None:
        self._refining = None
        self.refine_button.setText("Back to the preview" if self._holds else "Refine")
