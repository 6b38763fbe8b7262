"""Charts: where methods fail, and speed against accuracy, from files that the commands write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PySide6.QtWidgets import QHBoxLayout, QLabel, QPushButton, QTabWidget, QVBoxLayout, QWidget

from gui.jobs import Job
from gui.panel import Panel
from gui.session import BenchSession
from gui.widgets.chart_view import ChartView
from gui.widgets.dialogues import choose_path
from gui.widgets.stability_view import StabilityView
from instrument.evaluation.chart import read_chart, subject_of
from instrument.files.errors import FileError
from instrument.files.stability_file import read_stability
from recon.base.declare import expression
from recon.verdict.cases import SHIPPED

_NO_CHART = "No chart yet. Make one with diffuserbench chart, then open its chart.json."


class ChartsPanel(Panel):
    """Stability maps of a ``stability.json``, and the points of a ``chart.json``."""

    title = "Charts"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.maps_path = SHIPPED
        self.chart_path: Path | None = None
        self.stability = StabilityView()
        self.chart = ChartView()
        self.open_button = QPushButton("Open…")
        self.open_button.setToolTip("A stability.json or chart.json, made by the commands of those names")
        self.open_button.clicked.connect(self._choose)
        self.shipped_button = QPushButton("Shipped maps")
        self.shipped_button.setToolTip("The maps that come with the program, by which verdicts are made")
        self.shipped_button.clicked.connect(lambda: self.open(SHIPPED))
        self.heading = QLabel()
        self.heading.setMinimumWidth(10)
        self._headings = {self.stability: ("", ""), self.chart: (_NO_CHART, "")}
        self.tabs = QTabWidget()
        self.tabs.setDocumentMode(True)
        self.tabs.addTab(self.stability, "Where methods fail")
        self.tabs.addTab(self.chart, "Speed against accuracy")
        self.tabs.currentChanged.connect(lambda _: self._show_heading())
        row = QHBoxLayout()
        row.addWidget(self.heading, 1)
        row.addWidget(self.open_button)
        row.addWidget(self.shipped_button)
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(row)
        layout.addWidget(self.tabs, 1)
        self.open(self.maps_path)

    def open(self, path: Path) -> Job:
        """Show the maps or the chart of a file, whichever it holds."""
        job = self.tells(self.jobs.compute(f"Opening {path.name}", lambda _: _read(path)))
        job.succeeded.connect(lambda record: self._opened(path, record))
        return job

    def _opened(self, path: Path, record: dict[str, Any]) -> None:
        self.accepted()
        if "maps" in record:
            self.maps_path = path
            said = f"{path.name}, made {record['utc']} by {record['program']} (SIMULATED scenes)"
            self._headings[self.stability] = (said, f"{path}\n{record['command']}")
            self.stability.show_maps(record["maps"])
            self.tabs.setCurrentWidget(self.stability)
        else:
            self.chart_path = path
            about = record["about"]
            said = f"{subject_of(record['kind'], about)}{' (SIMULATED)' if about.get('simulated') else ''}"
            left_out = [f"{name}: {why}" for name, why in record.get("failed", {}).items()]
            left_out += [f"{name}: no time" for name in record.get("missing", ())]
            if left_out:
                said += f"; {len(left_out)} settings could not be run or had no time"
            self._headings[self.chart] = (said, "\n".join([str(path), *left_out]))
            self.chart.show_points(record["points"], record["kind"])
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

    def theme_changed(self) -> None:
        """Take over the theme's colours."""
        self.stability.restyle()
        self.chart.restyle()

    def as_python(self) -> str:
        """Return lines that draw the map that is shown, or read the chart."""
        if self.tabs.currentWidget() is self.chart and self.chart_path is not None:
            lines = [
                "from pathlib import Path",
                "",
                "from instrument.evaluation.chart import read_chart",
                "",
                f"points = read_chart({expression(self.chart_path)})['points']",
                f"ranked = sorted((p for p in points if p[{self.chart.key!r}] is not None), "
                f"key=lambda p: p[{self.chart.key!r}])",
                "",
            ]
            return "\n".join(lines)
        name = self.stability.map.currentData()
        return "\n".join(
            [
                "from pathlib import Path",
                "",
                "from instrument.files.figures import save_figure",
                "from instrument.evaluation.figures import map_figure",
                "from instrument.files.stability_file import read_stability",
                "",
                f"maps = read_stability({expression(self.maps_path)})['maps']",
                f"save_figure(map_figure(maps[{name!r}]), Path({f'{name}.png'!r}))",
                "",
            ]
        )


def _read(path: Path) -> dict[str, Any]:
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
