"""Views of results: what is known of one, its picture, how the solver converged, a grid of views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from types import MappingProxyType
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QSignalBlocker, Qt
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QCheckBox, QGridLayout, QTextBrowser, QWidget

from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.building import button, choice, fill, in_row, label
from gui.widgets.image_view import ImageView
from gui.widgets.orientation import OrientationButton, follow_orientation
from gui.widgets.plots import LevelsBar, curve_pen, legend, plot_widget
from gui.words import quantity
from instrument.files.orientation import AS_IT_IS, Orientation
from recon.arrays import Float32Array
from recon.solvers.base import IterationRecord

_GAP_PX = 10
_MOST_OF_NAMES = 0.4
"""Of the width of facts: where names would take more, they stand above their values."""


class FactsView(QTextBrowser):
    """Names and values, warnings in plain words above them; a narrow one has each name above its value."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setOpenLinks(False)
        self.setMinimumSize(120, 60)
        self.setPlaceholderText("Facts about a result.")
        self.setAccessibleName("Facts about the result")
        self.setToolTip("What is known of the result: the verdict, how it was made; can be copied")
        self._shown: tuple[Sequence[tuple[str, str]], Sequence[str], bool] = ((), (), False)
        self._stacked = False
        """Whether each name stands above its value."""

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        facts, warnings, simulated = self._shown
        self.show_facts(facts, warnings, simulated=simulated)

    def show_facts(
        self, facts: Sequence[tuple[str, str]], warnings: Sequence[str] = (), *, simulated: bool = False
    ) -> None:
        """Show warnings and facts; SIMULATED where it came from the simulated bench."""
        self._shown = facts, warnings, simulated
        now = colours()
        parts = []
        if simulated:
            parts.append(f'<p style="color:{now.warning}"><b>SIMULATED</b></p>')
        parts += [f'<p style="color:{now.warning}">Warning: {escape(text)}</p>' for text in warnings]
        self._stacked = self._is_narrow()
        name_style = f'style="color:{now.dim};padding-right:{_GAP_PX}px"'
        between = "</td></tr><tr><td>" if self._stacked else "</td><td>"
        rows = "".join(
            f"<tr><td {name_style}>{escape(name)}{between}{escape(value)}</td></tr>" for name, value in facts
        )
        self.setHtml("".join([*parts, f"<table>{rows}</table>" if rows else ""]))

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Put names beside or above their values, as there is room."""
        super().resizeEvent(event)
        if self._stacked != self._is_narrow():
            self.restyle()

    def _is_narrow(self) -> bool:
        """Whether names beside their values would take too much of the width."""
        names_px = max((self.fontMetrics().horizontalAdvance(name) for name, _ in self._shown[0]), default=0)
        return names_px + _GAP_PX > _MOST_OF_NAMES * self.viewport().width()


class PictureView(QWidget):
    """Shows one picture, (height, width) or (height, width, 3), or what was found beside it."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.picture: Float32Array | None = None
        self.beside: dict[str, Float32Array] = {}
        self.orientation = AS_IT_IS
        self.pitch_um: float | None = None
        self.image = _ScaledImage()
        self.levels = LevelsBar()
        self.levels.changed.connect(self._show)
        tip = "Turn and mirror pictures, exports alike; on the sensor's grid a scene stands upside down."
        self.turn = OrientationButton(session, "results", tip)
        tip = "Show the whole picture (the wheel zooms, dragging moves)"
        self.whole = button("Whole", tip, self.image.whole)
        tip = (
            "The picture, its pixels' standard deviation (95 % intervals are plus and minus 1.96 of it), or "
            "what is left of the photograph, in units of its noise"
        )
        self.which = choice(("Picture",), tip, lambda _: self._chosen())
        self.which.setVisible(False)
        self.image.setMinimumSize(70, 50)
        self.hovered = self.image.hovered
        fill(self, (self.image, 1), in_row(self.which, None, self.whole, self.turn), self.levels)
        follow_orientation(session, "results", self._orient)

    @property
    def shown(self) -> Float32Array | None:
        """The picture, or what is shown instead, as it is turned now."""
        values = self._values
        return None if values is None else self.orientation.apply(values)

    @property
    def _values(self) -> Float32Array | None:
        return self.beside.get(self.which.currentText(), self.picture)

    def show_picture(
        self,
        picture: Float32Array,
        *,
        pitch_um: float | None = None,
        keep_levels: bool = False,
        beside: Mapping[str, Float32Array | None] = MappingProxyType({}),
    ) -> None:
        """Show a picture and what goes with it; ``pitch_um``: a pixel's size in the object's plane."""
        self.picture = picture
        self.beside = {name: values for name, values in beside.items() if values is not None}
        with QSignalBlocker(self.which):
            self.which.clear()
            self.which.addItems(["Picture", *self.beside])
        self.which.setVisible(bool(self.beside))
        self.image.pitch_um = pitch_um
        self.levels.set_image(picture, keep_levels=keep_levels)
        self._show()

    def _chosen(self) -> None:
        if (values := self._values) is not None:
            self.levels.set_image(values)
            self._show()

    def _orient(self, orientation: Orientation) -> None:
        self.orientation = orientation
        self._show()

    def _show(self) -> None:
        if (shown := self.shown) is not None:
            self.image.set_colour_map(self.levels.colour_map)
            self.image.show_image(shown, *self.levels.levels)


