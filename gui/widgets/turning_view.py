"""A volume that is turned by hand or by itself: brightest voxels, depth as colour, a scale bar."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QPointF, QRectF, Signal
from PySide6.QtGui import QColor, QImage, QMouseEvent, QPainter, QPaintEvent, QPen, QResizeEvent, QWheelEvent
from PySide6.QtWidgets import QWidget

from gui.background import NewestOnly
from gui.jobs import Job, JobContext, JobRunner
from gui.theme import as_shown, colours, luminance, spares_hues, table
from gui.widgets.building import button, every, fill, in_row, label, share_bar
from gui.widgets.image_view import ArrowKeys
from gui.widgets.measure import round_length
from gui.words import quantity
from instrument.reconstruction.rendering import Pose, Renderer, depth_shades
from instrument.reconstruction.result_figures import Projections, in_colour_of_depth
from instrument.volumes.source import Plane, VolumeSource
from recon.arrays import Float64Array

_DRAG_DEG = 0.4
"""Turned for each pixel of the mouse."""
_KEY_DEG = 5.0
_TURN_MS, _TURN_DEG = 40, 2.0
_FIT = 0.95
_BAR_SHARE = 0.25
"""Of the view's width, about: the scale bar."""
_MARGIN_PX = 14
_FRONT = "From the front: it can be turned once all planes are read"


Planes = tuple[Float64Array, Float64Array]


