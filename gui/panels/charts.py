"""Charts: where methods fail, and speed against accuracy, from files that the commands write."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QSignalBlocker, Qt
from PySide6.QtWidgets import QStackedWidget, QWidget

from gui.jobs import Job
from gui.panel import Panel
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.building import Hint, button, cell, choice, fill, in_row, label, offer, split, table, tabs
from gui.widgets.dialogues import choose_path
from gui.widgets.plots import curve_colour, curve_pen, dots, plot_widget
from gui.widgets.stability_view import StabilityView
from instrument.evaluation.chart import ChartData, read_chart, subject_of
from instrument.files.errors import FileError
from instrument.files.stability_file import read_stability
from recon.base.as_python import Imports, expression
from recon.evaluation.scored import KINDS, Axis, Point, is_known, pareto
from recon.verdict.cases import SHIPPED

_TO_THE_MINUTE = len("2026-01-01T00:00")
_NO_CHART = "No chart is open: one shows which settings are fast, and which are accurate, on your photograph."


class ChartsPanel(Panel):
    """Stability maps of a ``stability.json``, and the points of a ``chart.json``."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.maps_path = SHIPPED
        self.chart_path: Path | None = None

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        session = self.session
        self.stability = StabilityView()
        yield
        make = partial(session.handed_on.emit, "tasks", ("chart photograph", {}))
        self.chart = ChartView()
        yield from self.chart.parts(Hint(_NO_CHART, "Make one…", make, ("Open…", self._choose)))
        yield
        tip = "A stability.json or chart.json, made in Files (a chart, a map) or in the terminal"
        self.open_button = button("Open…", tip, self._choose)
        tip = "The maps that come with the program, by which verdicts are made"
        self.shipped_button = button("Shipped maps", tip, lambda: self.open(SHIPPED))
        self.heading = label()
        self.heading.setMinimumWidth(10)
        self._headings = {self.stability: ("", ""), self.chart: ("", "")}
        self.tabs = tabs({"Where methods fail": self.stability, "Speed against accuracy": self.chart})
        self.tabs.currentChanged.connect(lambda _: self._show_heading())
        top = in_row((self.heading, 1), self.open_button, self.shipped_button)
        fill(self.body, top, (self.tabs, 1))
        yield
        self.open(self.maps_path)

    def take(self, what: Any) -> None:
        """Show the maps or the chart that another panel hands on."""
        self.open(Path(what))

    def open(self, path: Path) -> Job:
        """Show the maps or the chart of a file, whichever it holds."""
        job = self.follow(self.jobs.compute(f"Opening {path.name}", lambda _: _read(path)))
        job.succeeded.connect(lambda record: self._opened(path, record))
        return job

    def _opened(self, path: Path, record: dict[str, Any] | ChartData) -> None:
        self.accepted()
        if not isinstance(record, ChartData):
            self.maps_path = path
            made = f"{record['utc'][:_TO_THE_MINUTE].replace('T', ' ')} UTC"
            said = f"{path.name}, made {made} by {record['program']} (SIMULATED scenes)"
            self._headings[self.stability] = (said, f"{path}\n{record['command']}")
            self.stability.show_maps(record["maps"])
            self.tabs.setCurrentWidget(self.stability)
        else:
            self.chart_path = path
            about = record.about
            said = f"{subject_of(record.kind_name, about)}{' (SIMULATED)' if about.get('simulated') else ''}"
            left_out = [f"{name}: {why}" for name, why in record.failed.items()]
            left_out += [f"{name}: no time" for name in record.missing]
            if left_out:
                said += f"; {len(left_out)} settings could not be run or had no time"
            self._headings[self.chart] = (said, "\n".join([str(path), *left_out]))
            self.chart.show_points(record.points, record.kind_name)
            self.tabs.setCurrentWidget(self.chart)
        self._show_heading()

    def _show_heading(self) -> None:
        view = self.stability if self.tabs.currentWidget() is self.stability else self.chart
        text, tip = self._headings[view]
        self.heading.setText(text)
        self.heading.setToolTip(tip)

    def _choose(self) -> None:
        start = str(self.session.runs_folder)
        choose_path(self, "open", "Open maps or a chart", start, self.open, "Maps and charts (*.json)")

    def as_python(self) -> str:
        """Return lines that draw the map that is shown, or read the chart."""
        if self.tabs.currentWidget() is self.chart and self.chart_path is not None:
            imports = Imports({("instrument.evaluation.chart", "read_chart")})
            key = self.chart.key
            lines = [
                f"points = read_chart({expression(self.chart_path, imports)}).points",
                f"ranked = sorted((p for p in points if p.{key} == p.{key}), key=lambda p: p.{key})",
            ]
        else:
            imports = Imports(
                {
                    ("instrument.files.figures", "save_figure"),
                    ("instrument.evaluation.figures", "map_figure"),
                    ("instrument.files.stability_file", "read_stability"),
                }
            )
            name = str(self.stability.map.currentData())
            lines = [
                f"maps = read_stability({expression(self.maps_path, imports)})['maps']",
                f"save_figure(map_figure(maps[{name!r}]), {expression(Path(f'{name}.png'), imports)})",
            ]
        return "\n".join([*imports.lines(), "", *lines, ""])


