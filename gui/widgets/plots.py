"""Plots in the program's looks; histograms of an image with the levels it is shown with, to be dragged."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QRectF, QSignalBlocker, QSize, Qt, Signal
from PySide6.QtGui import QColor, QPainter, QPaintEvent
from PySide6.QtWidgets import QGraphicsItem, QWidget

from gui.theme import NAMES, colours
from gui.widgets.building import button, choice, fill, label, mark, narrow
from gui.widgets.entry import NumberEdit
from instrument.files.errors import percent
from instrument.files.seen import levels_of
from instrument.live.frame_view import FrameFigures, grouped
from recon.arrays import Array, Float32Array

# Images are (row, column) here as everywhere else in the project.
pg.setConfigOptions(imageAxisOrder="row-major", antialias=True)


_DECIMAL = re.compile(r"[-−]?\d+(\.\d+)?")


class _Plot(pg.PlotWidget):  # type: ignore[misc] # pyqtgraph has no type annotations
    """A plot in the colours of the theme, which is no larger than it must be where room is scarce."""

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return a small size: 640 x 480, a view's own, is the least beside a line that wraps."""
        return QSize(160, 90).expandedTo(self.minimumSize())

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        now = colours()
        self.setBackground(now.panel)
        for axis in ("bottom", "left"):
            self.getAxis(axis).setPen(now.line)
            self.getAxis(axis).setTextPen(now.dim)

    def set_axes(self, x_label: str, y_label: str, x_unit: str = "", y_unit: str = "") -> None:
        """Say what is drawn over what."""
        self.setAccessibleName(" over ".join(filter(None, (y_label, x_label))) or "Plot")
        self.setLabel("bottom", _label(x_label, x_unit))
        self.setLabel("left", _label(y_label, y_unit))


class _Axis(pg.AxisItem):  # type: ignore[misc] # pyqtgraph has no type annotations
    """An axis whose numbers all have as many digits behind the point as the finest of them needs.

    Of a logarithmic one each has its own: 0.01, 1, 100.
    """

    _places: int | None = None

    def generateDrawSpecs(self, painter: QPainter) -> Any:  # noqa: N802 - pyqtgraph's name
        """Return what is drawn: once more where coarse and fine ticks came with digits of their own."""
        self._places = None
        specs = super().generateDrawSpecs(painter)
        texts = [text for _, _, text in specs[2]] if specs is not None else []
        if self._tickLevels is None and not self.logMode and all(_DECIMAL.fullmatch(text) for text in texts):
            places = {len(text.partition(".")[2]) for text in texts}
            if len(places) > 1:
                self._places = max(places)
                specs = super().generateDrawSpecs(painter)
        return specs

    def tickStrings(self, values: Sequence[float], scale: float, spacing: float) -> list[str]:  # noqa: N802
        """Return the numbers beside ticks."""
        texts = super().tickStrings(values, scale, spacing)
        if self._places is not None:
            texts = [f"{value * scale:.{self._places}f}" for value in values]
        return [text.replace("-", "−") for text in texts]


class _Counts(_Axis):
    """An axis of things that are counted: nothing stands between two of them."""

    def tickSpacing(self, least: float, most: float, size: float) -> list[tuple[float, float]]:  # noqa: N802
        """Return the steps of ticks, coarse ones first, without fractions of one."""
        steps = super().tickSpacing(least, most, size)
        return [(step, start) for step, start in steps if step >= 1 and step % 1 == 0] or [(1.0, 0.0)]


def plot_widget(
    x_label: str = "",
    y_label: str = "",
    *,
    x_unit: str = "",
    y_unit: str = "",
    grid: bool = True,
    counts: bool = False,
) -> Any:
    """Return a ``pyqtgraph.PlotWidget`` in the theme's colours, with labelled axes; ``counts``: x counts.

    pyqtgraph has no type annotations, hence ``Any``.
    """
    axes = {"bottom": _Counts("bottom") if counts else _Axis("bottom"), "left": _Axis("left")}
    plot = _Plot(enableMenu=False, axisItems=axes)
    plot.setFocusPolicy(Qt.FocusPolicy.NoFocus)
    plot.restyle()
    # Room for letters below the line, and for the half of a number that stands at an axis' end.
    plot.getPlotItem().layout.setContentsMargins(0, 6, 16, 4)
    plot.set_axes(x_label, y_label, x_unit, y_unit)
    plot.showGrid(x=grid, y=grid, alpha=0.15)
    for axis in ("bottom", "left"):
        plot.getAxis(axis).enableAutoSIPrefix(False)  # units are in the labels as people here say them
    return plot


_DASHES = (Qt.PenStyle.SolidLine, Qt.PenStyle.DashLine, Qt.PenStyle.DotLine, Qt.PenStyle.DashDotLine)
"""Tell curves apart where hues cannot: in the red theme, and for eyes that do not tell them."""
_SIGNS = ("——", "– –", "···", "–·–")
"""The same in words' lines."""


