"""Charts: where methods fail, from the maps that come with the program or from maps of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PySide6.QtWidgets import QFileDialog, QHBoxLayout, QLabel, QPushButton, QVBoxLayout, QWidget

from gui.jobs import Job
from gui.panel import Panel
from gui.python_lines import expression
from gui.session import BenchSession
from gui.views.stability_view import StabilityView
from instrument.stability_file import read_stability
from recon.stability.shipped import shipped_file


class ChartsPanel(Panel):
    """Stability maps of a ``stability.json``."""

    title = "Charts"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.path = shipped_file()
        self.stability = StabilityView()
        self.open_button = QPushButton("Open…")
        self.open_button.setToolTip("Open a stability.json, made by diffuserbench stability")
        self.open_button.clicked.connect(self._choose)
        self.shipped_button = QPushButton("Shipped maps")
        self.shipped_button.setToolTip("The maps that come with the program, by which verdicts are made")
        self.shipped_button.clicked.connect(lambda: self.open(shipped_file()))
        self.heading = QLabel()
        self.heading.setMinimumWidth(10)
        row = QHBoxLayout()
        row.addWidget(self.heading, 1)
        row.addWidget(self.open_button)
        row.addWidget(self.shipped_button)
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(row)
        layout.addWidget(self.stability, 1)
        self.open(self.path)

    def open(self, path: Path) -> Job:
        """Show the maps of a file."""
        job = self.tells(self.jobs.compute(f"Opening {path.name}", lambda _: read_stability(path)))
        job.succeeded.connect(lambda record: self._opened(path, record))
        return job

    def _opened(self, path: Path, record: dict[str, Any]) -> None:
        self.accepted()
        self.path = path
        self.heading.setText(f"{path.name}, made {record['utc']} by {record['program']} (SIMULATED scenes)")
        self.heading.setToolTip(f"{path}\n{record['command']}")
        self.stability.show_maps(record["maps"])

    def _choose(self) -> None:
        chosen, _ = QFileDialog.getOpenFileName(
            self, "Open maps", str(self.session.runs_folder), "Stability maps (*.json)"
        )
        if chosen:
            self.open(Path(chosen))

    def theme_changed(self) -> None:
        """Take over the theme's colours."""
        self.stability.restyle()

    def as_python(self) -> str:
        """Return lines that read the file and draw the map that is shown."""
        name = self.stability.map.currentData()
        return "\n".join(
            [
                "from pathlib import Path",
                "",
                "from instrument.figures import save_figure",
                "from instrument.stability_figure import map_figure",
                "from instrument.stability_file import read_stability",
                "",
                f"maps = read_stability({expression(self.path)})['maps']",
                f"save_figure(map_figure(maps[{name!r}]), Path({f'{name}.png'!r}))",
                "",
            ]
        )