class _ScaledImage(ImageView):
    """An image whose places under the mouse are also given in micrometres from the middle."""

    def __init__(self) -> None:
        super().__init__()
        self.pitch_um: float | None = None

    def describe(self, column: int, row: int) -> str:
        """Return a pixel's place and value in words."""
        words = super().describe(column, row)
        if self.pitch_um is None or self.image is None:
            return words
        height, width = self.image.shape[:2]
        x_um, y_um = ((p - n // 2) * self.pitch_um for p, n in ((column, width), (row, height)))
        return f"{words}   ({quantity(x_um, 'um', 3)}, {quantity(y_um, 'um', 3)} from the middle)"


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
        self.legend = label(role="dim", wraps=True)
        self.legend.setMinimumWidth(10)
        self.against_time = QCheckBox("seconds")
        self.against_time.setToolTip("Horizontal axis: wall seconds of the solver instead of iterations")
        self.against_time.toggled.connect(self._draw)
        self.curves: dict[str, Any] = {}
        self._numbers: dict[int, str] = {}
        self._histories: Histories = ()
        self._noise_norm: float | None = None
        fill(
            self,
            in_row((self.legend, 1), self.against_time),
            (self.plot, 1),
            margins=(8, 0, 0, 0),
            spacing=0,
        )
        self._draw()

    def show_histories(self, histories: Histories, noise_norm: float | None) -> None:
        """Draw histories; ``noise_norm`` is the expected norm of the noise in the residuals' units."""
        self._histories, self._noise_norm = histories, noise_norm
        self._draw()

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
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
        self.legend.setText(legend(self._numbers) or "How it was solved is drawn here.")
        for part in (self.plot, self.against_time):  # an empty plot's numbers would mean nothing
            part.setVisible(bool(self.curves))
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


_HEADING_PX = 22
_SPACING_PX = 6


class ViewGrid(QWidget):
    """Arranges views anew whenever its own size changes.

    Parameters
    ----------
    views : sequence of (str, QWidget)
        Headings and views, in reading order.
    """

    def __init__(self, views: Sequence[tuple[str, QWidget]], parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._cells: list[QWidget] = []
        for title, view in views:
            heading = label(title, "heading", yields=True)
            heading.setContentsMargins(_SPACING_PX, 0, 2 * _SPACING_PX, 0)
            heading.setFixedHeight(_HEADING_PX)
            self._cells.append(fill(QWidget(), heading, (view, 1), spacing=0))
        self._layout = QGridLayout(self)
        self._layout.setContentsMargins(0, 0, 0, 0)
        self._layout.setSpacing(_SPACING_PX)
        self.columns = 0
        self._arrange(2)

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Choose the number of columns for the new size."""
        super().resizeEvent(event)
        self._arrange(best_columns(len(self._cells), self.width(), self.height()))

    def _arrange(self, columns: int) -> None:
        if columns == self.columns:
            return
        self.columns = columns
        for index in range(max(self._layout.columnCount(), self._layout.rowCount())):
            self._layout.setColumnStretch(index, 0)
            self._layout.setRowStretch(index, 0)
        for index, cell in enumerate(self._cells):
            self._layout.addWidget(cell, index // columns, index % columns)
            self._layout.setRowStretch(index // columns, 1)
            self._layout.setColumnStretch(index % columns, 1)


def best_columns(count: int, width: int, height: int) -> int:
    """Return in how many columns so many square views are largest in an area, in pixels."""

    def side(columns: int) -> float:
        rows = -(-count // columns)
        return min(width / columns, height / rows - _HEADING_PX)

    return max(range(1, count + 1), key=side)
