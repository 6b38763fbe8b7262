"""Reconstructions: those that are there, to be looked at and exported, and a form for new ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from html import escape
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QStackedWidget, QTabWidget, QWidget

from gui.background import NewestOnly
from gui.forms.options_form import OptionsForm, SuggestedName
from gui.forms.reconstruct import (
    CALIBRATION,
    PSF,
    Explained,
    ReconstructForm,
    SoFar,
    Written,
    explain_job,
    reconstruct_job,
)
from gui.jobs import Job, JobContext
from gui.panel import Panel
from gui.panels.results_list import ResultsList
from gui.result_export import ResultExport
from gui.session import BenchSession
from gui.session_news import OwnFiles
from gui.theme import as_shown
from gui.widgets.building import Hint, button, fill, in_row, label, split
from gui.widgets.result_views import ConvergenceView, FactsView, PictureView
from gui.widgets.volume_view import VolumeView
from instrument.files.calibration_file import (
    calibrated_depths_um,
    calibration_name,
    find_calibration,
    newest_calibration,
)
from instrument.files.errors import BenchError, FileError
from instrument.reconstruction.request import VolumeRequest
from instrument.reconstruction.stored_result import StoredResult, open_result
from recon.base.as_python import Imports, expression
from recon.base.declare import options_of
from recon.reconstruction.options import ReconstructionOptions

_NOTHING_OPEN = "Nothing is open: choose a result on the left, or reconstruct a photograph."
_FORM_OPEN = "Nothing is open: fill in the form on the left, then press Reconstruct."
_AS_IT_STANDS = "as it stands would be reconstructed like this:"
_COMES = "The first picture is being computed …"
_REFINABLE = "--refine-psf fits"
"""In the verdict's sentence, where fitting the PSF to the photograph is what helps."""


