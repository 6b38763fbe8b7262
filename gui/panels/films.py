"""Films: a recording or a reconstructed video, played and looked through, curves of regions, exports."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QSignalBlocker, Qt
from PySide6.QtWidgets import QSlider, QStackedWidget, QWidget

from gui.background import NewestOnly
from gui.jobs import Job, JobContext
from gui.panel import Panel
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.building import (
    Hint,
    after_rest,
    button,
    choice,
    every,
    fill,
    in_row,
    label,
    share_bar,
    split,
)
from gui.widgets.dialogues import choose_path
from gui.widgets.image_view import ImageView
from gui.widgets.measure import Measure
from gui.widgets.orientation import orientation_of
from gui.widgets.plots import LevelsBar, curve_colour, curve_pen, plot_widget
from instrument.reconstruction.film import Film, curves, relative, slowed, write_film
from recon.arrays import Array, Float64Array
from recon.base.as_python import Imports, expression

_FASTEST_MS = 20
_REST_MS = 250
"""After a region was dragged, before its curve is read."""
_FILTERS = "Films and curves (*.mp4 *.gif *.ome.zarr *.ome.tif *.csv)"
_NO_REGION = "Regions, dragged over the picture, get a curve each"
_EMPTY = "Open a recording of this bench, or a video that was reconstructed from one."


class FilmsPanel(Panel):
    """One film: its pictures, played or pulled by a slider, and curves of regions that are dragged."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.film: Film | None = None
        self.courses: Float64Array = np.empty((0, 0))
        """Means of the regions, (n_regions, n_pictures), as far as they were read."""
        self._place = 0
        self._step = 1
        """Pictures from one that is shown to the next."""
        self._curves_job: Job | None = None
        self._going: list[Job] = []
        """What reads curves or exports."""
        self._opening: Job | None = None

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        self._reader = NewestOnly(self.jobs, "Reading a picture", lambda why: self.refused(None, why))
        tip = "A recording's folder, or the .ome.zarr folder of a reconstructed video or of dF/F"
        self.open_button = button("Open…", tip, self._choose)
        self.export_button = button(
            "Export…", "As .mp4, .gif, .ome.zarr, or the regions' curves as .csv", self._choose_export
        )
        tip = "Fill in the form that reconstructs this recording as a video"
        self.reconstruct_button = button("Reconstruct…", tip, lambda: self._hand_on("video", "run"))
        tip = "Fill in the form that looks for what is active: dF/F, regions, traces"
        self.activity_button = button("Find activity…", tip, lambda: self._hand_on("activity", "video"))
        self.heading = label(selectable=True, yields=True)
        yield
        self.view = ImageView(name="Picture of the film")
        self.measure = Measure(self.view, several=True)
        self.session.kept_changed.connect(self._turn)
        self._rest = after_rest(self, _REST_MS, self._read_curves)
        self.measure.chosen.connect(lambda _: self._rest.start())
        yield
        self.levels = LevelsBar()
        self.levels.changed.connect(self._show_levels)
        self._timer = every(self, 40, self._next)
        self._timer.stop()
        self.play_button = button(
            "Play", "Play, or hold (Ctrl+Space)", self._play, checkable=True, shortcut="Ctrl+Space"
        )
        self.speed = choice(("0.25 ×", "0.5 ×", "1 ×", "2 ×", "4 ×"), "Speed", lambda _: self._play())
        self.speed.setCurrentIndex(2)
        self.slider = QSlider(Qt.Orientation.Horizontal)
        self.slider.setToolTip("Picture of the film (arrow keys, Page up and down)")
        self.slider.setAccessibleName("Picture of the film")
        self.slider.valueChanged.connect(self.go_to)
        self.words = label(role="dim")
        yield
        tip = "Drag regions over the picture: each gets a curve; pressed again, dragging moves the picture"
        self.region_button = button("Regions", tip, self._set_regions, checkable=True)
        self.clear_button = button("Clear", "Take all regions away", self._clear_regions)
        self.quantity = choice(("Mean", "dF/F (against the curve's 20th percentile)"), "What curves show")
        self.quantity.currentIndexChanged.connect(lambda _: self._draw_curves())
        self.progress = share_bar()
        self.progress.hide()
        self.plot: Any = plot_widget("time (s)", "mean")
        self._now: Any = pg.InfiniteLine(pen=colours().dim, movable=False)
        self.plot.addItem(self._now)
        yield
        top = in_row(
            (self.heading, 1),
            self.open_button,
            self.reconstruct_button,
            self.activity_button,
            self.export_button,
        )
        playing = in_row(self.play_button, self.speed, (self.slider, 1), self.words)
        shown = fill(QWidget(), (self.view, 1), playing, self.levels)
        about = in_row(self.region_button, self.clear_button, self.quantity, (self.progress, 1), None)
        below = fill(QWidget(), about, (self.plot, 1))
        self.tools = fill(QWidget(), top)
        self.stack = QStackedWidget()
        self.stack.addWidget(Hint(_EMPTY, "Open…", self._choose))
        self.stack.addWidget(split(shown, below, sizes=[520, 220], down=True, firm=True))
        fill(self.body, self.tools, (self.stack, 1))
        self._set_usable()

    # The film ------------------------------------------------------------------------------------
    def take(self, what: Any) -> None:
        """Open a recording or a video that another panel hands on."""
        self.open(Path(what))

    def open(self, path: Path) -> Job:
        """Open a film, in a job; it is shown when it is there, or the last line says why not."""

        def work(_: JobContext) -> tuple[Film, tuple[float, float], Array]:
            film = Film(path)
            return film, film.levels(), film.read(0)

        self._opening = job = self.follow(self.jobs.compute(f"Opening {path.name}", work))
        job.succeeded.connect(lambda opened: self._opened(job, *opened))
        return job

    def _opened(self, job: Job, film: Film, levels: tuple[float, float], first: Array) -> None:
        if job is not self._opening:
            return  # another was asked for since
        self.accepted()
        self._reader.forget()
        self._clear_regions()
        self.play_button.setChecked(False)
        self._play()
        self.film = film
        kind = "Recording" if film.is_recording else "Video"
        simulated = "   SIMULATED" if film.simulated else ""
        rate = f"{film.fps:.3g} a second" if film.period_s else "rate not known"
        self.heading.setText(f"{kind} {film.path.name}: {len(film)} pictures, {rate}{simulated}")
        self.heading.setToolTip(str(film.path))
        self.levels.set_image(first, keep_levels=True)
        self.levels.set_levels(*levels)
        self.stack.setCurrentIndex(1)
        with QSignalBlocker(self.slider):
            self.slider.setRange(0, len(film) - 1)
            self.slider.setPageStep(max(len(film) // 20, 1))
            self.slider.setValue(0)
        self.plot.setLabel("bottom", "time (s)" if film.period_s else "frame")
        self.plot.setXRange(film.times_s[0], film.times_s[-1], padding=0.01)
        self._set_usable()
        self._place = 0
        self._turn()
        self._show((0, first))

    def _turn(self) -> None:
        """Turn the pictures as all of their kind are turned."""
        if self.film is not None:
            self.view.orient(orientation_of(self.session, self.film.kind))

    def go_to(self, place: int) -> None:
        """Show a picture."""
        film = self.film
        if film is None or place == self._place:
            return
        self._place = place
        with QSignalBlocker(self.slider):
            self.slider.setValue(place)
        self._reader.ask(lambda: (place, film.read(place)), self._show)

    def _show(self, read: tuple[int, Array]) -> None:
        place, picture = read
        if self.film is None:
            return
        self.view.set_colour_map(self.levels.colour_map)
        self.view.show_image(picture, *self.levels.levels)
        at = self.film.times_s[place]
        when = f"{at:.3f} s, " if self.film.period_s else ""
        self.words.setText(f"{when}picture {place + 1} of {len(self.film)}")
        self._now.setValue(at)

    def _show_levels(self) -> None:
        if self.view.image is not None:
            self.view.set_colour_map(self.levels.colour_map)
            self.view.show_image(self.view.image, *self.levels.levels)

    def _play(self) -> None:
        """Play or hold, as the button says."""
        playing = self.play_button.isChecked() and self.film is not None
        self.play_button.setText("Hold" if playing else "Play")
        if self.film is not None and playing:
            speed = float(self.speed.currentText().split()[0])
            period_ms = 1000 / self.film.fps / speed
            self._step = max(math.ceil(_FASTEST_MS / period_ms), 1)
            self._timer.start(round(self._step * period_ms))
        else:
            self._timer.stop()

    def _next(self) -> None:
        """Go on, round at the end; a picture that is still read holds the film up."""
        if self.film is not None and self.isVisible() and not self._reader.is_reading:
            self.go_to((self._place + self._step) % len(self.film))

    # Regions -------------------------------------------------------------------------------------
    def _set_regions(self, on: bool) -> None:
        if on:
            self.measure.set_on(True)
        else:
            self.view.drag_taker = None  # the regions stay

    def _clear_regions(self) -> None:
        if self._curves_job is not None:
            self._curves_job.cancel()
            self._curves_job = None
        self.measure.clear()
        self.courses = np.empty((0, 0))
        self._draw_curves()

    def _read_curves(self) -> None:
        """Read the curves of all regions, in a job; a newer wish ends the one before."""
        film, regions = self.film, [(r.rows, r.columns) for r in self.measure.regions]
        if film is None or not regions:
            return
        if self._curves_job is not None:
            self._curves_job.cancel()
        self._colour_regions()

        def work(context: JobContext) -> Float64Array:
            return curves(film, regions, lambda done, total: context.report(done / total))

        self._curves_job = job = self.follow(self.jobs.compute("Reading the curves of regions", work))
        self._show_progress(job)
        job.succeeded.connect(lambda courses: self._take_curves(job, courses))

    def _show_progress(self, job: Job) -> None:
        """Show how far the newest job is, until none goes on."""

        def told(share: float) -> None:
            if job is self._going[-1]:
                self.progress.setValue(round(1000 * share))

        def ended() -> None:
            self._going.remove(job)
            self.progress.setVisible(bool(self._going))

        self._going.append(job)
        self.progress.show()
        job.progressed.connect(told)
        job.ended.connect(ended)

    def _colour_regions(self) -> None:
        """Draw each region in its curve's colour."""
        self.measure.set_colours([curve_colour(number) for number in range(len(self.measure.regions))])

    def _take_curves(self, job: Job, courses: Float64Array) -> None:
        if job is self._curves_job:
            self.courses = courses
            self._draw_curves()

    def _draw_curves(self) -> None:
        for item in self.plot.listDataItems():
            self.plot.removeItem(item)
        none = self.film is None or not self.courses.size
        for side in ("left", "bottom"):  # an empty plot's numbers would mean nothing
            self.plot.getAxis(side).setStyle(showValues=not none)
        self.plot.setTitle(_NO_REGION if none else None, color=colours().dim, size="9pt")
        if self.film is None or none:
            return
        changes = self.quantity.currentIndex() == 1
        self.plot.setLabel("left", "dF/F" if changes else "mean")
        shown = relative(self.courses) if changes else self.courses
        for number, course in enumerate(shown):
            self.plot.plot(self.film.times_s, course, pen=curve_pen(number))

    # To others -----------------------------------------------------------------------------------
    def _choose(self) -> None:
        choose_path(self, "folder", "Open a recording or a video", str(self.session.runs_folder), self.open)

    def _choose_export(self) -> None:
        if self.film is not None:
            start = str(self.film.path.parent / f"{self.film.path.name.partition('.')[0]}-film.mp4")
            choose_path(self.view, "save", "Export", start, self.export_to, _FILTERS)

    def export_to(self, target: Path) -> Job | None:
        """Write the film, or the regions' curves, as the name asks for; what is there stays."""
        film = self.film
        if film is None:
            return None
        levels, regions = self.levels.levels, [(r.rows, r.columns) for r in self.measure.regions]
        orientation = orientation_of(self.session, film.kind)

        def write(context: JobContext) -> Path:
            def advance(done: int, total: int) -> None:
                context.report(done / total)

            return write_film(
                film, target, levels=levels, regions=regions, orientation=orientation, advance=advance
            )

        job = self.follow(self.jobs.compute(f"Exporting {target.name}", write))
        self._show_progress(job)
        job.succeeded.connect(lambda path: self.session.log("info", f"Wrote {path}"))
        if words := slowed(target, film.fps):
            job.succeeded.connect(lambda _: self.session.log("warning", words))
        return job

    def _hand_on(self, task: str, option: str) -> None:
        if self.film is not None:
            self.session.handed_on.emit("tasks", (task, {option: self.film.path}))

    def _set_usable(self) -> None:
        self.tools.setVisible(self.film is not None)  # until then there is one button: the hint's
        for each in (self.export_button, self.play_button, self.region_button, self.clear_button):
            each.setEnabled(self.film is not None)
        self.slider.setEnabled(self.film is not None)
        self.activity_button.setEnabled(self.film is not None)
        self.reconstruct_button.setEnabled(self.film is not None and self.film.is_recording)

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        self._now.setPen(colours().dim)
        self._colour_regions()
        self._draw_curves()

    def as_python(self) -> str:
        """Return lines that read the film and the curves of its regions."""
        path = Path("FILM.ome.zarr") if self.film is None else self.film.path
        imports = Imports({("instrument.reconstruction.film", name) for name in ("Film", "curves")})
        regions = ", ".join(f"({r.rows!r}, {r.columns!r})" for r in self.measure.regions)
        lines = [f"film = Film({expression(path, imports)})", f"courses = curves(film, [{regions}])"]
        return "\n".join([*imports.lines(), "", *lines, "print(film.times_s, courses)", ""])

    def shutdown(self) -> None:
        """End what is being read."""
        super().shutdown()
        self._reader.forget()
        if self._curves_job is not None:
            self._curves_job.cancel()
