"""The mask's alignment drawn: displacement over the mask, pose with error bars."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QHBoxLayout,
    QHeaderView,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)

from calibration_routines.display.mask_alignment import AlignmentReport
from gui.theme import colours
from gui.widgets.plot import plot_widget, restyle
from recon.holography.pose import NAMES

_LONGEST = 0.12
"""Of the mask's width: the longest arrow."""


class DisplacementPlot:
    """Arrows from nodes over the mask, all lengthened by one factor, which the title says.

    Attributes
    ----------
    plot : pyqtgraph.PlotWidget
    """

    def __init__(self, words: str) -> None:
        self.plot: Any = plot_widget("mask pixels", "mask pixels")
        self.plot.setAspectLocked(True)
        self.plot.invertY(True)
        self.words = words
        self.title = ""
        self._arrows: Any = self.plot.plot([], [])
        self._tails: Any = self.plot.plot([], [])
        self.clear()

    def clear(self) -> None:
        """Show nothing."""
        self._arrows.setData([], [])
        self._tails.setData([], [])
        self._say(self.words)

    def show_field(self, field: npt.NDArray[np.float64], mask_shape: tuple[int, int]) -> None:
        """Show a field.

        Parameters
        ----------
        field : ndarray, float64, (rows, columns, 2)
            ``(y, x)`` in mask pixels, on nodes from edge to edge.
        mask_shape : (int, int)
        """
        height, width = mask_shape
        y, x = np.meshgrid(
            np.linspace(0, height, field.shape[0]), np.linspace(0, width, field.shape[1]), indexing="ij"
        )
        size = np.hypot(field[..., 0], field[..., 1])
        factor = _LONGEST * width / max(float(size.max()), 1e-9)
        ends_x, ends_y = x + factor * field[..., 1], y + factor * field[..., 0]
        across = np.stack([x.ravel(), ends_x.ravel()], axis=1).ravel()
        down = np.stack([y.ravel(), ends_y.ravel()], axis=1).ravel()
        self._arrows.setData(across, down, connect="pairs", pen=pg.mkPen(colours().accent, width=1.5))
        dots = {"symbol": "o", "symbolSize": 4, "symbolPen": None, "symbolBrush": pg.mkBrush(colours().text)}
        self._tails.setData(x.ravel(), y.ravel(), pen=None, **dots)
        rms = float(np.sqrt(np.mean(size**2)))
        self._say(f"{self.words}: {rms:.2f} mask pixels rms, {size.max():.2f} at most (drawn {factor:.0f}x)")
        self.plot.autoRange()

    def restyle(self) -> None:
        """Take over another theme."""
        restyle(self.plot)
        self._say(self.title)

    def _say(self, title: str) -> None:
        self.title = title
        self.plot.setTitle(title, color=colours().dim, size="9pt")


_UNITS = {
    "shift_x": "mask px",
    "shift_y": "mask px",
    "roll_mrad": "mrad",
    "scale": "",
    "cubic": "mask px",
    "z_um": "um",
    "pitch_mrad": "mrad",
    "yaw_mrad": "mrad",
}
_WORDS = {
    "shift_x": "shift x",
    "shift_y": "shift y",
    "roll_mrad": "rotation",
    "scale": "scale",
    "cubic": "distortion",
    "z_um": "distance",
    "pitch_mrad": "tilt x",
    "yaw_mrad": "tilt y",
}
_LATERAL = ("shift_x", "shift_y", "roll_mrad", "scale")
_AXIAL = ("z_um", "pitch_mrad", "yaw_mrad")


class PoseView(QWidget):
    """A table of the pose's parameters, and two plots of what is left with its uncertainty.

    The first plot says what a parameter moves at the mask's edge, in mask pixels: a hologram feels a tenth.
    The second has distance and tilts in their own units.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.table = QTableWidget(len(NAMES), 3)
        self.table.setHorizontalHeaderLabels(["found", "left", "+-"])
        self.table.setVerticalHeaderLabels([f"{_WORDS[n]} ({_UNITS[n]})".replace(" ()", "") for n in NAMES])
        self.table.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
        self.table.setTabKeyNavigation(False)
        self.table.verticalHeader().setDefaultSectionSize(23)
        self.table.horizontalHeader().setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        self.table.setToolTip("Found before the stage moved; left for the model; standard uncertainty")
        self.lateral: Any = plot_widget("", "at the mask's edge", y_unit="mask px")
        self.axial: Any = plot_widget("", "um, mrad")
        self.report: AlignmentReport | None = None
        plots = QHBoxLayout()
        plots.addWidget(self.lateral, 4)
        plots.addWidget(self.axial, 3)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.table, 3)
        layout.addLayout(plots, 2)

    def clear(self) -> None:
        """Show nothing."""
        self.report = None
        self.table.clearContents()
        self.lateral.clear()
        self.axial.clear()

    def show_report(self, report: AlignmentReport) -> None:
        """Show a pose."""
        self.report = report
        found, left = report.found_at.vector(), report.pose.vector()
        for row, values in enumerate(zip(found, left, report.error, strict=True)):
            for column, value in enumerate(values):
                item = QTableWidgetItem(f"{value:+.4g}" if column < 2 else f"{value:.2g}")
                item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
                self.table.setItem(row, column, item)
        edge = max(report.mask_shape) / 2
        at_edge = {"roll_mrad": 1e-3 * edge, "scale": edge}
        self._draw(self.lateral, _LATERAL, np.array([at_edge.get(n, 1.0) for n in _LATERAL]))
        self._draw(self.axial, _AXIAL, np.ones(len(_AXIAL)))

    def restyle(self) -> None:
        """Take over another theme."""
        restyle(self.lateral)
        restyle(self.axial)
        if self.report is not None:
            self.show_report(self.report)

    def _draw(self, plot: Any, names: tuple[str, ...], factors: npt.NDArray[np.float64]) -> None:
        report = self.report
        assert report is not None
        rows = [NAMES.index(name) for name in names]
        left, error = report.pose.vector()[rows] * factors, report.error[rows] * factors
        x = np.arange(len(names), dtype=float)
        plot.clear()
        plot.addItem(pg.InfiniteLine(angle=0, pos=0.0, pen=pg.mkPen(colours().line)))
        pen = pg.mkPen(colours().accent, width=2)
        plot.addItem(pg.ErrorBarItem(x=x, y=left, height=2 * error, beam=0.2, pen=pen))
        dots = {
            "symbol": "o",
            "symbolSize": 8,
            "symbolPen": None,
            "symbolBrush": pg.mkBrush(colours().accent),
        }
        plot.plot(x, left, pen=None, **dots)
        plot.getAxis("bottom").setTicks([list(zip(x, (_WORDS[n] for n in names), strict=True))])
        plot.setXRange(-0.5, len(names) - 0.5)
