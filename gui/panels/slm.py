"""The SLM: what is on it, load, blank, look-up table."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QTimer
from PySide6.QtWidgets import (
    QCheckBox,
    QHBoxLayout,
    QLabel,
    QLineEdit,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from gui.jobs import BusyError
from gui.panel import Panel
from gui.session import BenchSession
from gui.widgets.dialogues import choose_path, elided
from gui.widgets.image_view import ImageView
from gui.widgets.plot import curve_pen, plot_widget, restyle
from instrument.files.errors import BenchError
from instrument.files.slm_image import SlmCorrection, load_slm_correction, read_slm_image, show_levels

_LOOK_MS = 500
_IMAGES = "Phase pictures (*.png *.tif *.tiff *.bmp *.npy)"


class SlmPanel(Panel):
    """Shows what the SLM shows; loads 8-bit phase pictures through the look-up table."""

    title = "SLM"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.view = ImageView("grey")
        self.view.setToolTip("Grey levels on the SLM now, 0 to 255")
        self.now = QLabel("–")
        self.file = QLineEdit()
        self.file.setPlaceholderText("phase picture, 8 bit, 256 levels a turn")
        self.file.setToolTip("A picture of the SLM's own size; Enter shows it")
        self.file.returnPressed.connect(self.load)
        self.browse_button = QPushButton("…")
        self.browse_button.setToolTip("Choose a picture")
        self.browse_button.clicked.connect(self._browse)
        self.load_button = QPushButton("Show")
        self.load_button.setToolTip("Put the picture on the SLM, through the look-up table")
        self.load_button.clicked.connect(self.load)
        self.blank_button = QPushButton("Blank")
        self.blank_button.setToolTip("All pixels to grey level 0")
        self.blank_button.clicked.connect(self.blank)
        self.table_file = QLineEdit()
        self.table_file.setPlaceholderText("look-up table: calibration.json from calibrate slm")
        self.table_file.setToolTip("What calibrate slm wrote; Enter reads it")
        self.table_file.returnPressed.connect(self.load_table)
        self.table_button = QPushButton("…")
        self.table_button.setToolTip("Choose an SLM calibration")
        self.table_button.clicked.connect(self._browse_table)
        self.use_table = QCheckBox("apply look-up table and flatness")
        self.use_table.setToolTip("What is shown next goes through the SLM's calibration")
        self.use_table.setEnabled(False)
        self.correction: SlmCorrection | None = None
        self.table_plot = plot_widget("level", "phase", y_unit="rad")
        self.table_plot.setMaximumHeight(130)
        self.table_plot.hide()
        self._shown: npt.NDArray[np.uint8] | None = None
        self._what = ""
        first = QHBoxLayout()
        first.addWidget(self.file, 1)
        first.addWidget(self.browse_button)
        first.addWidget(self.load_button)
        first.addWidget(self.blank_button)
        second = QHBoxLayout()
        second.addWidget(self.table_file, 1)
        second.addWidget(self.table_button)
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.now)
        layout.addWidget(self.view, 1)
        layout.addLayout(first)
        layout.addLayout(second)
        layout.addWidget(self.use_table)
        layout.addWidget(self.table_plot)
        session.device_changed.connect(self._device_changed)
        self._timer = QTimer(self)
        self._timer.timeout.connect(self.look)
        self._timer.start(_LOOK_MS)
        self._device_changed("slm")

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that show the picture in the field."""
        path = self.session.config.path
        table = self.table_file.text() if self.use_table.isChecked() else ""
        return (
            "from pathlib import Path\n\n"
            "from instrument.bench.bench import open_bench\n"
            "from instrument.files.slm_image import load_slm_correction, show_levels\n"
            "from instrument.files.slm_image import read_slm_image\n\n"
            f"correction = {f'load_slm_correction(Path({table!r}))' if table else None}\n"
            f"with open_bench({str(path) if path else None!r}) as bench:\n"
            f"    levels, _ = read_slm_image({self.file.text() or 'phase.png'!r})\n"
            "    show_levels(bench.slm, levels, correction)\n"
            '    input("Enter ends. ")\n'
        )

    def shutdown(self) -> None:
        """End the timer."""
        self._timer.stop()

    def theme_changed(self) -> None:
        """Take over the theme's colours."""
        restyle(self.table_plot)

    # What is on it -------------------------------------------------------------------------------
    def look(self) -> None:
        """Show what is on the SLM, whoever put it there."""
        slm = self.session.bench.slm
        if not self.isVisible() or slm is None or not self.session.is_open("slm"):
            return
        levels = slm.displayed
        if self._shown is not None and np.array_equal(levels, self._shown):
            return
        self._shown = levels.copy()
        self.view.show_image(self._shown, 0, 255)
        height, width = levels.shape
        what = "blank" if not levels.any() else self._what or "a picture"
        elided(self.now, f"{what}   {width} × {height}, levels {levels.min()} to {levels.max()}")

    def _device_changed(self, kind: str) -> None:
        if kind != "slm":
            return
        is_open = self.session.is_open("slm")
        for widget in (self.load_button, self.blank_button):
            widget.setEnabled(is_open)
        self._shown = None
        if not is_open:
            self.view.clear()
            state = self.session.state("slm")
            has_one = "slm" in self.session.kinds
            elided(self.now, state.text or state.condition if has_one else "This bench has no SLM.")

    # What the operator does ----------------------------------------------------------------------
    def load(self) -> None:
        """Put the picture in the field on the SLM."""
        slm, path = self.session.bench.slm, Path(self.file.text().strip()).expanduser()
        correction = self.correction if self.use_table.isChecked() else None
        if slm is None:
            return

        def work(_: object) -> str:
            levels, _facts = read_slm_image(path)
            show_levels(slm, levels, correction)
            return path.name + (" through the look-up table" if correction else "")

        self._start(f"SLM: {path.name}", work, self.file)

    def blank(self) -> None:
        """Show all zeros."""
        slm = self.session.bench.slm
        if slm is None:
            return

        def work(_: object) -> str:
            slm.blank()
            return "blank"

        self._start("SLM: blank", work, None)

    def load_table(self) -> None:
        """Read the look-up table in the field, show it, and use it from now on."""
        try:
            self.correction = load_slm_correction(Path(self.table_file.text().strip()).expanduser())
        except BenchError as error:
            self.correction = None
            self.use_table.setChecked(False)
            self.use_table.setEnabled(False)
            self.table_plot.hide()
            self.refused(self.table_file, str(error))
            return
        self.accepted(self.table_file)
        self.use_table.setEnabled(True)
        self.use_table.setChecked(True)
        self.table_plot.clear()
        self.table_plot.plot(np.arange(256), self.correction.phase_of_level_rad, pen=curve_pen(0))
        self.table_plot.show()

    def _start(self, title: str, work: object, field: QWidget | None) -> None:
        try:
            job = self.session.device_job(title, work, {"slm"})  # type: ignore[arg-type]
        except BusyError as error:
            self.refused(field, str(error))
            return
        job.failed.connect(lambda why: self.refused(field, why))
        job.succeeded.connect(lambda what: self._done(cast(str, what), field))

    def _done(self, what: str, field: QWidget | None) -> None:
        self._what, self._shown = what, None
        self.accepted(field)
        self.look()

    def _browse(self) -> None:
        def chosen(path: Path) -> None:
            self.file.setText(str(path))
            self.load()

        choose_path(self.file, "open", "Phase picture", self.file.text(), chosen, _IMAGES)

    def _browse_table(self) -> None:
        def chosen(path: Path) -> None:
            self.table_file.setText(str(path))
            self.load_table()

        filters = "Calibration (*.json)"
        choose_path(self.table_file, "open", "SLM calibration", self.table_file.text(), chosen, filters)
