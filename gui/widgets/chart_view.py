"""Cost against accuracy: every setting's score as it goes, and the front that no other beats."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QAbstractItemView,
    QComboBox,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QSplitter,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)

from gui.theme import colours
from gui.widgets.plot import curve_pen, plot_widget, restyle
from recon.evaluation.scored import KINDS, Axis

ScoredPoint = Mapping[str, Any]
_NEAR_PX = 12.0
_SHORT = {"seconds": "seconds", "peak_mib": "MiB", "images": "photographs"}
"""Costs as a column's heading."""


class ChartView(QWidget):
    """A plot of scored points and a table of settings; pointing at either names the other."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._points: Sequence[ScoredPoint] = ()
        self._kind = KINDS["reconstruction"]
        self.measure = QComboBox()
        self.measure.setToolTip("What is compared")
        self.cost = QComboBox()
        self.cost.setToolTip("What it is compared against")
        self.group = QComboBox()
        self.group.setToolTip("Only these settings compete with each other")
        for box in (self.measure, self.cost, self.group):
            box.currentIndexChanged.connect(lambda _: self._draw())
        self.plot: Any = plot_widget("")
        self.plot.setLogMode(x=True)
        self.plot.scene().sigMouseMoved.connect(self._moved)
        self.table = QTableWidget(0, 3)
        self.table.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.table.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.table.verticalHeader().hide()
        header = self.table.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        self.table.setToolTip("Settings by their best score; one that is chosen is drawn bold")
        self.table.itemSelectionChanged.connect(self._setting_chosen)
        self.place = QLabel("The bold line is the front: no setting is both cheaper and better.")
        self.place.setProperty("role", "dim")
        self.place.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.front: list[ScoredPoint] = []
        self._curves: list[Any] = []
        split = QSplitter()
        split.addWidget(self.plot)
        split.addWidget(self.table)
        split.setSizes([620, 330])
        row = QHBoxLayout()
        row.addWidget(QLabel("Compare"))
        row.addWidget(self.measure)
        row.addWidget(QLabel("against"))
        row.addWidget(self.cost)
        row.addWidget(self.group)
        row.addStretch()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(row)
        layout.addWidget(split, 1)
        layout.addWidget(self.place)

    def show_points(self, points: Sequence[ScoredPoint], kind: str = "reconstruction") -> None:
        """Show points of a chart of a kind (:data:`recon.evaluation.scored.KINDS`), as JSON has them."""
        self._points, self._kind = points, KINDS[kind]

        def known(axes: Sequence[Axis]) -> dict[str, str]:
            return {a.words: a.key for a in axes if any(p.get(a.key) is not None for p in points)}

        groups = {str(g): str(g) for g in dict.fromkeys(p.get("group") or "" for p in points)}
        self.group.setVisible(len(groups) > 1)
        for box, items in (
            (self.measure, known(self._kind.scores)),
            (self.cost, known(self._kind.costs)),
            (self.group, groups),
        ):
            box.blockSignals(True)
            box.clear()
            for words, key in items.items():
                box.addItem(words, key)
            box.blockSignals(False)
        self._draw()

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        restyle(self.plot)
        self._draw_curves()

    @property
    def key(self) -> str:
        """The name of the score that is shown."""
        return str(self.measure.currentData())

    @property
    def cost_key(self) -> str:
        """The name of the cost that it is drawn against."""
        return str(self.cost.currentData())

    # Inside --------------------------------------------------------------------------------------
    def _known(self) -> list[ScoredPoint]:
        """Return what can be drawn; costs stand on a logarithmic axis."""
        group = self.group.currentData() or ""
        return [
            p
            for p in self._points
            if (p.get("group") or "") == group
            and p.get(self.key) is not None
            and (p.get(self.cost_key) or 0) > 0
        ]

    def _axes(self) -> tuple[Axis, Axis]:
        """Return the cost and the score that are shown."""
        cost = next(a for a in self._kind.costs if a.key == self.cost_key)
        return cost, next(a for a in self._kind.scores if a.key == self.key)

    def _draw(self) -> None:
        if not (self.measure.count() and self.cost.count()):
            self.front = []
            self.table.setRowCount(0)
            self.plot.clear()
            return
        cost, score = self._axes()
        words, more = score.words, score.more_is_better
        known = self._known()
        self.front = front_of(known, self.key, more_is_better=more, cost=cost.key)
        best: dict[str, ScoredPoint] = {}
        for point in known:
            held = best.get(point["setting"])
            if held is None or _better(point[self.key], held[self.key], more):
                best[point["setting"]] = point
        ranked = sorted(best.values(), key=lambda p: p[self.key], reverse=more)
        self.table.blockSignals(True)
        self.table.setHorizontalHeaderLabels(["setting", words.split(" (")[0], _SHORT[cost.key]])
        self.table.setRowCount(len(ranked))
        on_front = {p["setting"] for p in self.front}
        for number, point in enumerate(ranked):
            mark = "● " if point["setting"] in on_front else ""
            cells = (f"{mark}{point['setting']}", f"{point[self.key]:.4g}", f"{point[cost.key]:.3g}")
            for column, text in enumerate(cells):
                item = QTableWidgetItem(text)
                item.setData(Qt.ItemDataRole.UserRole, point["setting"])
                self.table.setItem(number, column, item)
        self.table.blockSignals(False)
        self.plot.setLabel("left", words)
        self.plot.setLabel("bottom", cost.words)
        self._draw_curves()

    def _setting_chosen(self) -> None:
        """Draw the chosen setting bold, and tell of its best point."""
        self._draw_curves()
        chosen = self.table.selectedItems()
        if chosen:
            name = chosen[0].data(Qt.ItemDataRole.UserRole)
            mine = [p for p in self._known() if p["setting"] == name]
            score = self._axes()[1]
            best = (max if score.more_is_better else min)(mine, key=lambda p: p[score.key])
            self.place.setText(describe(best, self._kind.name))

    def _draw_curves(self) -> None:
        self.plot.clear()
        chosen = {item.data(Qt.ItemDataRole.UserRole) for item in self.table.selectedItems()}
        known, at = self._known(), self.cost_key
        for number, name in enumerate(dict.fromkeys(p["setting"] for p in known)):
            mine = sorted((p for p in known if p["setting"] == name), key=lambda p: p[at])
            x, y = np.array([(p[at], p[self.key]) for p in mine], float).T
            bold = name in chosen
            colour = colours().curves[number % len(colours().curves)]
            self.plot.plot(
                x,
                y,
                pen=curve_pen(number, 3.0 if bold else 1.0),
                symbol="o",
                symbolSize=8 if bold else 4,
                symbolPen=None,
                symbolBrush=colour,
            )
        if known:
            self.plot.getAxis("bottom").setTicks([_ticks([p[at] for p in known])])
        if self.front:
            x, y = np.array(_steps([(p[at], p[self.key]) for p in self.front]), float).T
            pen = pg.mkPen(colours().text, width=2.5)
            self.plot.plot(x, y, pen=pen)
            x, y = np.array([(p[at], p[self.key]) for p in self.front], float).T
            self.plot.plot(x, y, pen=None, symbol="o", symbolSize=11, symbolPen=pen, symbolBrush=None)

    def _moved(self, place: Any) -> None:
        nearest, distance = None, _NEAR_PX
        box = self.plot.getPlotItem().vb
        for point in self._known():
            at = box.mapViewToScene(pg.Point(math.log10(point[self.cost_key]), point[self.key]))
            away = math.hypot(at.x() - place.x(), at.y() - place.y())
            if away < distance:
                nearest, distance = point, away
        if nearest is not None:
            self.place.setText(describe(nearest, self._kind.name))


def _steps(front: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the corners of a front: between two of its points the cheaper one is all there is."""
    placed = list(front[:1])
    for before, after in itertools.pairwise(front):
        placed += [(after[0], before[1]), after]
    return placed