def curve_pen(number: int = 0, width: float = 1.5) -> Any:
    """Return the pen of the ``number``-th curve of a plot."""
    return pg.mkPen(curve_colour(number), width=width, style=_DASHES[number % len(_DASHES)])


def curve_colour(number: int) -> str:
    """Return the colour of the ``number``-th curve of a plot."""
    names = colours().curves
    return names[number % len(names)]


def dots(colour: Any, size: int = 5) -> dict[str, Any]:
    """Return what draws filled dots at the points of a curve; ``colour`` is one, or a brush for each."""
    brush = colour if isinstance(colour, list) or colour is None else pg.mkBrush(colour)
    return {"symbol": "o", "symbolSize": size, "symbolPen": None, "symbolBrush": brush}


def legend(names: Mapping[int, str]) -> str:
    """Return the names of curves by their numbers, each with its line and colour, as rich text.

    No line ends within a name, nor between it and its curve: word joiners hold dashes together.
    """
    signs = ["&#8288;".join(sign).replace(" ", "&nbsp;") for sign in _SIGNS]
    return " &nbsp; ".join(
        f'<span style="color:{curve_colour(number)}"><b>{signs[number % len(signs)]}</b></span>&#8288;&nbsp;'
        + name.replace(" ", "&nbsp;")
        for number, name in names.items()
    )


def _label(text: str, unit: str) -> str:
    return f"{text} ({unit})" if unit else text


_MOST_PIXELS = 250_000
"""The histogram is that of about so many pixels, evenly spaced over the image."""
_BINS = 128


class LevelsBar(QWidget):
    """A histogram, two levels, a colour map.

    Signals
    -------
    changed
        Levels or colour map are others now.
    """

    changed = Signal()

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.low = NumberEdit(tip="Value shown darkest")
        self.high = NumberEdit(tip="Value shown brightest")
        self.low.submitted.connect(self._typed)
        self.high.submitted.connect(self._typed)
        tip = "From zero to the brightest pixels but one in a thousand, as in the preview file"
        self.auto = button("Auto", tip, self.to_automatic)
        self.map = narrow(choice(NAMES, "Colour map of grey images"), 4)
        self.map.setCurrentText(colours().colour_map)
        self.map.currentTextChanged.connect(lambda _: self.changed.emit())
        self.plot: Any = pg.PlotWidget(background=colours().panel, enableMenu=False)
        self.plot.setFocusPolicy(Qt.FocusPolicy.NoFocus)  # levels are typed in their fields
        self.plot.setAccessibleName("Histogram of the picture")
        self.plot.setFixedHeight(44)
        self.plot.setMinimumWidth(50)
        self.plot.hideAxis("left")
        self.plot.hideAxis("bottom")
        self.plot.setMouseEnabled(x=False, y=False)
        self.plot.hideButtons()
        self.plot.setToolTip(
            "Histogram (logarithmic count); drag the edges to set what is darkest and brightest"
        )
        self._curve = self.plot.plot([0, 1], [0], stepMode="center", fillLevel=0, brush=colours().line)
        self.region: Any = pg.LinearRegionItem((0, 1), pen=colours().accent, brush=(255, 255, 255, 16))
        self.region.sigRegionChanged.connect(self._dragged)
        self.plot.addItem(self.region)
        for field in (self.low, self.high):
            field.setMinimumWidth(48)
            field.setMaximumWidth(90)
        fill(self, self.low, (self.plot, 3), self.high, self.auto, self.map, across=True)
        self._levels = (0.0, 1.0)
        self._automatic = (0.0, 1.0)

    @property
    def levels(self) -> tuple[float, float]:
        """The values shown darkest and brightest."""
        return self._levels

    @property
    def colour_map(self) -> str:
        """The name of the colour map."""
        return self.map.currentText()

    def set_levels(self, low: float, high: float) -> None:
        """Set both levels; the higher one must be above the lower."""
        with QSignalBlocker(self.region):
            self.region.setRegion((low, high))
        self._take(low, high)

    def to_automatic(self) -> None:
        """Go back to zero and the white level of the preview file."""
        self.set_levels(*self._automatic)

    def set_image(self, image: Array, *, keep_levels: bool = False) -> None:
        """Show the histogram of an image, and choose its levels unless they are to be kept."""
        step = max(1, round((image.size / _MOST_PIXELS) ** 0.5))
        sample = np.asarray(image[::step, ::step], np.float32)
        lowest, highest = float(sample.min()), float(sample.max())
        self._automatic = (min(0.0, highest - 1.0) if highest <= 0 else 0.0, max(levels_of(sample).white))
        counts, bins = np.histogram(sample, _BINS, (lowest, highest if highest > lowest else lowest + 1.0))
        edges = bins.astype(float)  # pyqtgraph's limits overflow in float32
        self._curve.setData(edges, np.log1p(counts))
        margin = 0.02 * (edges[-1] - edges[0])
        low, high = min(edges[0], self._automatic[0]), max(edges[-1], self._automatic[1])
        self.plot.setXRange(float(low - margin), float(high + margin), padding=0)
        if not keep_levels:
            self.to_automatic()

    def restyle(self) -> None:
        """Take over the colours and the colour map of the theme in use."""
        now = colours()
        self.plot.setBackground(now.panel)
        self._curve.setBrush(now.line)
        for line in self.region.lines:
            line.setPen(now.accent)
        self.map.setCurrentText(now.colour_map)

    def _typed(self, _value: float) -> None:
        assert self.low.value is not None
        assert self.high.value is not None
        self.set_levels(self.low.value, self.high.value)

    def _dragged(self) -> None:
        self._take(*self.region.getRegion())

    def _take(self, low: float, high: float) -> None:
        self._levels = (low, high)
        self.low.set_value(float(f"{low:.4g}"))
        self.high.set_value(float(f"{high:.4g}"))
        self.low.set_limits(-np.inf, high)
        self.high.set_limits(low, np.inf)
        self.changed.emit()