def _read(path: Path) -> dict[str, Any] | ChartData:
    """Read stability maps, or a chart; FileError where it is neither."""
    try:
        return read_stability(path)
    except FileError as no_maps:
        try:
            return read_chart(path)
        except FileError as no_chart:
            if "holds no stability maps" in no_maps.problem:
                raise FileError(path, "holds neither stability maps nor a chart.", no_chart.remedy) from None
            raise no_maps from None


_EVEN_STEPS = 5
"""On an axis that is too short for ticks at 1, 2 and 5, at most."""
_NEAR_PX = 12.0
_ROW_PX = 38
"""Two lines: settings differ by their ends."""
_SHORT = {"seconds": "seconds", "peak_mib": "MiB", "images": "photographs"}
"""Costs as a column's heading."""


class ChartView(QWidget):
    """A plot of scored points and a table of settings; pointing at either names the other.

    It is there once its ``parts`` are made.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._points: Sequence[Point] = ()
        self._kind = KINDS["reconstruction"]

    def parts(self, empty: QWidget) -> Iterator[None]:
        """Make the widgets; ``empty`` stands here until there are points."""
        self.measure = choice((), "What is compared", lambda _: self._draw())
        self.cost = choice((), "What it is compared against", lambda _: self._draw())
        self.group = choice((), "Only these settings compete with each other", lambda _: self._draw())
        self.plot: Any = plot_widget("")
        self.plot.setLogMode(x=True)
        self.plot.scene().sigMouseMoved.connect(self._moved)
        yield
        tip = "Settings by their best score; one that is chosen is drawn bold"
        self.table = table(["", "", ""], tip, wide=0, row_px=_ROW_PX)
        self.table.setTextElideMode(Qt.TextElideMode.ElideMiddle)  # settings differ by their ends
        self.table.verticalHeader().hide()
        self.table.itemSelectionChanged.connect(self._setting_chosen)
        words = "The bold line is the front (●): no setting is both cheaper and better."
        self.place = label(words, "dim", selectable=True)
        self.front: list[Point] = []
        yield
        chosen = in_row(label("Compare"), self.measure, label("against"), self.cost, self.group, None)
        drawn = split(self.plot, self.table, sizes=[620, 330])
        self.stack = QStackedWidget()
        self.stack.addWidget(empty)
        self.stack.addWidget(fill(QWidget(), chosen, (drawn, 1), self.place))
        fill(self, (self.stack, 1))

    def show_points(self, points: Sequence[Point], kind: str = "reconstruction") -> None:
        """Show points of a chart of a kind (:data:`recon.evaluation.scored.KINDS`)."""
        self._points, self._kind = points, KINDS[kind]
        self.stack.setCurrentIndex(1)

        def known(axes: Sequence[Axis]) -> list[tuple[str, str]]:
            return [(a.words, a.key) for a in axes if any(is_known(p, a.key) for p in points)]

        groups = list(dict.fromkeys(p.group for p in points))
        self.group.setVisible(len(groups) > 1)
        offer(self.measure, known(self._kind.scores))
        offer(self.cost, known(self._kind.costs))
        offer(self.group, [(group, group) for group in groups])
        self._draw()

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
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
    def _known(self) -> list[Point]:
        """Return what can be drawn; costs stand on a logarithmic axis."""
        group, cost = self.group.currentData() or "", self.cost_key
        here = [p for p in self._points if p.group == group and is_known(p, self.key) and is_known(p, cost)]
        return [p for p in here if getattr(p, cost) > 0]

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
        known = self._known()
        self.front = pareto(known, score, cost)
        sign = -1.0 if score.more_is_better else 1.0
        best: dict[str, Point] = {}
        for point in sorted(known, key=lambda p: sign * getattr(p, score.key)):
            best.setdefault(point.setting, point)
        on_front = {p.setting for p in self.front}
        with QSignalBlocker(self.table):
            self.table.setHorizontalHeaderLabels(["setting", score.words.split(" (")[0], _SHORT[cost.key]])
            self.table.setRowCount(len(best))
            for number, (name, point) in enumerate(best.items()):
                value, spent = getattr(point, score.key), getattr(point, cost.key)
                mark = "● " if name in on_front else ""
                tip = f"{name}, on the front" if mark else name
                figures = (f"{figure:#.{digits}g}".rstrip(".") for figure, digits in ((value, 4), (spent, 3)))
                for place, text in enumerate((f"{mark}{name}", *figures)):
                    self.table.setItem(number, place, cell(text, tip, number=place > 0, data=name))
        self.plot.setLabel("left", score.words)
        self.plot.setLabel("bottom", cost.words)
        self._draw_curves()

    def _setting_chosen(self) -> None:
        """Draw the chosen setting bold, and describe its best point."""
        self._draw_curves()
        chosen = self.table.selectedItems()
        if chosen:
            name = chosen[0].data(Qt.ItemDataRole.UserRole)
            mine = [p for p in self._known() if p.setting == name]
            score = self._axes()[1]
            best = (max if score.more_is_better else min)(mine, key=lambda p: getattr(p, score.key))
            self.place.setText(describe(best, self._kind.name))

    def _draw_curves(self) -> None:
        self.plot.clear()
        chosen = {item.data(Qt.ItemDataRole.UserRole) for item in self.table.selectedItems()}
        known = self._known()
        for number, name in enumerate(dict.fromkeys(p.setting for p in known)):
            bold = name in chosen
            look = dots(curve_colour(number), 8 if bold else 4)
            line = sorted(self._place(p) for p in known if p.setting == name)
            self.plot.plot(*np.array(line).T, pen=curve_pen(number, 3.0 if bold else 1.0), **look)
        if known:
            self.plot.getAxis("bottom").setTicks([_ticks([self._place(p)[0] for p in known])])
        if self.front:
            front = [self._place(p) for p in self.front]
            pen = pg.mkPen(colours().text, width=2.5)
            self.plot.plot(*np.array(_steps(front)).T, pen=pen)
            self.plot.plot(*np.array(front).T, pen=None, **(dots(None, 11) | {"symbolPen": pen}))

    def _place(self, point: Point) -> tuple[float, float]:
        """Return cost and score of a point."""
        return getattr(point, self.cost_key), getattr(point, self.key)

    def _moved(self, place: Any) -> None:
        nearest, distance = None, _NEAR_PX
        box = self.plot.getPlotItem().vb
        for point in self._known():
            spent, value = self._place(point)
            at = box.mapViewToScene(pg.Point(math.log10(spent), value))
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
    """Return places on a logarithmic axis, with their words: 1, 2 and 5 times powers of ten.

    Where fewer than two of those lie among the costs, even steps do, and a single cost is its own place.
    """
    low, high = min(costs), max(costs)
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    values = [step * 10.0**power for power in range(first, last + 1) for step in (1, 2, 5)]
    if sum(low <= value <= high for value in values) < 2:
        values = [low]
        if high > low:
            apart = (high - low) / _EVEN_STEPS
            power = 10.0 ** math.floor(math.log10(apart))
            step = next(step * power for step in (1, 2, 5, 10) if step * power >= apart)
            values = [number * step for number in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return [(math.log10(value), f"{value:.6g}") for value in values]


def describe(point: Point, kind: str = "reconstruction") -> str:
    """Return a point in words."""
    count = point.iterations
    said = [point.setting, f"{point.seconds:.3g} s", f"{count} iterations" if count else "one shot"]
    if is_known(point, "images"):
        said.append(f"{point.images:.0f} photographs")
    for axis in KINDS[kind].scores:
        if is_known(point, axis.key):
            said.append(f"{axis.words} {getattr(point, axis.key):.4g}")
    if is_known(point, "peak_mib"):
        said.append(f"memory {point.peak_mib:.0f} MiB")
    return ", ".join(said)
