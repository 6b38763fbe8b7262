"""How a solver converged: residual against the expected noise, and change an iteration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QCheckBox, QHBoxLayout, QLabel, QVBoxLayout, QWidget

from gui.theme import colours
from gui.widgets.plot import curve_pen, plot_widget, restyle
from recon.solvers.stopping import IterationRecord

Histories = tuple[tuple[IterationRecord, ...], ...]


class ConvergenceView(QWidget):
    """Plots histories, one a channel, both quantities on one logarithmic axis."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.plot: Any = plot_widget("iteration")
        self.plot.setLogMode(y=True)
        self.plot.setMinimumSize(120, 80)
        self.plot.setToolTip(
            "Residual in units of what the noise explains (1: nothing is left to explain), "
            "and relative change of the result an iteration"
        )
        self.legend = QLabel()
        self.legend.setMinimumWidth(10)
        self.against_time = QCheckBox("seconds")
        self.against_time.setToolTip("Horizontal axis: wall seconds of the solver instead of iterations")
        self.against_time.toggled.connect(self._draw)
        self.curves: dict[str, Any] = {}
        self._numbers: dict[int, str] = {}
        self._histories: Histories = ()
        self._noise_norm: float | None = None
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(0)
        row = QHBoxLayout()
        row.addWidget(self.legend, 1)
        row.addWidget(self.against_time)
        layout.addLayout(row)
        layout.addWidget(self.plot, 1)

    def show_histories(self, histories: Histories, noise_norm: float | None) -> None:
        """Draw histories; ``noise_norm`` is the expected norm of the noise in the residuals' units."""
        self._histories, self._noise_norm = histories, noise_norm
        self._draw()

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        restyle(self.plot)
        self._draw()

    def _draw(self) -> None:
        self.plot.clear()
        self.curves, self._numbers = {}, {}
        by_time = self.against_time.isChecked()
        self.plot.setLabel("bottom", "seconds" if by_time else "iteration")
        norm = self._noise_norm or 1.0
        for channel, history in enumerate(self._histories):
            x = np.array([r.seconds if by_time else r.iteration for r in history])
            suffix = "" if len(self._histories) == 1 else f", channel {channel}"
            self._add(f"residual / noise{suffix}", x, [r.data_residual / norm for r in history], 2 * channel)
            self._add(f"change{suffix}", x, [r.change for r in history], 2 * channel + 1)
        colour = colours().curves
        self.legend.setText(
            " &nbsp;".join(
                f'<span style="color:{colour[number % len(colour)]}">●</span> {name}'
                for number, name in self._numbers.items()
            )
        )
        if self._noise_norm is not None and self._histories:
            pen = pg.mkPen(colours().dim, style=Qt.PenStyle.DashLine)
            self.plot.addItem(pg.InfiniteLine(0.0, angle=0, pen=pen))  # log10 of 1

    def _add(self, name: str, x: Any, values: list[float], number: int) -> None:
        """Draw one curve of what is known and can be drawn on a logarithmic axis."""
        y = np.array(values)
        known = np.isfinite(y) & (y > 0)
        if known.any():
            self.curves[name] = self.plot.plot(x[known], y[known], pen=curve_pen(number))
            self._numbers[number] = name
