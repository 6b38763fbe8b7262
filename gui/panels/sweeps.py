"""Calibration routines and plans: form, planned path, progress, last frame, quality per PSF."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from PySide6.QtGui import QImage, QPixmap
from PySide6.QtWidgets import QWidget

from calibration_routines.optics.beads import BeadCalibration
from calibration_routines.optics.photograph import Photograph
from calibration_routines.optics.screen_solve import ScreenCalibration
from calibration_routines.plan_procedures import IlluminationProcedure, PlanProcedure
from calibration_routines.procedure import Outcome, Outlook
from calibration_routines.psf.sweep import SweepCalibration
from calibration_routines.psf.sweep_watch import PointTaken
from calibration_routines.routine import Routine, routines
from gui.background import NewestOnly
from gui.procedure_panel import ProcedurePanel
from gui.procedure_run import Situation
from gui.session import BenchSession
from gui.widgets.building import fill, hint, label, split, tabs
from gui.widgets.dialogues import elided
from gui.widgets.image_view import ImageView, usual_levels
from gui.widgets.orientation import follow_orientation
from gui.widgets.picture import Picture
from gui.widgets.sweep_views import PathPlot, PsfPictures, PsfTable
from instrument.bench.photograph import Snapshot
from instrument.files.errors import BenchError, FileError, SettingsError, count
from instrument.live.frame_view import not_stretched
from instrument.plan import Plan
from instrument.plan.illumination import IlluminationOptions
from instrument.plan.model import load_plan, plan_toml
from recon.arrays import Array
from recon.base.declare import option


@dataclass(frozen=True, kw_only=True)
class _PlanOptions:
    file: Path | None = option(
        None,
        help="A plan to read (.toml); relative paths are seen from its folder.",
        default_words="none: what stands below",
    )
    text: str = option(
        (files("instrument.plan") / "example.toml").read_text(),
        label="Plan",
        help="A plan in TOML; the example shows all that can be said.",
        default_words="the example",
    )


def _plan(options: _PlanOptions) -> PlanProcedure:
    try:
        data = tomllib.loads(options.text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError([("text", str(error))]) from None
    base = options.file.parent if options.file else Path()
    return PlanProcedure(Plan.checked(data, "plan").with_slm_images(lambda image: base / image))


PLAN = Routine(
    name="plan",
    title="Plan",
    help="Any acquisition, as a plan in TOML: positions, light, SLM images, exposures",
    options=_PlanOptions,
    procedure=_plan,
)


ILLUMINATION = Routine(
    name="illumination",
    title="Patterned light",
    help="Photograph the scene lit by one group of LEDs after the other. Once more with a plain white sheet "
    "in its place; then “Reconstruct patterned light” in Files makes one picture of both runs",
    options=IlluminationOptions,
    procedure=IlluminationProcedure,
    needs=("led_array",),
)


class SweepsPanel(ProcedurePanel):
    """Sweeps and plans."""

    @classmethod
    def prepare(cls) -> None:
        """Import the routines."""
        list(routines.values())

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        own = [routine for routine in routines.values() if routine.command == "calibrate"]
        super().__init__(session, [*own, ILLUMINATION, PLAN], "Start", parent)

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        self.path = PathPlot()
        yield
        yield from self.path.parts()
        self.frame = ImageView(name="Newest frame")
        follow_orientation(self.session, "frames", self.frame.orient)
        yield
        self.frame_words = label(role="dim", wraps=True, yields=True)
        self.no_frame = hint("No frame yet: the newest stands here.")
        self.psfs = PsfTable()
        self.picture = Picture()
        yield
        yield from super().parts()
        above, self.tabs = split(), tabs({})
        fill(self.right, split(above, self.tabs, sizes=[360, 400], down=True, firm=True))
        yield
        above.addWidget(self.path)
        yield
        shown = fill(QWidget(), (self.no_frame, 1), (self.frame, 1), self.frame_words, margins=(6, 0, 0, 0))
        self.frame.hide()
        above.addWidget(shown)
        above.setChildrenCollapsible(False)
        above.setSizes([560, 420])
        yield
        self.tabs.addTab(self.psfs, "Quality of PSFs")
        self.tabs.addTab(self.picture, "Result")
        yield
        self._shown: Snapshot | None = None
        self._pictures = PsfPictures()
        self.run.judged.connect(self._judged)
        self.psfs.chosen.connect(self._show_psf)
        self.views["plan"].settled.connect(lambda name: self._read_plan() if name == "file" else None)
        self._reader = NewestOnly(self.jobs, "Reading")
        self._plan_file: Path | None = None
        self.choice.currentIndexChanged.connect(lambda _: self.began())  # of another routine nothing stays

    def take(self, what: str | Plan) -> None:
        """Choose a routine, by its name, or put a plan into the form."""
        if isinstance(what, str):
            super().take(what)
            return
        super().take(PLAN.name)
        self.views[PLAN.name].set_values({"text": plan_toml(what)})

    def show_outlook(self, outlook: Outlook) -> None:
        """Draw the path besides the words."""
        super().show_outlook(outlook)
        self.path.show_path(outlook.path)
        self._tabs_for_routine()

    def _tabs_for_routine(self) -> None:
        """Have a place for PSFs only where some are judged."""
        self.tabs.setTabVisible(self.tabs.indexOf(self.psfs), self.routine.watch is not None)

    def show_problem(self, error: BenchError) -> None:
        """Take the path away besides saying why."""
        super().show_problem(error)
        self.path.clear("No path: this cannot be carried out as it stands.")

    def began(self) -> None:
        """Clear the last sweep."""
        self._shown = None
        self.frame.clear()
        self.frame.hide()
        self.no_frame.show()
        self.frame_words.clear()
        self.psfs.clear()
        self._reader.forget()  # the last one's picture
        self.picture.clear()
        self._pictures = PsfPictures()
        self._tabs_for_routine()
        if self.routine.watch is not None:
            self.tabs.setCurrentWidget(self.psfs)

    def looked(self, now: Situation) -> None:
        """Show the newest frame and where the run is."""
        self.path.show_now(now.place)
        if now.newest is not None and now.newest is not self._shown:
            self._shown = now.newest
            self._show_frame(now.newest)

    def way_from(self, outcome: Outcome) -> tuple[str, object] | None:
        """Return where a calibration or photograph is used, or the frames of patterned light."""
        if self.routine is ILLUMINATION and outcome.runs:
            return "tasks", ("patterned", {"run": outcome.runs[0]})
        return super().way_from(outcome)

    def finished(self, outcome: Outcome) -> None:
        """Show the last judgement, or the routine's picture."""
        if isinstance(outcome.result, SweepCalibration):
            self.psfs.show_all(outcome.result.quality)
            self._show_psf(0)  # rather than the last frame, which is dark
        elif isinstance(outcome.result, BeadCalibration | ScreenCalibration):
            psfs = outcome.result.calibration.psfs  # (n_psfs, n_channels, height, width)
            self._show_image(psfs[len(psfs) // 2].mean(axis=0))
            which = f"PSF {len(psfs) // 2 + 1} of {len(psfs)}" if len(psfs) > 1 else "The PSF"
            self.frame_words.setText(f"{which}, as it was solved for")
        if isinstance(outcome.result, Photograph):
            self._show_image(outcome.result.measurement)
            self.frame_words.setText("The photograph, dark frames taken off")
        pictures = [file for file in outcome.files if file.suffix == ".png"]
        if pictures:
            self._reader.ask(lambda: QImage(str(pictures[0])), self._show_result, "result")
        else:
            self.picture.clear("There is no other picture.")

    def _show_result(self, picture: QImage) -> None:
        self.picture.show_pixmap(QPixmap.fromImage(picture))
        self.tabs.setCurrentWidget(self.picture)

    def _judged(self, event: object) -> None:
        if isinstance(event, PointTaken):
            self._pictures.keep(event.number - 1, event.image)
            self.psfs.arrived(event)

    def _show_psf(self, row: int) -> None:
        quality = self.psfs.qualities[row] if 0 <= row < len(self.psfs.qualities) else None
        picture = self._pictures.get(row)
        if quality is None or picture is None:
            return
        self._show_image(picture.image)
        x_mm, y_mm, z_mm = (value / 1e3 for value in quality.source_um)
        self.frame_words.setText(
            f"PSF {row + 1} at ({x_mm:.4g}, {y_mm:.4g}, {z_mm:.4g}) mm, dark frame taken off"
            + (f"; reduced {picture.reduced}x, whole in the run" if picture.reduced > 1 else "")
        )

    def _show_frame(self, newest: Snapshot) -> None:
        metadata = newest.metadata
        full_scale = (1 << metadata.significant_bits) - 1
        self._show_image(newest.image, full_scale)
        words = [f"Last frame: {self.session.describe_frame(metadata)}"]
        if metadata.saturated_fraction:
            pixels = round(metadata.saturated_fraction * newest.image.size)
            words.append(f"SATURATED: {count(max(pixels, 1), 'pixel')}")
        elided(self.frame_words, ", ".join(words))

    def _show_image(self, image: Array, full_scale: int | None = None) -> None:
        levels = usual_levels(image)
        self.frame.show_image(
            image, *(levels if full_scale is None else not_stretched(levels, full_scale)), full_scale
        )
        self.no_frame.hide()
        self.frame.show()

    def _read_plan(self) -> None:
        """Show the plan of a file that was chosen."""
        values = self.views["plan"].values()
        file = None if values is None else values["file"]
        if file == self._plan_file:
            return
        self._plan_file = file
        if file is not None:
            self._reader.ask(lambda: _plan_text(file), self._show_plan, "plan")

    def _show_plan(self, text: str | BenchError) -> None:
        if isinstance(text, str):
            self.views["plan"].set_values({"text": text})
        else:
            self.views["plan"].refuse("file", str(text))


def _plan_text(file: Path) -> str | BenchError:
    """Return a plan as TOML; why it cannot be read."""
    try:
        return file.read_text() if file.suffix == ".toml" else plan_toml(load_plan(file))
    except BenchError as error:
        return error
    except (UnicodeDecodeError, OSError) as error:
        return FileError(file, str(error))