_NEAR_FULL = 0.9
"""Of the sensor's range: from here on it is said that little is left."""


class RangeBar(QWidget):
    """The sensor's whole range as a bar: what the counts fill, where the mean is; with the figures below."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.figures: FrameFigures | None = None
        self.words = label("No frame yet.", wraps=True, selectable=True)
        self.words.setObjectName("figures")
        self.words.setToolTip("Of the raw data, all pixels; share: the largest count of the sensor's range")
        fill(self, _BAR_PX + 3, self.words)

    def show_figures(self, figures: FrameFigures) -> None:
        """Show the figures of a frame."""
        self.figures = figures
        words = f"max {figures.largest} ({percent(figures.share)})   mean {figures.mean:.1f}"
        warns = ""
        if figures.saturated > 0:
            words += f"   SATURATED {percent(figures.saturated)} of pixels"
            warns = "error"
        elif figures.share > _NEAR_FULL:
            words += "   near full scale"
            warns = "warning"
        self.words.setText(words)
        if self.words.property("warns") != warns:
            mark(self.words, "warns", warns)
        self.update()

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: N802 - Qt's name
        """Draw the bar."""
        now, figures = colours(), self.figures
        painter = QPainter(self)
        painter.fillRect(0, 0, self.width(), _BAR_PX, QColor(now.field))
        if figures is None:
            return
        scale = self.width() / figures.full_scale
        left, right = scale * figures.least, max(scale * figures.largest, scale * figures.least + 2)
        filled = (
            now.error if figures.saturated > 0 else now.warning if figures.share > _NEAR_FULL else now.accent
        )
        painter.fillRect(QRectF(left, 1, right - left, _BAR_PX - 2), QColor(filled))
        painter.fillRect(QRectF(scale * figures.mean - 1, 0, 2, _BAR_PX), QColor(now.text))


_LIVE_BINS = 256
_BAR_PX = 10
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
        self._ranges: tuple[float, ...] = ()
        self.setToolTip(
            "Histogram of the raw data, as far as they reach; the bar below is the sensor's whole range. "
            "Drag the borders to choose levels"
        )
        self.plot.hide()  # without counts its numbers would mean nothing
        self.setMinimumHeight(130)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.range = RangeBar()
        fill(self, (self.plot, 1), self.range)

    def show_counts(self, counts: Float32Array, figures: FrameFigures, low: float, high: float) -> None:
        """Show a histogram of all counts (``instrument.live.frame_view.histogram``) and the levels in use.

        It reaches over what the data fill; the bar below has the sensor's whole range.
        """
        self.plot.show()
        first, last = figures.span
        bins, step = grouped(counts, first, last, _LIVE_BINS)
        self.curve.setData(first + np.arange(_LIVE_BINS) * step, np.maximum(bins, 0.5))
        decades = float(np.ceil(np.log10(max(float(bins.max()), 10.0))))
        if (first, last, figures.full_scale, decades) != self._ranges:
            self._ranges = (first, last, figures.full_scale, decades)
            margin = 0.02 * (last - first + 1)
            self.plot.setXRange(first - margin, last + margin, padding=0)
            self.plot.setYRange(-0.3, decades, padding=0)
            self.full_scale.setValue(figures.full_scale)
        self.range.show_figures(figures)
        with QSignalBlocker(self.region):
            self.region.setRegion((low, high))

    def restyle(self) -> None:
        """Take over the theme in use."""
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
        low, high = self.region.getRegion()
        self.levels_dragged.emit(float(low), float(max(high, low + 1)))
