"""A displacement field over the mask, as arrows."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg

from gui.theme import colours
from gui.widgets.plot import plot_widget, restyle

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
