"""The SLM: what is on it, load, blank, look-up table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from PySide6.QtWidgets import QCheckBox, QWidget

from gui.background import NewestOnly
from gui.panel import DevicePanel, on_bench
from gui.session import BenchSession
from gui.widgets.building import button, fill, in_row, label
from gui.widgets.dialogues import elided, path_field
from gui.widgets.image_view import ImageView
from gui.widgets.plots import curve_pen, plot_widget
from instrument.files.slm_image import SlmCorrection, load_slm_correction, read_slm_image, show_levels
from recon.base.as_python import Imports, expression

_IMAGES = "Phase pictures (*.png *.tif *.tiff *.bmp *.npy)"


class SlmPanel(DevicePanel):
    """Shows what the SLM shows; loads 8-bit phase pictures through the look-up table."""

    kind = "slm"
    look_ms = 500

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.view = ImageView("grey", name="Phase on the SLM")
        self.view.setToolTip("Grey levels on the SLM now, 0 to 255")
        self.now = label("–", wraps=True)
        self.file, self.browse_button = path_field(
            "phase picture, 8 bit, 256 levels a turn",
            "A picture of the SLM's own size",
            self.load,
            filters=_IMAGES,
        )
        tip = "Put the picture on the SLM, through the look-up table"
        self.load_button = button("Show", tip, self.load)
        self.blank_button = button("Blank", "All pixels to grey level 0", self.blank)
        self.table_file, self.table_button = path_field(
            "look-up table: calibration.json of an SLM calibration",
            "The calibration.json that the SLM calibration wrote (Sweeps)",
            self.load_table,
            filters="Calibration (*.json)",
        )
        self.use_table = QCheckBox("apply look-up table and flatness")
        self.use_table.setToolTip("What is shown next goes through the SLM's calibration")
        self.use_table.setEnabled(False)
        self.correction: SlmCorrection | None = None
        self.table_plot = plot_widget("level", "phase", y_unit="rad")
        self.table_plot.setMaximumHeight(130)
        self.table_plot.hide()
        self._shown: npt.NDArray[np.uint8] | None = None
        self._what = ""
        self._reader = NewestOnly(
            self.jobs, "Reading the look-up table", lambda why: self.refused(self.table_file, why)
        )
        fill(
            self.body,
            self.now,
            (self.view, 1),
            in_row((self.file, 1), self.browse_button, self.load_button, self.blank_button),
            in_row((self.table_file, 1), self.table_button),
            self.use_table,
            self.table_plot,
        )
        self.watch_device(self.now)

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that show the picture in the field."""
        module = "instrument.files.slm_image"
        imports = Imports(
            {(module, "load_slm_correction"), (module, "read_slm_image"), (module, "show_levels")}
        )
        table = Path(self.table_file.text()) if self.use_table.isChecked() else None
        loaded = "None" if table is None else f"load_slm_correction({expression(table, imports)})"
        lines = [
            f"levels, _ = read_slm_image({self.file.text() or 'phase.png'!r})",
            "show_levels(bench.slm, levels, correction)",
            'input("Enter ends. ")',
        ]
        return on_bench(self.session.config.path, lines, imports, [f"correction = {loaded}"])

    def take(self, what: Path) -> None:
        """Put a picture's name into the field; a click shows it."""
        self.file.setText(str(what))
        self.load_button.setFocus()

    # What is on it -------------------------------------------------------------------------------
    def look(self) -> None:
        """Show what is on the SLM, whoever put it there."""
        slm = self.session.bench.slm
        if slm is None or not self.is_ready:
            return
        levels = slm.displayed
        if self._shown is not None and np.array_equal(levels, self._shown):
            return
        self._shown = levels.copy()
        self.view.show_image(self._shown, 0, 255)
        height, width = levels.shape
        what = "blank" if not levels.any() else self._what or "a picture"
        elided(self.now, f"{what}   {width} × {height}, levels {levels.min()} to {levels.max()}")

    def show_device(self, is_open: bool) -> None:
        """Let it be used, or not."""
        for widget in (self.load_button, self.blank_button):
            widget.setEnabled(is_open)
        self._shown = None
        if not is_open:
            self.view.clear()

    # What the operator does ----------------------------------------------------------------------
    def load(self) -> None:
        """Put the picture in the field on the SLM."""
        slm, path = self.session.bench.slm, Path(self.file.text().strip()).expanduser()
        correction = self.correction if self.use_table.isChecked() else None
        if slm is None:
            return
        if self._reader.is_reading:
            self.refused(self.table_file, "The look-up table is still being read.")
            return

        def work(_: object) -> None:
            levels, _facts = read_slm_image(path)
            show_levels(slm, levels, correction)
            through = " through the look-up table" if correction else ""
            self._what, self._shown = f"{path.name}{through}", None

        self.command(f"SLM: {path.name}", work, self.file)

    def blank(self) -> None:
        """Show all zeros."""
        slm = self.session.bench.slm
        if slm is not None:
            self.command("SLM: blank", lambda _: slm.blank())

    def load_table(self) -> None:
        """Read the look-up table in the field, show it, and use it from now on."""
        path = Path(self.table_file.text().strip()).expanduser()
        self._use_table(None)
        self._reader.forget()
        self._reader.ask(lambda: load_slm_correction(path), self._use_table)

    def _use_table(self, correction: SlmCorrection | None) -> None:
        self.correction = correction
        self.use_table.setEnabled(correction is not None)
        self.use_table.setChecked(correction is not None)
        self.table_plot.setVisible(correction is not None)
        if correction is not None:
            self.accepted(self.table_file)
            self.table_plot.clear()
            self.table_plot.plot(np.arange(256), correction.phase_of_level_rad, pen=curve_pen(0))