def _ticks(costs: Sequence[float]) -> list[tuple[float, str]]:
    """Return places of 1, 2 and 5 times powers of ten on a logarithmic axis, with their words."""
    first, last = math.floor(math.log10(min(costs))), math.ceil(math.log10(max(costs)))
    values = [step * 10.0**power for power in range(first, last + 1) for step in (1, 2, 5)]
    return [(math.log10(value), f"{value:g}") for value in values]


def describe(point: ScoredPoint, kind: str = "reconstruction") -> str:
    """Return a point in words."""
    count = point["iterations"]
    said = [
        str(point["setting"]),
        f"{point['seconds']:.3g} s",
        f"{count} iterations" if count else "one shot",
    ]
    if point.get("images") is not None:
        said.append(f"{point['images']:.0f} photographs")
    for axis in KINDS[kind].scores:
        if point.get(axis.key) is not None:
            said.append(f"{axis.words} {point[axis.key]:.4g}")
    if point.get("peak_mib") is not None:
        said.append(f"memory {point['peak_mib']:.0f} MiB")
    return ", ".join(said)


def front_of(
    points: Sequence[ScoredPoint], key: str, *, more_is_better: bool, cost: str = "seconds"
) -> list[ScoredPoint]:
    """Return the points that no other is both cheaper and better than, the cheapest first."""
    sign = 1.0 if more_is_better else -1.0
    front: list[ScoredPoint] = []
    best = -math.inf
    for point in sorted(points, key=lambda p: (p[cost], -sign * p[key])):
        if sign * point[key] > best:
            front.append(point)
            best = sign * point[key]
    return front


def _better(value: float, than: float, more_is_better: bool) -> bool:
    return value > than if more_is_better else value < than
