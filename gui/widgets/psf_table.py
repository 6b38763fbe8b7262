"""The quality of PSFs as they arrive: a row each, and how they compare."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any

import pyqtgraph as pg
from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QColor
from PySide6.QtWidgets import QHeaderView, QSplitter, QTableWidget, QTableWidgetItem, QVBoxLayout, QWidget

from calibration_routines.psf.psf_quality import MIN_SNR, PsfQuality
from calibration_routines.psf.sweep_watch import PointTaken
from gui.theme import colours
from gui.widgets.plot import plot_widget, restyle

_COLUMNS = (
    ("x (mm)", "Where the source stood"),
    ("y (mm)", "Where the source stood"),
    ("z (mm)", "Where the source stood"),
    ("signal/noise", f"Mean signal inside the pattern over a pixel's noise; from {MIN_SNR:g} it is good"),
    ("saturated", "Pixels at full scale"),
    ("off (px)", "Distance from where the others, or the stage, say the pattern is"),
    ("verdict", "What is wrong; the whole text as tool tip"),
)
_VERDICT = len(_COLUMNS) - 1


class PsfTable(QWidget):
    """A table of PSFs and a plot of their signal to noise; those with findings are marked.

    Signals
    -------
    chosen : int
        The row of a PSF that was clicked.
    """

    chosen = Signal(int)

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.table = QTableWidget(0, len(_COLUMNS))
        self.table.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
        self.table.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        self.table.verticalHeader().setDefaultSectionSize(24)
        self.table.setTabKeyNavigation(False)
        for column, (name, tip) in enumerate(_COLUMNS):
            item = QTableWidgetItem(name)
            item.setToolTip(tip)
            self.table.setHorizontalHeaderItem(column, item)
        header = self.table.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(_VERDICT, QHeaderView.ResizeMode.Stretch)
        self.table.currentCellChanged.connect(lambda row, *_: self.chosen.emit(row))
        self.plot: Any = plot_widget("PSF", "signal / noise")
        self.plot.setMinimumHeight(90)
        self._points: Any = self.plot.plot([], [])
        self._least: Any = pg.InfiniteLine(angle=0, pos=MIN_SNR)
        self.plot.addItem(self._least)
        self._qualities: list[PsfQuality | None] = []
        split = QSplitter(Qt.Orientation.Vertical)
        split.addWidget(self.table)
        split.addWidget(self.plot)
        split.setSizes([220, 140])
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(split)
        self.restyle()

    @property
    def qualities(self) -> tuple[PsfQuality | None, ...]:
        """What is shown, by row; None for PSFs that have not arrived."""
        return tuple(self._qualities)

    def clear(self) -> None:
        """Show nothing."""
        self._qualities = []
        self.table.setRowCount(0)
        self._draw()

    def arrived(self, event: PointTaken) -> None:
        """Show a PSF that was just taken, or taken again."""
        row = event.number - 1
        self._set(row, event.quality, "taking it again" if event.retaking else "")
        self.table.scrollTo(self.table.model().index(row, 0))
        self._draw()

    def show_all(self, qualities: Sequence[PsfQuality]) -> None:
        """Show the last judgement, which holds all PSFs against one another."""
        self.table.setRowCount(len(qualities))
        self._qualities = []
        for row, quality in enumerate(qualities):
            self._set(row, quality)
        self._draw()

    def restyle(self) -> None:
        """Take over another theme."""
        restyle(self.plot)
        self._least.setPen(pg.mkPen(colours().warning, style=Qt.PenStyle.DashLine))
        self._draw()

    def _set(self, row: int, quality: PsfQuality, note: str = "") -> None:
        if self.table.rowCount() <= row:
            self.table.setRowCount(row + 1)
        self._qualities += [None] * (row + 1 - len(self._qualities))
        self._qualities[row] = quality
        verdict = note or ("good" if not quality.findings else " ".join(quality.findings))
        cells = [f"{value / 1e3:.4g}" for value in quality.source_um]
        cells += [f"{quality.snr:.0f}", f"{quality.saturated_pixels}", f"{quality.step_px:.2f}", verdict]
        for column, text in enumerate(cells):
            item = QTableWidgetItem(text)
            if column != _VERDICT:
                item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
            if quality.findings:
                item.setForeground(QColor(colours().warning))
                item.setToolTip("\n".join(quality.findings))
            self.table.setItem(row, column, item)

    def _draw(self) -> None:
        # A single frame without noise has no figure.
        known = [(row + 1, q) for row, q in enumerate(self._qualities) if q is not None and isfinite(q.snr)]
        self.plot.setVisible(bool(known))
        brushes = [pg.mkBrush(colours().warning if q.findings else colours().ok) for _, q in known]
        self._points.setData(
            [number for number, _ in known],
            [q.snr for _, q in known],
            pen=pg.mkPen(colours().line),
            symbol="o",
            symbolSize=7,
            symbolPen=None,
            symbolBrush=brushes or None,
        )
