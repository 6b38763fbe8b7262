"""Stability maps: where a method fails, cell by cell, with every method's boundary over it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QPen, QTransform
from PySide6.QtWidgets import QGraphicsItem, QGraphicsRectItem, QGraphicsSimpleTextItem, QWidget

from gui.theme import colours, contrast, luminance
from gui.widgets.building import choice, fill, in_row, label, offer
from gui.widgets.image_view import ArrowKeys
from gui.widgets.plots import curve_pen, legend, plot_widget
from instrument.evaluation.figures import boundary_lines, label_of, ticks_of
from recon.arrays import Float64Array
from recon.verdict.map import Failure

_SPAN = 1.0
"""The colours reach from a tenth of the severity at the boundary to ten times of it."""
_STRENGTH = 0.75
"""Of the colours: figures are read on them."""
_PATCH_ALPHA = 190
"""Of a figure's ground over the boundaries, out of 255: they are seen through it, dimly."""


class StabilityView(QWidget):
    """One map of a ``stability.json``: a method's cells in colour, the boundaries of all as lines."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._maps: Mapping[str, Any] = {}
        self.map = choice((), "Which two stresses are varied", lambda _: self._choose_map())
        tip = "Whose cells are coloured; the lines are the boundaries of all methods"
        self.method = choice((), tip, lambda _: self._draw())
        self.question = label(selectable=True, wraps=True)
        self.place = label(_hint(), "dim", wraps=True)
        self.legend = label(wraps=True)
        self.plot: Any = plot_widget(grid=False)
        self.plot.setMouseEnabled(x=False, y=False)
        self.image: Any = pg.ImageItem()
        self.plot.scene().sigMouseMoved.connect(self._moved)
        self.cell = (0, 0)
        """Column and row of the cell that was described last, from the lower left."""
        self.keys = ArrowKeys(self.plot, "Cells of the stability map")
        self.keys.entered.connect(lambda: self._step(0, 0))
        self.keys.moved.connect(self._step)
        self._cursor = QGraphicsRectItem()
        self._cursor.setZValue(3)
        self._cursor.hide()
        self.keys.left.connect(self._cursor.hide)
        self.boundaries: dict[str, list[Float64Array]] = {}
        """The lines of each method's, across and up in cells."""
        fill(
            self,
            in_row((self.map, 2), (self.method, 1)),
            self.question,
            (self.plot, 1),
            self.legend,
            self.place,
        )

    def show_maps(self, maps: Mapping[str, Any]) -> None:
        """Show the maps of a ``stability.json``, by name."""
        self._maps = maps
        offer(self.map, [(record["title"], name) for name, record in maps.items()])
        self._choose_map()

    @property
    def record(self) -> Mapping[str, Any] | None:
        """The map that is shown."""
        name = self.map.currentData()
        return None if name is None else self._maps[name]

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        self.place.setText(_hint())
        self._draw()

    def _choose_map(self) -> None:
        methods = [] if self.record is None else self.record["methods"]
        offer(self.method, [(name, name) for name in methods])
        self._draw()

    def _draw(self) -> None:
        self.plot.clear()
        self.boundaries = {}
        record, name = self.record, self.method.currentText()
        if record is None or not name:
            return
        self.question.setText(f"{record['question']} ({record['size']} map)")
        methods = record["methods"]
        severity = _grid(methods[name]["severity"])
        level = np.log10(np.maximum(severity, 1e-2))
        cells = _coloured(level)
        self.image.setImage(cells, levels=(0, 255))
        self.image.setRect(-0.5, -0.5, severity.shape[1], severity.shape[0])
        self.plot.addItem(self.image)
        self._cursor.setPen(pg.mkPen(colours().text, width=2))
        self.plot.addItem(self._cursor, ignoreBounds=True)
        self._write_errors(_grid(methods[name]["error"]), cells)
        for number, (other, method) in enumerate(methods.items()):
            self.boundaries[other] = boundary_lines(_grid(method["severity"]))
            self._draw_boundary(number, self.boundaries[other], chosen=other == name)
        names = [f"{other}{'' if lines else ' (none here)'}" for other, lines in self.boundaries.items()]
        self.legend.setText(f"Boundaries: {legend(dict(enumerate(names)))}")
        for side, which in (("bottom", "x"), ("left", "y")):
            self.plot.setLabel(side, label_of(record[which]))
            self.plot.getAxis(side).setTicks([list(enumerate(ticks_of(record[which])))])
        rows, columns = severity.shape
        self.plot.setXRange(-0.5, columns - 0.5, padding=0.01)
        self.plot.setYRange(-0.5, rows - 0.5, padding=0.01)

    def _write_errors(self, errors: Float64Array, cells: npt.NDArray[np.uint8]) -> None:
        figures = QGraphicsRectItem()  # holds what pyqtgraph's own texts take five times as long for
        for (iy, ix), error in np.ndenumerate(errors):
            if np.isfinite(error):
                ground = "#{:02x}{:02x}{:02x}".format(*cells[iy, ix])
                patch = QGraphicsRectItem(figures)  # dims boundaries under the figure
                text = QGraphicsSimpleTextItem(f"{error:.2f}", patch)
                text.setBrush(QColor(max((colours().window, colours().text), key=partial(contrast, ground))))
                size = text.boundingRect()
                patch.setRect(size)
                patch.setPen(QPen(Qt.PenStyle.NoPen))
                shade = QColor(ground)
                shade.setAlpha(_PATCH_ALPHA)
                patch.setBrush(shade)
                patch.setFlag(QGraphicsItem.GraphicsItemFlag.ItemIgnoresTransformations)
                patch.setTransform(QTransform.fromTranslate(-size.width() / 2, -size.height() / 2))
                patch.setPos(ix, iy)
        figures.setZValue(2)  # above the boundaries
        self.plot.addItem(figures, ignoreBounds=True)

    def _draw_boundary(self, number: int, lines: Sequence[Float64Array], *, chosen: bool) -> None:
        if not lines:
            return
        gap = np.full((1, 2), np.nan)
        across, up = np.concatenate([part for line in lines for part in (line, gap)]).T
        # Not as a PlotDataItem, which takes three times as long.
        pen = curve_pen(number, 4.0 if chosen else 2.0)
        self.plot.addItem(pg.PlotCurveItem(across, up, pen=pen, connect="finite"), ignoreBounds=True)

    def _moved(self, place: Any) -> None:
        point = self.plot.getPlotItem().vb.mapSceneToView(place)
        self.place.setText(self.describe(round(point.x()), round(point.y())))

    def _step(self, across: float, down: float) -> None:
        """Tell of the next cell in the direction of an arrow key."""
        record = self.record
        if record is None:
            return
        steps = [0 if not by else (1 if by > 0 else -1) for by in (across, -down)]
        sizes = len(record["x"]["values"]), len(record["y"]["values"])
        ix, iy = (min(max(c + s, 0), n - 1) for c, s, n in zip(self.cell, steps, sizes, strict=True))
        self.cell = ix, iy
        self._cursor.setRect(ix - 0.5, iy - 0.5, 1, 1)
        self._cursor.show()
        self.place.setText(self.describe(ix, iy))

    def describe(self, ix: int, iy: int) -> str:
        """Return a cell in words; empty outside of the map."""
        record = self.record
        if record is None:
            return ""
        x, y = record["x"], record["y"]
        if not (0 <= ix < len(x["values"]) and 0 <= iy < len(y["values"])):
            return ""
        said = [f"{_stress(x, ix)}, {_stress(y, iy)}"]
        for name, method in record["methods"].items():
            severity, error = method["severity"][iy][ix], method["error"][iy][ix]
            if severity is None:
                said.append(f"{name}: not made")
                continue
            failure = method["failure"][iy][ix]
            words = f"fails ({Failure[failure.upper()]})" if failure else "works"
            value = "" if error is None else f", {record['error']} {error:.3g}"
            said.append(f"{name}: {words}{value}, severity {severity:.2f}")
        return ";  ".join(said)


