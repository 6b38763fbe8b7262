"""A window that is dragged over a picture, for what is in it to be measured."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import pyqtgraph as pg
from PySide6.QtCore import QObject, QPointF, QRectF, Signal
from PySide6.QtWidgets import QGraphicsRectItem

from gui.theme import colours
from gui.widgets.image_view import ImageView
from gui.words import quantity
from recon.arrays import Array

_BAR_SHARE = 0.25
"""Of a view's width, about: its scale bar."""


class Region(NamedTuple):
    """Rows and columns of a picture."""

    rows: slice
    columns: slice

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    @property
    def words(self) -> str:
        """Where it is."""
        height, width = self.shape
        return f"{width} x {height} at {self.columns.start}, {self.rows.start}"


def region_words(region: Region, shown: Array, shape: tuple[int, int], pitch_um: float | None) -> str:
    """Return how large a region is, and what is in it.

    ``shown`` may be a smaller level of the picture, whose own ``shape`` is that of the region's pixels.
    """
    height, width = region.shape
    size = f"{region.words} pixels"
    if pitch_um is not None:
        size += f" ({quantity(width * pitch_um, 'um')} x {quantity(height * pitch_um, 'um')})"
    rows, columns = (
        slice(int(one.start * n / whole), max(int(one.stop * n / whole), int(one.start * n / whole) + 1))
        for one, n, whole in zip((region.rows, region.columns), shown.shape, shape, strict=False)
    )
    inside = shown[rows, columns]
    return (
        f"{size}: mean {inside.mean():.4g}, deviation {inside.std():.3g}, "
        f"least {inside.min():.4g}, most {inside.max():.4g}"
    )


def round_length(most: float) -> float:
    """Return the largest of 1, 2 and 5 times powers of ten that is at most a length."""
    power = 10.0 ** math.floor(math.log10(max(most, 1e-9)))
    return max(step * power for step in (1, 2, 5) if step * power <= most * (1 + 1e-9))


class LengthBar:
    """A bar of a round length over a view, where the size of its pixels is known.

    Parameters
    ----------
    view : ImageView
    """

    def __init__(self, view: ImageView) -> None:
        self._words = ""
        self.bar: Any = pg.ScaleBar(1.0)
        self.bar.setParentItem(view.box)
        self.bar.anchor((1, 1), (1, 1), offset=(-14, -14))
        self.bar.hide()

    def place(self, width: int, pitch_um: float | None) -> None:
        """Lay it over a picture of this width in pixels of this size; take it away where that is None."""
        self.bar.setVisible(pitch_um is not None)
        if pitch_um is not None:
            length = round_length(_BAR_SHARE * width * pitch_um)
            self.bar.size = length / pitch_um
            self._words = quantity(length, "um")
            self.restyle()
            self.bar.updateBar()

    def restyle(self) -> None:
        """Take over the theme's accent, which is seen on a black picture and beside it."""
        now = colours().accent
        self.bar.bar.setBrush(pg.mkBrush(now))
        self.bar.bar.setPen(pg.mkPen(now))
        self.bar.text.setText(self._words, color=now)


class Measure(QObject):
    """Lets regions be dragged over a view, one or several, and draws them.

    Parameters
    ----------
    view : ImageView
    several : bool
        Whether a new one keeps those before.

    Signals
    -------
    chosen : Region
        The one that is dragged, again and again while it is.
    """

    chosen = Signal(object)

    def __init__(self, view: ImageView, *, several: bool = False) -> None:
        super().__init__(view)
        self._view, self._several = view, several
        self._items: list[QGraphicsRectItem] = []
        self._start: QPointF | None = None
        self.regions: list[Region] = []

    def set_on(self, on: bool) -> None:
        """Let dragging choose regions, or move the picture as usual."""
        self._view.drag_taker = self._dragged if on else None
        if not on:
            self.clear()

    def clear(self) -> None:
        """Take all regions away."""
        for item in self._items:
            self._view.box.removeItem(item)
        self._items, self.regions, self._start = [], [], None

    def set_colours(self, names: list[str]) -> None:
        """Draw the regions in these colours."""
        for item, name in zip(self._items, names, strict=False):
            item.setPen(pg.mkPen(name, width=2))

    def _dragged(self, start: QPointF, now: QPointF) -> None:
        if (region := self._region(start, now)) is None:
            return
        if start != self._start:
            self._start = start
            if not self._several:
                self.clear()
                self._start = start
            item: Any = QGraphicsRectItem()
            item.setPen(pg.mkPen(colours().accent, width=2))
            self._view.box.addItem(item, ignoreBounds=True)
            self._items.append(item)
            self.regions.append(region)
        self.regions[-1] = region
        height, width = region.shape
        self._items[-1].setRect(QRectF(region.columns.start, region.rows.start, width, height))
        self.chosen.emit(region)

    def _region(self, start: QPointF, now: QPointF) -> Region | None:
        """Return the whole pixels between two places, at least one; None outside of the picture."""
        width, height = self._view.extent
        (left, right), (top, bottom) = (
            sorted((int(min(max(a, 0), most - 1)), int(min(max(b, 0), most - 1))))
            for a, b, most in ((start.x(), now.x(), width), (start.y(), now.y(), height))
        )
        if self._view.image is None:
            return None
        return Region(slice(top, bottom + 1), slice(left, right + 1))
