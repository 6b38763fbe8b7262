"""Calibration routines and plans: form, planned path, progress, last frame, quality per PSF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import Qt
from PySide6.QtGui import QPixmap
from PySide6.QtWidgets import QLabel, QSizePolicy, QSplitter, QTabWidget, QVBoxLayout, QWidget

from calibration_routines import Photograph, SweepCalibration
from calibration_routines.procedure import Outcome, Outlook
from calibration_routines.psf.sweep_watch import PointTaken
from gui.forms.routines import PLAN, forms
from gui.procedure_panel import ProcedurePanel
from gui.procedure_run import Situation
from gui.session import BenchSession
from gui.widgets.dialogues import elided
from gui.widgets.image_view import ImageView
from gui.widgets.sweep_views import PathPlot, Picture, PsfPictures, PsfTable
from instrument.bench.photograph import Snapshot
from instrument.files.errors import BenchError, FileError, count
from instrument.plan.model import load_plan, plan_toml

Image = npt.NDArray[Any]
_LEVELS = (0.1, 99.9)
"""Percentiles that frames are stretched to."""


class SweepsPanel(ProcedurePanel):
    """Sweeps and plans."""

    title = "Sweeps"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        self.path = PathPlot()
        self.frame = ImageView()
        self.frame_words = QLabel("No frame yet.")
        self.frame_words.setObjectName("dim")
        self.frame_words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.psfs = PsfTable()
        self.picture = Picture()
        super().__init__(session, [*forms(), PLAN], "Start", parent)
        shown = QWidget()
        column = QVBoxLayout(shown)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.frame, 1)
        column.addWidget(self.frame_words)
        self.tabs = QTabWidget()
        self.tabs.setDocumentMode(True)
        self.tabs.addTab(self.psfs, "Quality of PSFs")
        self.tabs.addTab(self.picture, "Result")
        above = QSplitter()
        above.addWidget(self.path)
        above.addWidget(shown)
        above.setSizes([560, 420])
        above.setChildrenCollapsible(False)
        split = QSplitter(Qt.Orientation.Vertical)
        split.addWidget(above)
        split.addWidget(self.tabs)
        split.setSizes([360, 400])
        split.setChildrenCollapsible(False)
        layout = QVBoxLayout(self.right)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(split)
        self._shown: Snapshot | None = None
        self._pictures = PsfPictures()
        self.run.judged.connect(self._heard)
        self.psfs.chosen.connect(self._show_psf)
        self.views["plan"].changed.connect(self._read_plan)
        self._plan_file: Path | None = None

    def show_outlook(self, outlook: Outlook) -> None:
        """Draw the path besides the words."""
        super().show_outlook(outlook)
        self.path.show_path(outlook.path)

    def show_problem(self, error: BenchError) -> None:
        """Take the path away besides saying why."""
        super().show_problem(error)
        self.path.clear("No path: this cannot be carried out as it stands.")

    def began(self) -> None:
        """Clear the last sweep."""
        self.psfs.clear()
        self.picture.clear()
        self._pictures = PsfPictures()
        self.tabs.setCurrentWidget(self.psfs)

    def looked(self, now: Situation) -> None:
        """Show the newest frame and where the run is."""
        self.path.show_now(now.place)
        if now.newest is not None and now.newest is not self._shown:
            self._shown = now.newest
            self._show_frame(now.newest)

    def finished(self, outcome: Outcome) -> None:
        """Show the last judgement, or the routine's picture."""
        if isinstance(outcome.result, SweepCalibration):
            self.psfs.show_all(outcome.result.quality)
        if isinstance(outcome.result, Photograph):
            self._show_image(outcome.result.measurement)
            self.frame_words.setText("The photograph, dark frames taken off")
        pictures = [file for file in outcome.files if file.suffix == ".png"]
        if pictures:
            self.picture.show_pixmap(QPixmap(str(pictures[0])))
            self.tabs.setCurrentWidget(self.picture)

    def theme_changed(self) -> None:
        """Restyle the plots."""
        self.path.restyle()
        self.psfs.restyle()

    def _heard(self, event: object) -> None:
        if isinstance(event, PointTaken):
            self._pictures.keep(event.number - 1, event.image)
            self.psfs.arrived(event)

    def _show_psf(self, row: int) -> None:
        quality = self.psfs.qualities[row] if 0 <= row < len(self.psfs.qualities) else None
        picture = self._pictures.get(row)
        if quality is None or picture is None:
            return
        self._show_image(picture.image)
        x_mm, y_mm, z_mm = (value / 1e3 for value in quality.source_um)
        self.frame_words.setText(
            f"PSF {row + 1} at ({x_mm:.4g}, {y_mm:.4g}, {z_mm:.4g}) mm, dark frame taken off"
            + (f"; reduced {picture.reduced}x, whole in the run" if picture.reduced > 1 else "")
        )

    def _show_frame(self, newest: Snapshot) -> None:
        metadata = newest.metadata
        full_scale = (1 << metadata.significant_bits) - 1
        self._show_image(newest.image, full_scale)
        words = [f"Last frame: {metadata.exposure_ms:.4g} ms", f"light {metadata.led_pattern or 'unknown'}"]
        if metadata.saturated_fraction:
            pixels = round(metadata.saturated_fraction * newest.image.size)
            words.append(f"SATURATED: {count(max(pixels, 1), 'pixel')}")
        elided(self.frame_words, ", ".join(words))

    def _show_image(self, image: Image, full_scale: int | None = None) -> None:
        low, high = np.percentile(image[::4, ::4], _LEVELS)
        self.frame.show_image(image, float(low), float(max(high, low + 1)), full_scale)

    def _read_plan(self) -> None:
        """Show the plan of a file that was chosen."""
        view = self.views["plan"]
        values = view.values()
        file = None if values is None else values["file"]
        if file == self._plan_file:
            return
        self._plan_file = file
        if file is None or not file.is_file():
            return
        try:
            text = file.read_text() if file.suffix == ".toml" else plan_toml(load_plan(file))
        except (FileError, UnicodeDecodeError, OSError) as error:
            view.refuse("file", str(error))
            return
        view.set_values({"text": text})
