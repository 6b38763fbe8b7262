"""Over and beside the live view: overlays on the image, and its histogram."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import QObject, QPointF, Qt, Signal
from PySide6.QtWidgets import QGraphicsItem, QVBoxLayout, QWidget

from gui.theme import colours
from gui.widgets.image_view import ImageView
from gui.widgets.plot import curve_pen, plot_widget, restyle
from instrument.live.frame_view import grouped


class CrossHair(QObject):
    """Two lines through a pixel; a click moves them.

    Signals
    -------
    moved : int, int
        Column and row.
    """

    moved = Signal(int, int)

    def __init__(self, view: ImageView) -> None:
        super().__init__(view)
        self._view = view
        pen = pg.mkPen(colours().accent, width=1)
        self._lines: tuple[Any, Any] = (pg.InfiniteLine(angle=90, pen=pen), pg.InfiniteLine(angle=0, pen=pen))
        self.pixel: tuple[int, int] | None = None
        self.enabled = False
        for line in self._lines:
            line.setVisible(False)
            view.box.addItem(line, ignoreBounds=True)
        view.clicked.connect(self.move_to)

    def set_enabled(self, enabled: bool) -> None:
        """Show or hide it; shown first in the middle."""
        self.enabled = enabled
        for line in self._lines:
            line.setVisible(enabled)
        if enabled and self.pixel is None and self._view.image is not None:
            height, width = self._view.image.shape[:2]
            self.move_to(width // 2, height // 2)

    def step(self, across: float, down: float) -> None:
        """Move it by so many pixels, at least one, and not out of the image."""
        if self.pixel is None or self._view.image is None:
            return
        height, width = self._view.image.shape[:2]
        column, row = (
            place + (int(math.copysign(max(1, round(abs(by))), by)) if by else 0)
            for place, by in zip(self.pixel, (across, down), strict=True)
        )
        self.move_to(min(max(column, 0), width - 1), min(max(row, 0), height - 1))

    def move_to(self, column: int, row: int) -> None:
        """Move it to a pixel."""
        if self.enabled:
            self.pixel = (column, row)
            self._lines[0].setValue(column + 0.5)
            self._lines[1].setValue(row + 0.5)
            self.moved.emit(column, row)


_STEP_PX = 10.0
"""A step of the arrow keys for lines and regions; Ctrl makes it a pixel. The cross-hair goes by pixels."""
_LEAST_PX = 2.0


class ProfileLine:
    """A line whose ends are dragged; ``ends`` in pixels."""

    def __init__(self, view: ImageView) -> None:
        self._view = view
        self.item: Any = None

    def set_enabled(self, enabled: bool) -> None:
        """Show or hide the line; shown first across the middle."""
        if enabled and self.item is None and self._view.image is not None:
            height, width = self._view.image.shape[:2]
            ends = [[0.1 * width, 0.5 * height], [0.9 * width, 0.5 * height]]
            self.item = pg.LineSegmentROI(ends, pen=pg.mkPen(colours().warning, width=1.5))
            self._view.box.addItem(self.item)
        elif not enabled and self.item is not None:
            self._view.box.removeItem(self.item)
            self.item = None

    def step(self, across: float, down: float, *, end_only: bool) -> None:
        """Move the line by steps of the arrow keys, or only its second end."""
        if self.item is None:
            return
        ends = [
            self.item.mapToParent(self.item.mapFromItem(handle["item"], 0, 0)) for handle in self.item.handles
        ]
        for end in ends[1:] if end_only else ends:
            end.setX(end.x() + _STEP_PX * across)
            end.setY(end.y() + _STEP_PX * down)
        for handle, end in zip(self.item.handles, ends, strict=True):
            self.item.movePoint(handle["item"], end)

    @property
    def ends(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Start and end, x and y in pixels; None while hidden."""
        if self.item is None:
            return None
        (_, a), (_, b) = self.item.getSceneHandlePositions()
        first, second = self._view.box.mapSceneToView(a), self._view.box.mapSceneToView(b)
        return (first.x(), first.y()), (second.x(), second.y())


