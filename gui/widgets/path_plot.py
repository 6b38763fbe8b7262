"""Where a plan goes: seen from the side and along the axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtWidgets import QHBoxLayout, QLabel, QSizePolicy, QWidget

from gui.theme import colours
from gui.widgets.plot import plot_widget, restyle

Place = Mapping[str, float]

_SHOWN = {"um": ("mm", 1e-3)}
"""Lengths are shown in millimetres."""
_MOST_SYMBOLS = 3000


class PathPlot(QWidget):
    """Draws places one after the other, the first one marked, and where the run is now.

    With lateral and axial motion there are two views: depth across, and along the axis.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._layout = QHBoxLayout(self)
        self._layout.setContentsMargins(0, 0, 0, 0)
        self.nothing = QLabel("Nothing moves.")
        self.nothing.setObjectName("dim")
        self.nothing.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self._layout.addWidget(self.nothing)
        self.views: list[_View] = []
        self.places: tuple[Place, ...] = ()
        self.setMinimumHeight(140)

    def show_path(self, places: Sequence[Place]) -> None:
        """Draw a path; an empty one says that nothing moves."""
        places = tuple(places)
        if places == self.places:
            return
        self.places = places
        pairs = _pairs(places)
        if [view.axes for view in self.views] != pairs:
            for view in self.views:
                self._layout.removeWidget(view.plot)
                view.plot.deleteLater()
            self.views = [_View(*pair) for pair in pairs]
            for view in self.views:
                self._layout.addWidget(view.plot)
        self.nothing.setVisible(not self.views)
        self.nothing.setText("Nothing moves." if not places else "The source goes to one place and stays.")
        for view in self.views:
            view.draw(places)

    def clear(self, words: str) -> None:
        """Show no path, and why."""
        self.show_path(())
        self.nothing.setText(words)

    def show_now(self, place: Place | None) -> None:
        """Mark where the run is."""
        for view in self.views:
            view.mark(place)

    def restyle(self) -> None:
        """Take over another theme."""
        for view in self.views:
            restyle(view.plot)
            view.draw(self.places)


class _View:
    """One plot of two axes of the path."""

    def __init__(self, across: str, down: str) -> None:
        self.axes = across, down
        labels = [_label(name) for name in self.axes]
        self.plot: Any = plot_widget(labels[0][0], labels[1][0], x_unit=labels[0][1], y_unit=labels[1][1])
        self._scales = [_scale(name) for name in self.axes]
        self._line: Any = self.plot.plot([], [])
        self._first: Any = self.plot.plot([], [])
        self._now: Any = self.plot.plot([], [])

    def draw(self, places: Sequence[Place]) -> None:
        x, y = self._values(places)
        symbols = {"symbol": "o", "symbolSize": 5} if len(places) <= _MOST_SYMBOLS else {"symbol": None}
        dim, ok, warning = colours().dim, colours().ok, colours().warning
        accent = pg.mkBrush(colours().accent)
        self._line.setData(x, y, pen=pg.mkPen(dim, width=1), symbolBrush=accent, symbolPen=None, **symbols)
        start = {"symbol": "s", "symbolSize": 10, "symbolBrush": None}
        self._first.setData(x[:1], y[:1], pen=None, symbolPen=pg.mkPen(ok, width=2), **start)
        here = {"symbol": "o", "symbolSize": 13, "symbolBrush": None}
        self._now.setData([], [], pen=None, symbolPen=pg.mkPen(warning, width=2), **here)
        self.plot.autoRange()

    def mark(self, place: Place | None) -> None:
        if place is None or not all(name in place for name in self.axes):
            self._now.setData([], [])
            return
        x, y = self._values([place])
        self._now.setData(x, y)

    def _values(self, places: Sequence[Place]) -> list[Any]:
        return [
            np.array([place.get(name, 0.0) * scale for place in places])
            for name, scale in zip(self.axes, self._scales, strict=True)
        ]


def _pairs(places: Sequence[Place]) -> list[tuple[str, str]]:
    """Return the axes of each view: those that change, depth across."""
    names = sorted({name for place in places for name in place})
    moving = [n for n in names if len({place.get(n) for place in places}) > 1]
    if not moving:
        return []
    lateral = [n for n in moving if n in ("x_um", "y_um")]
    if "z_um" in moving:
        side = ("z_um", lateral[0] if lateral else "x_um")
        return [side, ("x_um", "y_um")] if len(lateral) == 2 else [side]
    if lateral:
        return [("x_um", "y_um")]
    other = [n for n in names if n != moving[0]]
    return [(moving[0], (moving[1:] or other or moving)[0])]


def _label(name: str) -> tuple[str, str]:
    axis, _, unit = name.rpartition("_")
    return axis, _SHOWN.get(unit, (unit, 1.0))[0]


def _scale(name: str) -> float:
    return _SHOWN.get(name.rpartition("_")[2], ("", 1.0))[1]