def _grid(rows: Sequence[Sequence[float | None]]) -> Float64Array:
    return np.array([[np.nan if v is None else v for v in row] for row in rows], float)


def _hint() -> str:
    fails, works = ("Bright", "dim") if colours().red_light_only else ("Red", "green")
    boundary = "dark" if luminance(colours().window) < 0.5 else "pale"
    return (
        f"{fails} fails, {works} works, {boundary} is the boundary; numbers are errors. Point at a cell, "
        "or go there by arrow keys, for more."
    )


def _coloured(level: Float64Array) -> npt.NDArray[np.uint8]:
    """Return (rows, columns, 3): green or dim works, red or bright fails, dark at the boundary."""
    now = colours()
    good = now.line if now.red_light_only else now.ok
    works, middle, fails = (pg.mkColor(c).getRgb()[:3] for c in (good, now.window, now.error))
    share = np.clip(np.nan_to_num(level) / _SPAN, -1, 1)[..., None]
    end = np.where(share < 0, np.array(works, float), np.array(fails, float))
    shown = np.array(middle, float) + np.abs(share) * _STRENGTH * (end - np.array(middle, float))
    shown[~np.isfinite(level)] = pg.mkColor(now.line).getRgb()[:3]
    pixels: npt.NDArray[np.uint8] = np.round(shown).astype(np.uint8)
    return pixels


def _stress(axis: Mapping[str, Any], index: int) -> str:
    return f"{axis['label']} {ticks_of(axis)[index]} {axis['unit']}".rstrip()
