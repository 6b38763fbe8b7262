"""The histogram of the raw counts, with the levels shown darkest and brightest to drag."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QGraphicsItem, QVBoxLayout, QWidget

from gui.theme import colours
from gui.widgets.plot import curve_pen, plot_widget, restyle
from instrument.live.frame_view import grouped

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
