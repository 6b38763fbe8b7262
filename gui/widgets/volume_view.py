"""A volume to browse: brightest along each axis, slices, from any side; regions of it measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QSignalBlocker, Qt, QTimer, Signal
from PySide6.QtWidgets import QGridLayout, QProgressBar, QStackedWidget, QWidget

from gui.background import NewestOnly
from gui.jobs import Job, JobContext, JobRunner
from gui.theme import colours, spares_hues
from gui.widgets.building import fill, in_row, label
from gui.widgets.image_view import StretchedImage, whole_steps
from gui.widgets.measure import LengthBar, Measure, Region, region_words
from gui.widgets.plots import LevelsBar, curve_pen, plot_widget
from gui.widgets.proportions import MOST_BYTES, bytes_in_proportion, in_proportion
from gui.widgets.turning_view import Planes, TurningView, in_colours, middle_pitch_um
from gui.widgets.volume_tools import Mode, PlaneSlider, VolumeTools
from instrument.reconstruction.result_figures import Projections, grey, project
from instrument.volumes.source import Plane, VolumeSource
from recon.camera.grid import Grid, metric_grid

Axis = Literal["z", "y", "x"]
_AXES: tuple[Axis, Axis, Axis] = ("z", "y", "x")


@dataclass(frozen=True, slots=True)
class Slice:
    """A slice that was read."""

    axis: Axis
    index: int
    pixels: Plane


class VolumeView(QWidget):
    """Four views of one volume, and what is under the mouse in words.

    Nothing is read in the window's thread: projections and slices are read in jobs. It is there once its
    ``parts`` are made.

    Parameters
    ----------
    jobs : JobRunner

    Signals
    -------
    failed : str
        The volume could not be read.
    hovered : str
        Place and value under the mouse.
    """

    failed = Signal(str)
    hovered = Signal(str)

    def __init__(self, jobs: JobRunner, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._jobs = jobs
        self._job: Job | None = None
        self._reader = NewestOnly(jobs, "Reading a slice", self.failed.emit)
        self._given: VolumeSource | None = None
        self._grid: Grid | None = None
        self._source: VolumeSource | None = None
        """What is shown: the given one, or that in true proportions."""
        self._planes: Planes | None = None
        self.projections: Projections | None = None
        self.slices: dict[Axis, Slice] = {}
        self._asked: dict[Axis, int] = {}
        self.point = (0, 0, 0)
        """Plane, row and column through which the slices go."""
        self.mode: Mode = "brightest"

    def parts(self) -> Iterator[None]:
        """Make the widgets, with a ``yield`` after each part."""
        self.front = StretchedImage(name="Volume from the front")
        self.bar = LengthBar(self.front)
        yield
        self.coloured = StretchedImage(name="Depth as colour")
        yield
        self.side = StretchedImage(keep_aspect=False, name="Volume from the side")
        yield
        self.top = StretchedImage(keep_aspect=False, name="Volume from above")
        yield
        self.profile = plot_widget("plane")
        self._along: Any = self.profile.plot(pen=curve_pen(0))
        self._here: Any = pg.InfiniteLine(pen=colours().dim)
        self.profile.addItem(self._here)
        self.profile.setToolTip("Values along depth through the chosen pixel, of the views' resolution")
        yield
        self._titles = [label(role="heading") for _ in range(4)]
        self._lines = {view: (_line(view, 90), _line(view, 0)) for view in (self.front, self.side, self.top)}
        self.front.clicked.connect(lambda column, row: self.go_to(self.point[0], row, column))
        self.side.clicked.connect(lambda column, row: self.go_to(column, row, self.point[2]))
        self.top.clicked.connect(lambda column, row: self.go_to(row, self.point[1], column))
        self._step_by_keys(self.front, lambda across, down: (0, down, across))
        self._step_by_keys(self.side, lambda across, down: (across, down, 0))
        self._step_by_keys(self.top, lambda across, down: (down, 0, across))
        for view in (self.front, self.side, self.top, self.coloured):
            view.setMinimumSize(70, 50)
            view.hovered.connect(self.hovered)
        self.profile.setMinimumSize(70, 50)
        yield
        self.tools = VolumeTools()
        self.tools.chosen.connect(self.set_mode)
        yield
        self.turning = TurningView(self._jobs)
        self.turning.failed.connect(self.failed)
        self.turning.opened.connect(self._measure_again)
        self.views, self.stack = QWidget(), QStackedWidget()
        self.measure = Measure(self.front)
        self.tools.measure.toggled.connect(self._measure_or_not)
        self.measure.chosen.connect(self._measured)
        self.tools.proportions.toggled.connect(self._look)
        self.measured = label(role="value", selectable=True, wraps=True)
        self.measured.hide()
        self.slider = PlaneSlider(self)
        self.slider.stepped.connect(self._step_plane)
        self.slider.valueChanged.connect(lambda z: self.go_to(z, *self.point[1:]))
        self.plane_label = label()
        self.progress = QProgressBar()
        self.progress.setFormat("reading plane %v of %m")
        self.progress.hide()
        yield
        self.levels = LevelsBar()
        self.levels.changed.connect(self._show)
        yield
        self._arrange()
        self.set_mode("brightest")

    def _arrange(self) -> None:
        grid = QGridLayout()
        grid.setSpacing(3)
        for number, (widget, title) in enumerate(
            zip((self.front, self.side, self.top, self.coloured), self._titles, strict=True)
        ):
            grid.addWidget(title, 2 * (number // 2), number % 2)
            grid.addWidget(widget, 2 * (number // 2) + 1, number % 2)
        grid.addWidget(self.profile, 3, 1)
        grid.setRowStretch(1, 3)
        grid.setRowStretch(3, 2)
        grid.setColumnStretch(0, 3)
        grid.setColumnStretch(1, 2)
        fill(self.views, (grid, 1), in_row((self.slider, 1), self.plane_label))
        self.stack.addWidget(self.views)
        self.stack.addWidget(self.turning)
        fill(self, self.tools, self.progress, (self.stack, 1), self.measured, self.levels)

    # What is shown -------------------------------------------------------------------------------
    def open(self, source: VolumeSource, grid: Grid | None = None) -> Job:
        """Browse a volume, which is this view's to close; the one before is closed.

        Parameters
        ----------
        source : VolumeSource
        grid : Grid, optional
            Where its voxels lie. One that is uneven is shown in true proportions.
        """
        self.release()
        if grid is not None and not (np.isfinite(grid.z_um).all() and np.isfinite(grid.pitch_um).all()):
            grid = None
        self._given, self._grid = source, grid
        size = None if grid is None else bytes_in_proportion(source, grid)
        self.tools.proportions.setEnabled(size is not None)
        with QSignalBlocker(self.tools.proportions):
            self.tools.proportions.setChecked(size is not None and size <= MOST_BYTES)
        job = self._look()
        assert job is not None
        return job

    def _look(self) -> Job | None:
        """Show the volume in true proportions, made in a job, or as it is."""
        given, grid = self._given, self._grid
        if given is None:
            return None
        self._show_no_more()
        if grid is None or not self.tools.proportions.isChecked():
            return self._browse(given, grid)
        job = self._begin(
            f"Bringing {given.path.name} to true proportions",
            metric_grid(grid).shape[0],
            lambda context: in_proportion(given, grid, lambda done: context.report(done)),
        )
        job.succeeded.connect(lambda made: self._browse(*made) if job is self._job else None)
        return job

    def _browse(self, source: VolumeSource, grid: Grid | None) -> Job:
        self._source, self._planes = source, None if grid is None else (grid.z_um, grid.pitch_um)
        n_z, height, width = source.shape
        self.slider.setRange(0, n_z - 1)
        ratio = grid.spacing_um[0] / grid.pitch_um[0] if grid is not None and grid.is_metric else None
        self.side.box.setAspectLocked(ratio is not None, ratio or 1)
        self.top.box.setAspectLocked(ratio is not None, 1 / (ratio or 1))

        def work(context: JobContext) -> Projections:
            return project(source, lambda done, _: context.report(done))

        job = self._begin(f"Looking through {source.path.name}", n_z, work)
        job.succeeded.connect(lambda projections: self._take_projections(job, projections))
        self.bar.place(width, None if self._planes is None else middle_pitch_um(self._planes))
        self.go_to(n_z // 2, height // 2, width // 2)
        if self.mode == "turning":
            self._load_renderer()
        return job

    def _begin(self, title: str, planes: int, work: Callable[[JobContext], Any]) -> Job:
        """Start a job that tells how many planes it has read."""
        self.progress.setRange(0, planes)
        self.progress.setValue(0)
        self.progress.show()
        self._job = job = self._jobs.compute(title, work)
        job.progressed.connect(self.progress.setValue)
        job.failed.connect(self.failed)
        job.ended.connect(lambda: self._reading_ended(job))
        return job

    def show_front(self, front: Plane, *, keep_levels: bool) -> None:
        """Show only a front view: that of a volume in the making."""
        self.release()
        self.levels.set_image(grey(front), keep_levels=keep_levels)
        self.front.set_colour_map(self.levels.colour_map)
        self.front.show_image(front, *self.levels.levels)
        for view in (self.side, self.top, self.coloured):
            view.clear()

    def release(self) -> None:
        """End reading and close the volume; nothing is shown then."""
        self._show_no_more()
        if self._given is not None:
            self._reader.forget(last=self._given.close)
        self._given = self._grid = None
        self.tools.proportions.setEnabled(False)

    def _show_no_more(self) -> None:
        if self._job is not None:
            self._job.cancel()
            self._job = None
        self._reader.forget()
        self.turning.release()
        self.measure.clear()
        self.measured.clear()
        self._source = self.projections = None
        self.slices, self._asked = {}, {}
        self.progress.hide()

    def set_mode(self, mode: Mode) -> None:
        """Show the brightest along each axis, slices through a point, or the volume from any side."""
        self.mode = mode
        self.tools.modes[mode].setChecked(True)
        slices, turning = mode == "slices", mode == "turning"
        self.stack.setCurrentWidget(self.turning if turning else self.views)
        self.tools.measure.setVisible(not turning)
        self.measured.setVisible(not turning and self.tools.measure.isChecked())
        if turning:
            self._load_renderer()
            self.turning.setFocus()
        for view in (self.front, self.side, self.top):
            view.arrows_pan = not slices
        self.slider.setVisible(slices)
        self.plane_label.setVisible(slices)
        self.profile.setVisible(slices)
        self.coloured.setVisible(mode == "brightest")
        for lines in self._lines.values():
            for line in lines:
                line.setVisible(slices)
        self._show()

    def go_to(self, plane: int, row: int, column: int) -> None:
        """Let the slices go through a voxel."""
        if self._source is None:
            return
        n_z, height, width = self._source.shape
        point = (min(max(plane, 0), n_z - 1), min(max(row, 0), height - 1), min(max(column, 0), width - 1))
        self.point = point
        with QSignalBlocker(self.slider):
            self.slider.setValue(point[0])
        self.plane_label.setText(f"plane {point[0] + 1} of {n_z}{self._depth_words(point[0])}")
        for axis, index in zip(_AXES, point, strict=True):
            if self._asked.get(axis) != index:
                self._asked[axis] = index
                self._ask_slice(self._source, axis, index)
        self._place_lines()
        if self.mode == "slices":
            self._show_profile()

    def _ask_slice(self, source: VolumeSource, axis: Axis, index: int) -> None:
        read = {"z": source.plane, "y": source.across_y, "x": source.across_x}[axis]
        self._reader.ask(lambda: Slice(axis, index, read(index)), self._take_slice, axis)

    def _step_by_keys(self, view: StretchedImage, step: Callable[[int, int], tuple[int, int, int]]) -> None:
        """Let the arrow keys in a view move the point by voxels; among projections they pan."""

        def moved(across: float, down: float) -> None:
            if self.mode == "slices":
                plane, row, column = step(whole_steps(across), whole_steps(down))
                self.go_to(self.point[0] + plane, self.point[1] + row, self.point[2] + column)

        view.keys.moved.connect(moved)

    @property
    def images(self) -> dict[str, Plane]:
        """What the views show, by name: for export."""
        if self.mode == "turning":
            shown = self.turning.pixels
            return {} if shown is None else {"depth": np.asarray(shown / np.float32(255), np.float32)}
        if self.mode == "slices":
            names: dict[Axis, str] = {"z": "slice", "y": "slice-xz", "x": "slice-yz"}
            return {names[axis]: held.pixels for axis, held in self.slices.items()}
        if self.projections is None:
            return {}
        p = self.projections
        depth = in_colours(p, self.levels.levels, red=spares_hues(self.levels.colour_map))
        return {"front": p.front, "top": p.top, "side": p.side, "depth": depth}

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        self._along.setPen(curve_pen(0))
        self._here.setPen(colours().dim)
        self.bar.restyle()
        self._show()

    # From any side, and measured -----------------------------------------------------------------
    def _load_renderer(self) -> None:
        """Read the volume for views from any side where that was not done yet."""
        if self._source is not None and not self.turning.is_open:
            self.turning.open(self._source, self._planes)

    def _measured(self, region: Region) -> None:
        """Say what is in a region of the front view, and draw its mean along depth."""
        shown = self._front_pixels()
        if shown is None or self._source is None:
            return
        self._load_renderer()
        pitch_um = None if self._planes is None else middle_pitch_um(self._planes)
        slices = self.mode == "slices"
        where = f"plane {self.slices['z'].index + 1}" if slices else "brightest over depth"
        words = f"{where}, {region_words(region, grey(shown), self._source.shape[1:], pitch_um)}"
        if (renderer := self.turning.renderer) is not None:
            along = renderer.along_depth(region.rows, region.columns)
            best = int(along.argmax())
            words += f"; most along depth at plane {best + 1}{self._depth_words(best)}"
            self._along.setData(np.arange(1, len(along) + 1), along.astype(float))
            if slices:
                self._titles[3].setText("mean of the region along depth")
        self.measured.setText(words)
        self.measured.setVisible(self.mode != "turning")

    def _measure_or_not(self, on: bool) -> None:
        self.measure.set_on(on)
        if not on:
            self.measured.clear()
            self.measured.hide()
            self._show()  # the profile is the point's again

    def _measure_again(self) -> None:
        """Measure the same region of what is in front now."""
        if self.measure.regions:
            self._measured(self.measure.regions[-1])

    def _front_pixels(self) -> Plane | None:
        if self.mode == "slices":
            held = self.slices.get("z")
            return None if held is None else held.pixels
        return None if self.projections is None else self.projections.front

    def _step_plane(self, by: int) -> None:
        if self.mode == "slices":
            self.go_to(self.point[0] + by, *self.point[1:])

    # Inside --------------------------------------------------------------------------------------
    def _take_projections(self, job: Job, projections: Projections) -> None:
        if job is self._job:
            self.projections = projections
            self.levels.set_image(projections.front)

    def _reading_ended(self, job: Job) -> None:
        if job is self._job:
            self.progress.hide()

    def _take_slice(self, held: Slice) -> None:
        self.slices[held.axis] = held
        if self.mode == "slices":
            self._show_slice(held, self.levels.levels)
            self._name_slices()
            if held.axis == "y":
                self._show_profile()
            self._measure_again()

    def _show(self) -> None:
        if self._source is None:
            return
        for view in (self.front, self.side, self.top, self.coloured):
            view.set_colour_map(self.levels.colour_map)
        if self.mode == "turning":
            self.turning.set_looks(self.levels.levels, self.levels.colour_map)
            if self.projections is not None:
                self.turning.show_front(self.projections)
        elif self.mode == "slices":
            self._show_slices()
        elif self.projections is not None:
            self._show_projections(self.projections)
        self._measure_again()

    def _show_projections(self, p: Projections) -> None:
        levels, colours_spared = self.levels.levels, spares_hues(self.levels.colour_map)
        self._draw(self.front, p.front, levels)
        others = ((self.top, p.top), (self.side, p.side.T))
        for view, image in others:  # each in a turn of its own; of quick wishes the last is drawn
            QTimer.singleShot(0, view, partial(self._draw_projection, p, view, image, levels))
        self._reader.ask(
            lambda: in_colours(p, levels, red=colours_spared),
            lambda shown: self._draw_projection(p, self.coloured, shown, levels),
            "colours",
        )
        first, last = (self._depth_words(z)[2:] or f"plane {z + 1}" for z in (0, len(p.top) - 1))
        hues = f"depth as colour: blue {first}, red {last}"
        self._name(
            "x–y, brightest over depth",
            "z–y, brightest over x",
            "x–z, brightest over y",
            "the red map does not show depth" if colours_spared else hues,
        )

    def _draw_projection(
        self, p: Projections, view: StretchedImage, image: Plane, levels: tuple[float, float]
    ) -> None:
        if p is self.projections and self.mode == "brightest" and levels == self.levels.levels:
            self._draw(view, np.ascontiguousarray(image), (0.0, 1.0) if view is self.coloured else levels)

    def _name(self, *titles: str) -> None:
        for shown, title in zip(self._titles, titles, strict=True):
            shown.setText(title)

    def _show_slices(self) -> None:
        for held in self.slices.values():
            self._show_slice(held, self.levels.levels)
        self._name_slices()
        self._show_profile()

    def _show_slice(self, held: Slice, levels: tuple[float, float]) -> None:
        if held.axis == "x":
            self._draw(self.side, np.ascontiguousarray(np.swapaxes(held.pixels, 0, 1)), levels)
        else:
            self._draw(self.front if held.axis == "z" else self.top, held.pixels, levels)

    def _name_slices(self) -> None:
        z, y, x = self.point
        self._name(
            f"x–y at plane {z + 1}", f"z–y at column {x}", f"x–z at row {y}", f"along depth at ({x}, {y})"
        )

    def _draw(self, view: StretchedImage, image: Plane, levels: tuple[float, float]) -> None:
        """Show an image over the volume's own voxels."""
        assert self._source is not None
        n_z, height, width = self._source.shape
        extents = {self.side: (n_z, height), self.top: (width, n_z)}
        view.show_image(image, *levels, extent=extents.get(view, (width, height)))

    def _show_profile(self) -> None:
        """Draw the values along depth through the point, from the slice at its row."""
        held = self.slices.get("y")
        if held is None or self._source is None:
            return
        z, _, x = self.point
        pixels = grey(held.pixels)
        column = min(x * pixels.shape[1] // self._source.shape[2], pixels.shape[1] - 1)
        self._along.setData(np.arange(1, len(pixels) + 1), pixels[:, column].astype(float))
        self._here.setValue(z + 1)

    def _place_lines(self) -> None:
        z, y, x = (index + 0.5 for index in self.point)
        for view, (across, down) in {self.front: (x, y), self.side: (z, y), self.top: (x, z)}.items():
            self._lines[view][0].setValue(across)
            self._lines[view][1].setValue(down)

    def _depth_words(self, plane: int) -> str:
        return "" if self._planes is None else f", {self._planes[0][plane] / 1000:.4g} mm"


def _line(view: StretchedImage, angle: int) -> Any:
    line = pg.InfiniteLine(angle=angle, pen=pg.mkPen(colours().warning, width=1, style=Qt.PenStyle.DotLine))
    view.box.addItem(line)
    return line
