"""Views with headings, in as many columns as shows square ones largest."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QGridLayout, QLabel, QVBoxLayout, QWidget

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
            cell = QWidget()
            label = QLabel(title)
            label.setProperty("role", "heading")
            label.setFixedHeight(_HEADING_PX)
            box = QVBoxLayout(cell)
            box.setContentsMargins(0, 0, 0, 0)
            box.setSpacing(0)
            box.addWidget(label)
            box.addWidget(view, 1)
            self._cells.append(cell)
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