class RegionBox:
    """A rectangle dragged with the mouse: anew on the frame, or by its handles; ``rectangle`` in pixels."""

    def __init__(self, view: ImageView) -> None:
        self._view = view
        self.item: Any = None

    def set_enabled(self, enabled: bool) -> None:
        """Show or hide it; shown first over the middle half."""
        if enabled and self.item is None and self._view.image is not None:
            height, width = self._view.image.shape[:2]
            self.item = pg.RectROI(
                [0.25 * width, 0.25 * height],
                [0.5 * width, 0.5 * height],
                pen=pg.mkPen(colours().ok, width=1.5),
                sideScalers=True,
            )
            self.item.addScaleHandle([0, 0], [1, 1])
            self._view.box.addItem(self.item)
            self._view.drag_taker = self.draw
        elif not enabled and self.item is not None:
            self._view.box.removeItem(self.item)
            self._view.drag_taker = None
            self.item = None

    def draw(self, start: QPointF, now: QPointF) -> None:
        """Make it the rectangle between two places of the frame, in pixels, cut off at the frame's edges."""
        if self.item is None or self._view.image is None:
            return
        height, width = self._view.image.shape[:2]
        left, right = sorted(min(max(place.x(), 0.0), width) for place in (start, now))
        top, bottom = sorted(min(max(place.y(), 0.0), height) for place in (start, now))
        if right - left >= 1 and bottom - top >= 1:
            self.item.setPos((left, top))
            self.item.setSize((right - left, bottom - top))

    def step(self, across: float, down: float, *, size_only: bool) -> None:
        """Move the rectangle by steps of the arrow keys, or its lower right corner."""
        if self.item is None:
            return
        dx, dy = _STEP_PX * across, _STEP_PX * down
        if size_only:
            width, height = self.item.size()
            self.item.setSize((max(_LEAST_PX, width + dx), max(_LEAST_PX, height + dy)))
        else:
            self.item.setPos(self.item.pos() + pg.Point(dx, dy))

    @property
    def rectangle(self) -> tuple[float, float, float, float] | None:
        """Left, top, width, height in pixels; None while hidden."""
        if self.item is None:
            return None
        place, size = self.item.pos(), self.item.size()
        return place.x(), place.y(), size.x(), size.y()


BINS = 256
_SHADE = 18
"""Opacity of the counts between the levels, of 255."""


class HistogramPlot(QWidget):
    """Pixels over counts, logarithmic; the sensor's full scale is marked.

    Signals
    -------
    levels_dragged : float, float
        The levels that were dragged with the mouse.
    """

    levels_dragged = Signal(float, float)

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.plot = plot_widget("counts", "pixels", grid=False)
        self.plot.setAntialiasing(False)
        for axis in ("bottom", "left"):  # their texts cost more than the curve, and seldom change
            self.plot.getAxis(axis).setCacheMode(QGraphicsItem.CacheMode.DeviceCoordinateCache)
        self.plot.setMouseEnabled(x=False, y=False)
        self.plot.hideButtons()
        self.plot.setLogMode(y=True)
        self.plot.disableAutoRange()
        self.curve: Any = self.plot.plot([], [], pen=curve_pen(0), fillLevel=0.0)
        self._fill()
        self.region: Any = pg.LinearRegionItem()
        self.region.sigRegionChanged.connect(self._dragged)
        self.plot.addItem(self.region)
        self.full_scale: Any = pg.InfiniteLine(angle=90)
        self.full_scale.setToolTip("full scale of the sensor")
        self.plot.addItem(self.full_scale)
        self._style_lines()
        self._quiet = False
        self._ranges = (0, 0.0)
        self.setToolTip("Histogram of the raw data. Drag the borders to choose levels; red: full scale")
        self.setMinimumHeight(130)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.plot)

    def show_counts(self, counts: npt.NDArray[np.float32], full_scale: int, low: float, high: float) -> None:
        """Show a histogram of all counts (``instrument.live.frame_view.histogram``) and the levels in use."""
        bins = grouped(counts, full_scale, BINS)
        step = (full_scale + 1) / BINS
        self.curve.setData(np.arange(BINS) * step, np.maximum(bins, 0.5))
        decades = float(np.ceil(np.log10(max(float(bins.max()), 10.0))))
        if (full_scale, decades) != self._ranges:
            self._ranges = (full_scale, decades)
            self.plot.setXRange(0, full_scale * 1.02, padding=0)
            self.plot.setYRange(-0.3, decades, padding=0)
            self.full_scale.setValue(full_scale)
        self._quiet = True
        self.region.setRegion((low, high))
        self._quiet = False

    def restyle(self) -> None:
        """Take over the theme in use."""
        restyle(self.plot)
        self.curve.setPen(curve_pen(0))
        self._fill()
        self._style_lines()

    def _style_lines(self) -> None:
        now = colours()
        shade = pg.mkColor(now.text)
        shade.setAlpha(_SHADE)
        self.region.setBrush(shade)
        for line in self.region.lines:
            line.setPen(pg.mkPen(now.warning))
            line.setHoverPen(pg.mkPen(now.text))
        self.full_scale.setPen(pg.mkPen(now.error, width=1.5))

    def _fill(self) -> None:
        colour = pg.mkColor(colours().accent)
        colour.setAlpha(60)
        self.curve.setBrush(pg.mkBrush(colour))

    def _dragged(self) -> None:
        if not self._quiet:
            low, high = self.region.getRegion()
            self.levels_dragged.emit(float(low), float(max(high, low + 1)))