class TurningView(QWidget):
    """Reads a volume and shows it from any side, with what it is looked at with.

    Parameters
    ----------
    jobs : JobRunner

    Signals
    -------
    opened
        It was read.
    failed : str
        It could not be.
    """

    opened = Signal()
    failed = Signal(str)

    def __init__(self, jobs: JobRunner, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._jobs = jobs
        self._job: Job | None = None
        self.canvas = TurningCanvas(jobs)
        self.setFocusProxy(self.canvas)
        tip = "Hues tell the depth: blue the first plane, red the last; else the colour map below"
        self.hues = button("Depth as colour", tip, self._show_looks, checkable=True)
        self.hues.setChecked(True)
        self.turn_button = button("Keep turning", "Let it turn by itself (space)", checkable=True)
        self.turn_button.toggled.connect(self.canvas.keep_turning)
        self.canvas.keys.acted.connect(lambda _: self.turn_button.toggle())
        self.legend = label(role="dim", yields=True)
        self.progress = share_bar()
        self.progress.hide()
        bar = in_row(self.hues, self.turn_button, (self.legend, 1))
        fill(self, bar, self.progress, (self.canvas, 1))
        self._looks: tuple[tuple[float, float], str] = ((0.0, 1.0), "grey")
        self._ends = ("first plane", "last plane")

    @property
    def renderer(self) -> Renderer | None:
        """The volume that was read; None before."""
        return self.canvas.renderer

    @property
    def pixels(self) -> npt.NDArray[np.uint8] | None:
        """The view that is shown, (height, width, 3)."""
        return self.canvas.pixels

    @property
    def is_open(self) -> bool:
        """Whether a volume was read, or is being read."""
        return self._job is not None

    def open(self, source: VolumeSource, planes_um: Planes | None) -> Job:
        """Read a volume, in a job; ``planes_um``: depth and lateral pitch of each plane, micrometres."""
        pitch_um = None if planes_um is None else middle_pitch_um(planes_um)
        step = None
        if planes_um is not None and pitch_um is not None and len(planes_um[0]) > 1:
            step_um = float(abs(planes_um[0][-1] - planes_um[0][0])) / (len(planes_um[0]) - 1)
            step = step_um / pitch_um if np.isfinite(step_um) and step_um > 0 else None
            self._ends = tuple(quantity(float(planes_um[0][z]), "um") for z in (0, -1))  # type: ignore[assignment]
        n_z = source.shape[0]
        self.progress.setRange(0, n_z)
        self.progress.setValue(0)
        self.progress.show()

        def work(context: JobContext) -> Renderer:
            return Renderer.of(source, step, lambda done, _: context.report(done))

        self._job = job = self._jobs.compute(f"Reading {source.path.name} for views from any side", work)
        job.progressed.connect(self.progress.setValue)
        job.succeeded.connect(lambda read: self._take(job, read, pitch_um))
        job.failed.connect(lambda why: self._not_read(job, why))
        job.ended.connect(self.progress.hide)
        return job

    def _not_read(self, job: Job, why: str) -> None:
        if job is self._job:
            self._job = None  # it can be opened again
        self.failed.emit(why)

    def show_front(self, seen: Projections) -> None:
        """Show the volume from the front, where nothing is to be turned yet."""
        if self.canvas.renderer is not None:
            return
        (levels, colour_map), by_depth = self._looks, self.hues.isChecked()

        def made() -> npt.NDArray[np.uint8]:
            if not by_depth:
                return as_shown(seen.front, *levels, colour_map)
            coloured = in_colours(seen, levels, red=spares_hues(colour_map))
            return np.asarray(np.round(255 * coloured), np.uint8)

        self.canvas.drawer.ask(made, self.canvas.show_front)

    def release(self) -> None:
        """End reading; nothing is shown then."""
        if self._job is not None:
            self._job.cancel()
        self._job = None
        self._ends = ("first plane", "last plane")
        self.turn_button.setChecked(False)
        self.canvas.show_volume(None)

    def set_looks(self, levels: tuple[float, float], colour_map: str) -> None:
        """Take other levels and another colour map."""
        self._looks = levels, colour_map
        self._show_looks()

    def _take(self, job: Job, renderer: Renderer, pitch_um: float | None) -> None:
        if job is self._job:
            self.canvas.show_volume(renderer, None if pitch_um is None else pitch_um * renderer.reduced)
            self._show_looks()
            self.opened.emit()

    def _show_looks(self) -> None:
        by_depth = self.hues.isChecked()
        self.canvas.set_looks(*self._looks, by_depth=by_depth)
        renderer = self.canvas.renderer
        hues = f"blue {self._ends[0]}, red {self._ends[1]}"
        if spares_hues(self._looks[1]):
            hues = "the red map does not show depth"
        words = [hues] if by_depth else []
        if renderer is not None and renderer.reduced > 1:
            words.append(f"means of {renderer.reduced} x {renderer.reduced} voxels")
        self.legend.setText("; ".join(words))


class TurningCanvas(QWidget):
    """A volume from any side: dragging and arrow keys turn it, the wheel, + and - zoom.

    Views are drawn in jobs, the newest wish only.

    Parameters
    ----------
    jobs : JobRunner
    """

    def __init__(self, jobs: JobRunner, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.drawer = NewestOnly(jobs, "Drawing a volume")
        """Makes the views, one after the other."""
        self.renderer: Renderer | None = None
        self.pose = Pose(30.0, 20.0)
        self.pitch_um: float | None = None
        """Of a lateral voxel of the renderer; None where it is not known."""
        self.pixels: npt.NDArray[np.uint8] | None = None
        """The view that is shown, (height, width, 3)."""
        self._front: npt.NDArray[np.uint8] | None = None
        """What is shown before there is a view."""
        self._zoom = 1.0
        self._shown_zoom = 1.0
        self._levels, self._map, self._by_depth = (0.0, 1.0), "grey", True
        self._shades: npt.NDArray[np.uint8] = np.zeros((1, 256, 3), np.uint8)
        self._dragged_from: QPointF | None = None
        self.setMinimumSize(160, 120)
        self.setToolTip(
            "Drag or arrow keys: turn; wheel, + and -: zoom; 0: from the front; space: keep turning"
        )
        self.keys = ArrowKeys(self, "Volume from any side")
        self.keys.moved.connect(lambda across, down: self.turn(_KEY_DEG * across, -_KEY_DEG * down))
        self.keys.zoomed.connect(self._zoomed)
        self._turning = every(self, _TURN_MS, self._turn_on)
        self._turning.stop()

    def show_volume(self, renderer: Renderer | None, pitch_um: float | None = None) -> None:
        """Show another volume; None: nothing."""
        self.renderer, self.pitch_um = renderer, pitch_um
        self.drawer.forget()
        self.pixels = None
        if renderer is None:
            self._front = None
        self._zoom = 1.0
        self._make_shades()
        self._ask()

    def show_front(self, front: npt.NDArray[np.uint8]) -> None:
        """Show a picture (height, width, 3) of the volume until it can be turned."""
        self._front = front
        self.update()

    def set_looks(self, levels: tuple[float, float], colour_map: str, *, by_depth: bool) -> None:
        """Take other levels, another colour map; ``by_depth``: hues tell the depth."""
        self._levels, self._map, self._by_depth = levels, colour_map, by_depth
        self._make_shades()
        self._ask()

    def turn(self, azimuth_deg: float, elevation_deg: float) -> None:
        """Turn it further."""
        self.pose = self.pose.turned(azimuth_deg, elevation_deg)
        self._ask()

    def keep_turning(self, on: bool) -> None:
        """Let it turn by itself, or not."""
        (self._turning.start if on else self._turning.stop)()

    # Inside --------------------------------------------------------------------------------------
    def _turn_on(self) -> None:
        if self.isVisible():
            self.turn(_TURN_DEG, 0.0)

    def _make_shades(self) -> None:
        if self.renderer is None:
            return
        if self._by_depth:
            shades = depth_shades(self.renderer.shape[0])
            if spares_hues(self._map):
                shades[..., 0] = shades.max(axis=-1)
                shades[..., 1:] = 0
            self._shades = shades
        else:
            self._shades = np.ascontiguousarray(table(self._map, mark_saturation=False)[None])

    def _ask(self) -> None:
        renderer = self.renderer
        if renderer is None:
            self.update()
            return
        size = (max(self.height(), 8), max(self.width(), 8))
        zoom = self._zoom * _FIT * min(size) / renderer.extent
        pose, levels, shades = self.pose, self._levels, self._shades
        self.drawer.ask(lambda: (zoom, renderer.draw(pose, size, zoom, levels, shades)), self._drawn)

    def _drawn(self, drawn: Any) -> None:
        self._shown_zoom, self.pixels = drawn
        self._front = None
        self.update()

    def _zoomed(self, factor: float) -> None:
        if factor:
            self._zoom = min(max(self._zoom * factor, 0.2), 20.0)
        else:
            self.pose, self._zoom = Pose(), 1.0
        self._ask()

    # Qt's names ----------------------------------------------------------------------------------
    def paintEvent(self, _event: QPaintEvent) -> None:  # noqa: N802
        """Draw the newest view, its scale bar, its axes."""
        painter = QPainter(self)
        painter.fillRect(self.rect(), QColor(colours().window))
        if self.pixels is not None:
            height, width = self.pixels.shape[:2]
            image = QImage(self.pixels.data, width, height, 3 * width, QImage.Format.Format_RGB888)
            painter.drawImage(QRectF(self.rect()), image)
            self._draw_bar(painter)
            self._draw_axes(painter)
        elif self._front is not None:
            self._draw_front(painter, self._front)
        painter.end()

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802
        """Draw it anew for the new size."""
        super().resizeEvent(event)
        self._ask()

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Begin to turn."""
        self.setFocus()
        self._dragged_from = event.position()

    def mouseMoveEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Turn it with the mouse."""
        if self._dragged_from is not None:
            by = event.position() - self._dragged_from
            self._dragged_from = event.position()
            self.turn(_DRAG_DEG * by.x(), _DRAG_DEG * by.y())

    def mouseReleaseEvent(self, _event: QMouseEvent) -> None:  # noqa: N802
        """End turning."""
        self._dragged_from = None

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802
        """Zoom."""
        self._zoomed(1.25 ** (event.angleDelta().y() / 120))

    def _draw_front(self, painter: QPainter, front: npt.NDArray[np.uint8]) -> None:
        """Draw the volume from the front, and that it cannot be turned yet."""
        height, width = front.shape[:2]
        image = QImage(front.data, width, height, 3 * width, QImage.Format.Format_RGB888)
        scale = _FIT * min(self.width(), self.height()) / float(np.hypot(height, width))
        place = QRectF(0, 0, scale * width, scale * height)
        place.moveCenter(QRectF(self.rect()).center())
        painter.fillRect(self.rect(), QColor(0, 0, 0))  # as behind the views to come
        painter.drawImage(place, image)
        painter.setPen(_ink())
        painter.drawText(QPointF(_MARGIN_PX, self.height() - _MARGIN_PX), _FRONT)

    def _draw_bar(self, painter: QPainter) -> None:
        """Draw a bar of a round length, with its length; in voxels where no pitch is known."""
        pitch = self.pitch_um or 1.0
        length = round_length(_BAR_SHARE * self.width() / self._shown_zoom * pitch)
        across = length / pitch * self._shown_zoom
        y = self.height() - _MARGIN_PX
        painter.setPen(QPen(_ink(), 3))
        painter.drawLine(QPointF(_MARGIN_PX, y), QPointF(_MARGIN_PX + across, y))
        words = f"{length:g} voxels" if self.pitch_um is None else quantity(length, "um")
        painter.drawText(QPointF(_MARGIN_PX, y - 8), words)

    def _draw_axes(self, painter: QPainter) -> None:
        """Draw where x, y and z go, in the lower right corner."""
        middle = QPointF(self.width() - 3.5 * _MARGIN_PX, self.height() - 3.5 * _MARGIN_PX)
        to_view = self.pose.matrix
        painter.setPen(QPen(_ink(), 1.5))
        for number, name in enumerate("zyx"):
            end = QPointF(to_view[2, number], to_view[1, number])
            painter.drawLine(middle, middle + end * 2 * _MARGIN_PX)
            painter.drawText(middle + end * 2.7 * _MARGIN_PX + QPointF(-3, 4), name)


def _ink() -> QColor:
    """Return what is read on the views' black in each theme."""
    return QColor(max((colours().text, colours().window), key=luminance))


def middle_pitch_um(planes_um: Planes) -> float | None:
    """Return the lateral voxel of the middle plane; None where it is not known."""
    pitch = float(planes_um[1][len(planes_um[1]) // 2])
    return pitch if np.isfinite(pitch) and pitch > 0 else None


def in_colours(p: Projections, levels: tuple[float, float], *, red: bool) -> Plane:
    """Return the front with its depth as colour, float32, (height, width, 3) in 0 to 1.

    ``red``: for eyes used to the dark no channel but that.
    """
    low, high = levels
    shown = in_colour_of_depth(p.front - np.float32(low), p.deepest, len(p.top), max(high - low, 1e-12))
    if red:
        shown[..., 0] = shown.max(axis=-1)
        shown[..., 1:] = 0
    return shown.astype(np.float32)
