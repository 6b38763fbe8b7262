"""The levels of an image: its histogram with the two values shown darkest and brightest, to be dragged."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import Signal
from PySide6.QtWidgets import QComboBox, QHBoxLayout, QPushButton, QWidget

from gui.theme import NAMES, colours
from gui.widgets.number_edit import NumberEdit
from instrument.reconstruction.result_file import white_level

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
        self.auto = QPushButton("Auto")
        self.auto.setToolTip(
            "From zero to the brightest pixels but one in a thousand, as in the preview file"
        )
        self.auto.clicked.connect(self.to_automatic)
        self.map = QComboBox()
        self.map.addItems(list(NAMES))
        self.map.setCurrentText(colours().colour_map)
        self.map.setToolTip("Colour map of grey images")
        self.map.currentTextChanged.connect(lambda _: self.changed.emit())
        self.plot: Any = pg.PlotWidget(background=colours().panel)
        self.plot.setFixedHeight(44)
        self.plot.setMinimumWidth(50)
        self.plot.hideAxis("left")
        self.plot.hideAxis("bottom")
        self.plot.setMouseEnabled(x=False, y=False)
        self.plot.setMenuEnabled(False)
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
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        self.map.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
        self.map.setMinimumContentsLength(4)
        row.addWidget(self.low)
        row.addWidget(self.plot, 3)
        row.addWidget(self.high)
        row.addWidget(self.auto)
        row.addWidget(self.map)
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
        self._levels = (low, high)
        self.low.set_value(float(f"{low:.4g}"))
        self.high.set_value(float(f"{high:.4g}"))
        self.low.set_limits(-np.inf, high)
        self.high.set_limits(low, np.inf)
        self.region.blockSignals(True)
        self.region.setRegion((low, high))
        self.region.blockSignals(False)
        self.changed.emit()

    def to_automatic(self) -> None:
        """Go back to zero and the white level of the preview file."""
        self.set_levels(*self._automatic)

    def set_image(self, image: npt.NDArray[Any], *, keep_levels: bool = False) -> None:
        """Show the histogram of an image, and choose its levels unless they are to be kept."""
        step = max(1, round((image.size / _MOST_PIXELS) ** 0.5))
        sample = np.asarray(image[::step, ::step], np.float32)
        lowest, highest = float(sample.min()), float(sample.max())
        self._automatic = (min(0.0, highest - 1.0) if highest <= 0 else 0.0, white_level(sample))
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
        low, high = self.region.getRegion()
        self._levels = (low, high)
        self.low.set_value(float(f"{low:.4g}"))
        self.high.set_value(float(f"{high:.4g}"))
        self.low.set_limits(-np.inf, high)
        self.high.set_limits(low, np.inf)
        self.changed.emit()