class ReconstructionsPanel(Panel):
    """Results in the data folder, a viewer for pictures and volumes, and the form."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.result: StoredResult | None = None
        self.export = ResultExport(self, lambda: self.result, self._shown, lambda: self.picture.orientation)
        self.job: Job | None = None
        self._explaining: Job | None = None
        self._opening: Job | None = None
        self._first_picture = True
        self._made: Path | None = None
        """The result that the form as it stands has made."""

    @classmethod
    def prepare(cls) -> None:
        """Look for methods that installed packages add: the form offers them."""
        for offered in options_of(ReconstructionOptions):
            _ = offered.words

    def parts(self) -> Iterator[None]:
        """Make what holds the widgets, then those: each takes its looks when it gets its place."""
        session = self.session
        self.tabs, self.viewers = QTabWidget(), QStackedWidget()
        self.tabs.setDocumentMode(True)
        top = QWidget()
        self.below = below = split()
        """How a result was made; away while there is none."""
        self.below.hide()
        right = split(top, below, sizes=[520, 170], down=True, stretch=1)
        right.setStretchFactor(0, 3)
        fill(self.body, split(self.tabs, right, sizes=[380, 840], stretch=1))
        yield
        self.results = ResultsList(self.jobs, session.runs_folder)
        self.results.chosen.connect(self.open)
        self.results.failed.connect(lambda why: self.refused(None, why))
        self.tabs.addTab(self.results, "Results")
        yield
        tip = "Write all values (.tif, .npy, .ome.zarr), or what is shown (.png)"
        self.export_button = button("Export…", tip, lambda: self.export.choose())
        self.export_button.hide()
        tip = "The PSF is turned or of another size for this photograph: fit it first, then reconstruct again"
        self.refine_button = button("Fit the PSF, and again", tip, self.refine)
        self.refine_button.hide()
        tip = "Save the calibration with its PSF as it fits this photograph; form and live view use it"
        self.keep_button = button("Keep the fitted PSF", tip, self.keep_fitted)
        self.keep_button.hide()
        self.form = ReconstructForm()
        self.tabs.addTab(self.form, "Reconstruct")
        yield
        yield from self.form.parts()
        self.form.asked.connect(self.reconstruct)
        self.form.questioned.connect(self.explain)
        self.form.stopped.connect(self._stop)
        self.form.refused.connect(self.refused)
        yield
        self.heading = label(selectable=True)
        self.place = label(role="dim")
        self.place.setAlignment(Qt.AlignmentFlag.AlignRight)
        self.place.setMinimumWidth(10)
        self.empty = Hint(_NOTHING_OPEN, "Reconstruct…", lambda: self.tabs.setCurrentWidget(self.form))
        self.tabs.currentChanged.connect(lambda _: self._say_what_is_next())
        self.viewers.addWidget(self.empty)
        ends = (self.refine_button, self.keep_button, self.export_button)
        self.caption = label(role="dim", selectable=True, wraps=True, yields=True)
        self.caption.hide()
        shown = in_row(self.heading, (self.place, 1), *ends)
        fill(top, shown, self.caption, (self.viewers, 1), margins=(6, 0, 0, 0))
        yield
        self.picture = PictureView(session)
        self.viewers.addWidget(self.picture)
        yield
        self.volume = VolumeView(self.jobs)
        yield from self.volume.parts()
        yield
        self.viewers.addWidget(self.volume)
        self.volume.failed.connect(lambda why: self.refused(None, why))
        for hovered in (self.picture.hovered, self.volume.hovered):
            hovered.connect(self.place.setText)
        yield
        self.facts = FactsView()
        below.addWidget(self.facts)
        yield
        self.convergence = ConvergenceView()
        below.addWidget(self.convergence)
        below.setSizes([330, 330])
        yield
        session.run_finished.connect(lambda _: self.results.refresh())
        session.kept_changed.connect(self._say_what_is_shown)
        folder = self.session.runs_folder / "reconstructions"
        self._names = SuggestedName(self.jobs, self.form.options, folder, ".tif")
        self._suggest_out()
        self._depths = NewestOnly(self.jobs, "Reading a calibration's depths")
        self._newest = NewestOnly(self.jobs, "Looking for the newest calibration")
        self.form.options.settled.connect(self._settled)
        self.results.refresh()

    @property
    def options_form(self) -> OptionsForm:
        """The form whose fields messages are about."""
        return self.form.options

    def wholes(self) -> list[QWidget]:
        """Return the form's halves: it has half of the panel's widgets."""
        return self.form.options.wholes()

    # Results -------------------------------------------------------------------------------------
    def open(self, path: Path) -> Job:
        """Open a result, in a job; it is shown when it is there, or the last line says why not."""
        job = self.follow(self.jobs.compute(f"Opening {path.name}", lambda _: open_result(path)))
        self._opening = job
        job.succeeded.connect(lambda result: self._opened(job, result))
        return job

    def _opened(self, job: Job, result: StoredResult) -> None:
        if job is not self._opening:
            result.close()  # another was asked for since
            return
        self.show_result(result)

    def show_result(self, result: StoredResult) -> None:
        """Show a result; the one before is closed."""
        self.accepted()
        self._close_result()
        self.result = result
        self.heading.setText(f"<b>{escape(result.path.name)}</b>")
        self.heading.setToolTip(str(result.path))
        self._say_what_is_shown()
        self._show_facts()
        self.convergence.show_histories(result.histories, result.noise_norm)
        self.export_button.show()
        misfit = any(_REFINABLE in warning for warning in result.warnings)
        tried = self.form.options.value("refine_psf")
        self.refine_button.setVisible(misfit and result.path == self._made and not tried)
        self.keep_button.setVisible(result.fitted_from is not None)
        if result.volume is not None:
            self.viewers.setCurrentWidget(self.volume)
            self.volume.open(result.volume, result.grid)
        else:
            assert result.image is not None
            self.viewers.setCurrentWidget(self.picture)
            beside = {"Deviation": result.deviation, "Residual": result.residual}
            self.picture.show_picture(result.image, pitch_um=result.pitch_um, beside=beside)

    def _show_facts(self, explained: Sequence[tuple[str, str]] = ()) -> None:
        """Show what is known of the result that is shown; above it what is said of the form, if anything."""
        result = self.result
        if result is None:
            self._tell(explained)
            return
        facts = list(result.facts())
        if explained:
            facts = [("The form", _AS_IT_STANDS), *explained, ("The picture", result.path.name), *facts]
        self._tell(facts, result.warnings, simulated=result.simulated)

    def _tell(
        self, facts: Iterable[tuple[str, str]], warnings: Iterable[str] = (), *, simulated: bool = False
    ) -> None:
        """Show facts and warnings, which name options of the terminal, as the form has those."""
        said = [(name, self.in_its_words(value)) for name, value in facts]
        self.below.setVisible(bool(said) or self.result is not None)
        self.facts.show_facts(said, [self.in_its_words(text) for text in warnings], simulated=simulated)

    def _say_what_is_shown(self) -> None:
        """Say over a result when its photograph was taken and in which light, and how it is turned."""
        result, words = self.result, []
        if result is not None:
            turned = self.picture.orientation.words if result.image is not None else ""
            words = list(filter(None, (result.taken, "SIMULATED" if result.simulated else "", turned)))
        self.caption.setText(", ".join(words))
        self.caption.setVisible(bool(words))

    def _close_result(self) -> None:
        self.volume.release()
        self.result = None
        self._say_what_is_shown()
        self.refine_button.hide()
        self.keep_button.hide()
        self.export_button.hide()

    # Export --------------------------------------------------------------------------------------
    def _shown(self) -> dict[str, npt.NDArray[np.uint8]]:
        """Return the views in their colours, 8 bit."""
        view = self.picture if self.viewers.currentWidget() is self.picture else self.volume
        low, high = view.levels.levels
        colours = view.levels.colour_map
        if isinstance(view, PictureView):
            return {} if view.shown is None else {"picture": as_shown(view.shown, low, high, colours)}
        return {
            name: as_shown(image, *((0.0, 1.0) if name == "depth" else (low, high)), colours)
            for name, image in view.images.items()
        }

    # Reconstructing ------------------------------------------------------------------------------
    def _suggest_out(self) -> None:
        self._names.suggest(Path(self.form.text("image")).stem or "reconstruction")

    def _settled(self, name: str) -> None:
        """Follow what was named in the form: the result's name, the depths to choose from."""
        if name != "out":
            self.refine_button.hide()  # the form is another by now, and remains so
            self._made = None
        if name in ("image", "kind"):
            self._suggest_out()
        if name in ("calibration", "kind"):
            self._look_at_depths()

    def reconstruct(self) -> Job | None:
        """Do what the form asks for; the picture so far is shown as it comes."""
        work = self.asked(self.form.work)
        if work is None:
            return None
        request = work.request
        volume = isinstance(request, VolumeRequest)

        def do(context: JobContext) -> Written:
            self._names.make_room(work.outputs.image)
            return reconstruct_job(work, context)

        self.job = job = self.jobs.compute(f"Reconstructing {request.file.name}", do)
        self._begun(job, "Reading …")
        self._close_result()
        self._show_nothing(f"{request.file.name} is being read …", busy=True)
        self._opening, self._first_picture = None, True
        self.heading.setText(f"<b>{request.file.name}</b>: in the making")
        job.progressed.connect(lambda so_far: self._progressed(so_far, volume=volume))
        job.succeeded.connect(self._reconstructed)
        for ended, words in ((job.failed, "failed"), (job.cancelled, "stopped")):
            ended.connect(lambda _, words=words: self._not_reconstructed(request.file.name, words))
        return job

    def refine(self) -> Job | None:
        """Reconstruct again with the PSF fitted to the photograph first, as the form then says."""
        self.form.options.set_values({"refine_psf": True})
        self.tabs.setCurrentWidget(self.form)
        return self.reconstruct()

    def keep_fitted(self) -> None:
        """Save the calibration as it was fitted to the photograph; the form and the live view take it."""
        result = self.result
        if result is None:
            return
        runs = self.session.runs_folder
        job = self.follow(self.jobs.compute("Saving the fitted PSF", lambda _: result.keep_fitted(runs)))
        self.keep_button.setEnabled(False)  # once is enough
        job.ended.connect(lambda: self.keep_button.setEnabled(True))
        job.succeeded.connect(lambda folder: self._kept(result, folder))

    def _kept(self, result: StoredResult, folder: Path) -> None:
        if self.result is result:  # else the button is that of another's
            self.keep_button.hide()
        self.session.log("info", f"The PSF as it was fitted to the photograph: {folder}")
        self.form.options.set_values({"calibration": folder, "refine_psf": False})
        self.session.handed_on.emit("live_reconstruction", folder)

    def _show_nothing(self, words: str, *, busy: bool = False) -> None:
        """Take what was shown of another result away."""
        self.empty.say(words, busy=busy)
        self.viewers.setCurrentWidget(self.empty)
        self.place.clear()
        self.below.hide()
        self.facts.show_facts([])
        self.convergence.show_histories((), None)

    def _say_what_is_next(self) -> None:
        """Say where nothing is open what to do; the button leads to the form, unless that is in front."""
        if self.empty.words.text() in (_NOTHING_OPEN, _FORM_OPEN):
            has_form = self.tabs.currentWidget() is self.form
            self.empty.say(_FORM_OPEN if has_form else _NOTHING_OPEN, busy=has_form)

    def _not_reconstructed(self, name: str, words: str) -> None:
        """Say over what there is that it did not become a result."""
        if self.result is None and self._opening is None:
            self.heading.setText(f"<b>{name}</b>: {words}, nothing was written")
            if self.viewers.currentWidget() is self.empty:
                self._show_nothing(f"{name}: {words}. The form says why.")

    def explain(self) -> Job | None:
        """Say what would be chosen for the form, why, and what time and memory it takes."""
        request = self.asked(self.form.request)
        if request is None:
            return None
        job = self.jobs.compute(f"Explaining {request.file.name}", partial(explain_job, request))
        self._explaining = job
        self._begun(job, "Looking at PSFs and photograph …", keeps=False)
        job.progressed.connect(self._explaining_so_far)
        job.succeeded.connect(self._explained)
        for unended in (job.failed, job.cancelled):
            unended.connect(lambda _: self._show_facts())  # Stop keeps nothing
        job.cancelled.connect(lambda _: self.form.show_progress(0.0, "Stopped."))
        job.ended.connect(lambda: setattr(self, "_explaining", None))
        return job

    def _begun(self, job: Job, words: str, *, keeps: bool = True) -> None:
        """Show in the form that a job of it runs, and how it ends."""
        self.follow(job)
        self.form.set_running(True, keeps=keeps)
        self.form.show_progress(0.0, words)
        job.failed.connect(lambda why: self.form.show_progress(0.0, self.in_its_words(why).splitlines()[0]))
        job.ended.connect(lambda: self.form.set_running(False))

    def _explaining_so_far(self, so_far: SoFar | Explained) -> None:
        if isinstance(so_far, SoFar):
            self.form.show_progress(so_far.share, so_far.note)
        else:
            self._explained(so_far)

    def _explained(self, explained: Explained) -> None:
        facts = [] if explained.takes is None else [("Will take", str(explained.takes))]
        for decision in explained.decisions:
            facts.append((decision.name.capitalize(), f"{decision.value}: {decision.why}"))
            steps = (("up", decision.up), ("down", decision.down))
            facts += [("", f"one step {way}: {option}") for way, option in steps if option is not None]
        self._show_facts(facts)
        why = "; what was chosen, and why, is below the picture" if explained.decisions else ""
        takes = "Trying what it takes …" if explained.takes is None else f"Will take {explained.takes}"
        self.form.show_progress(0.0, f"{takes}{why}.")

    def _stop(self) -> None:
        if self._explaining is not None:
            self._explaining.cancel()
            self.form.note.setText("Stopping …")
        elif self.job is not None:
            self.job.cancel()
            self.form.note.setText("Stopping after this iteration …")

    def _progressed(self, so_far: SoFar, *, volume: bool) -> None:
        self.form.show_progress(so_far.share, so_far.note)
        if self.result is not None or self._opening is not None:
            return  # another result is looked at meanwhile
        prepared = so_far.prepared
        if so_far.image is None:
            self._tell(prepared.notes.items(), prepared.warnings, simulated=prepared.simulated)
            if self.viewers.currentWidget() is self.empty:
                self.empty.say(_COMES, busy=True)
            return
        keep = not self._first_picture
        # The first ones may be empty yet: no levels for those that follow.
        self._first_picture = self._first_picture and not np.any(so_far.image > 0)
        if volume:
            self.viewers.setCurrentWidget(self.volume)
            self.volume.show_front(so_far.image, keep_levels=keep)
        else:
            self.viewers.setCurrentWidget(self.picture)
            self.picture.show_picture(so_far.image, keep_levels=keep)
        self.convergence.show_histories((so_far.history,), None)

    def _reconstructed(self, written: Written) -> None:
        path = self._made = written.path
        self.form.show_progress(1.0, f"Wrote {path.name}")
        for name, text in written.checkpoint.items():
            self.session.log("info", f"{name} {text}")
        self.session.log("info", f"Reconstructed: {path}")
        self._suggest_out()
        self.open(path)
        self.results.refresh()

    # The panel -----------------------------------------------------------------------------------
    def take(self, what: Path | OwnFiles) -> None:
        """Put a calibration's folder, a photograph, or one with its PSF into the form; open a result."""
        if isinstance(what, OwnFiles):
            self._take_own(what)
            return
        path = what
        self.tabs.setCurrentWidget(self.form)
        form = self.form
        if path.is_dir() and form.kind == PSF:
            form.options.set_values({"kind": CALIBRATION})
        form.options.set_values({form.source if path.is_dir() else "image": path})
        form.start.setFocus()  # Return does what one came for
        if not path.is_dir() and not form.text(form.source) and form.kind != PSF:
            folder = self.session.runs_folder
            self._newest.ask(lambda: newest_calibration(folder), self._offer_calibration)

    def _take_own(self, files: OwnFiles) -> None:
        if files.result is not None:
            self.open(files.result)
            return
        self.tabs.setCurrentWidget(self.form)
        self.form.options.set_values({"kind": PSF})
        self.form.options.set_values({"psf": files.psf, "image": files.photograph})
        self.form.start.setFocus()
        start = self.form.start.click  # that is what was asked for; the form says why it cannot be
        if not self._names.once_known(start):
            start()

    def _offer_calibration(self, newest: Path | None) -> None:
        """Begin with the newest calibration where none was named."""
        if newest is not None and not self.form.text(self.form.source):
            self.form.options.set_values({self.form.source: newest})
            name = calibration_name(newest)
            self.form.note.setText(f"Calibration: {name}, the newest of this bench, for none was chosen.")

    def _look_at_depths(self) -> None:
        path = Path(self.form.text("calibration")).expanduser()
        if self.form.kind == CALIBRATION and path.name:
            self._depths.ask(lambda: _depths_of(path), self.form.show_depths)
        else:
            self._depths.forget()
            self.form.show_depths(())

    def as_python(self) -> str:
        """Return lines that make the reconstruction of the form, or open the result that is shown."""
        if self.tabs.currentWidget() is self.form:
            try:
                return self.form.as_python()
            except BenchError as error:
                return f"# The form is not complete: {' '.join(str(error).split())}\n"
        path = self.result.path if self.result is not None else Path("RESULT.tif")
        imports = Imports({("instrument.reconstruction.stored_result", "open_result")})
        opened = f"result = open_result({expression(path, imports)})"
        return "\n".join([*imports.lines(), "", opened, "print(result.facts(), result.warnings)", ""])

    def shutdown(self) -> None:
        """Close the volume that is shown and end the work."""
        super().shutdown()
        if self.job is not None:
            self.job.cancel()
        self._depths.forget()
        self._newest.forget()
        self._close_result()


def _depths_of(path: Path) -> tuple[float, ...]:
    """Return the depths of a calibration; none where there is no calibration, which the request says."""
    try:
        return calibrated_depths_um(find_calibration(path))
    except FileError:
        return ()
