"""Plots in the program's looks."""

from __future__ import annotations

from typing import Any

import pyqtgraph as pg

from gui.theme import colours

# Images are (row, column) here as everywhere else in the project.
pg.setConfigOptions(imageAxisOrder="row-major", antialias=True)


def plot_widget(
    x_label: str = "", y_label: str = "", *, x_unit: str = "", y_unit: str = "", grid: bool = True
) -> Any:
    """Return a ``pyqtgraph.PlotWidget`` in the theme's colours, with labelled axes.

    pyqtgraph has no type annotations, hence ``Any``.
    """
    plot = pg.PlotWidget()
    restyle(plot)
    plot.setLabel("bottom", _label(x_label, x_unit))
    plot.setLabel("left", _label(y_label, y_unit))
    plot.showGrid(x=grid, y=grid, alpha=0.15)
    plot.setMenuEnabled(False)
    for axis in ("bottom", "left"):
        plot.getAxis(axis).enableAutoSIPrefix(False)  # units are in the labels as people here say them
    return plot


def restyle(plot: Any) -> None:
    """Give a plot the colours of the theme in use."""
    now = colours()
    plot.setBackground(now.panel)
    for axis in ("bottom", "left"):
        plot.getAxis(axis).setPen(now.line)
        plot.getAxis(axis).setTextPen(now.dim)


def curve_pen(number: int = 0, width: float = 1.5) -> Any:
    """Return the pen of the ``number``-th curve of a plot."""
    names = colours().curves
    return pg.mkPen(names[number % len(names)], width=width)


def _label(text: str, unit: str) -> str:
    return f"{text} ({unit})" if unit else text
