"""The mask's alignment: spots, score against hypothesis, displacement left, pose with error bars."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QButtonGroup,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QSplitter,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from calibration_routines.display.display_io import SpotLook
from calibration_routines.display.mask_alignment import AlignmentReport
from calibration_routines.procedure import Outcome
from gui.forms.routines import forms
from gui.procedure_panel import ProcedurePanel
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.alignment_plots import DisplacementPlot, PoseView
from gui.widgets.image_view import ImageView
from gui.widgets.plot import curve_pen, plot_widget, restyle

_TRIED = {
    "shift_x": "shift x (mask pixels)",
    "shift_y": "shift y (mask pixels)",
    "roll_mrad": "rotation (mrad)",
    "scale": "scale error",
    "z_um": "distance (um)",
}
_BRIGHTEST = 99.95  # percentile: spots are few


class AlignmentPanel(ProcedurePanel):
    """Alignment of the scattering mask."""

    title = "Alignment"
    handed_to = "holograms"
    use_words = "Compute holograms with it…"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        self.spots = ImageView()
        self.spot_words = QLabel("No picture yet.")
        self.spot_words.setObjectName("dim")
        self.spot_words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.score: Any = plot_widget("hypothesis", "spot / ideal")
        self.progress: Any = plot_widget("frames with spots", "brightest spot / ideal")
        self.before = DisplacementPlot("Before")
        self.after = DisplacementPlot("After")
        self.pose = PoseView()
        super().__init__(session, forms("align"), "Align", parent)
        self._older: Any = self.score.plot([], [])
        self._points: Any = self.score.plot([], [])
        self._best: Any = self.progress.plot([], [])
        self._rings: Any = pg.ScatterPlotItem()
        self.spots.box.addItem(self._rings)
        self.now_button, self.before_button = QPushButton("Now"), QPushButton("Before")
        self.now_button.setToolTip("The newest picture of spots")
        self.before_button.setToolTip("The first picture of spots, before anything was known")
        which = QButtonGroup(self)
        which.setExclusive(True)
        for button in (self.now_button, self.before_button):
            button.setCheckable(True)
            which.addButton(button)
        self.now_button.setChecked(True)
        which.buttonClicked.connect(lambda _: self._show_spots())
        layout = QVBoxLayout(self.right)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._arrange())
        self._first: SpotLook | None = None
        self._newest: SpotLook | None = None
        self._tried = ""
        self._scores: list[list[tuple[float, float]]] = []
        self._brightest: list[float] = []
        self.run.look.connect(self._looked_at)
        self.theme_changed()

    def began(self) -> None:
        """Clear the last alignment."""
        self._first = self._newest = None
        self._scores, self._brightest, self._tried = [], [], ""
        self.spots.clear()
        self.before.clear()
        self.after.clear()
        self.pose.clear()
        self._draw_plots()

    def finished(self, outcome: Outcome) -> None:
        """Show what was found."""
        report = outcome.result
        if isinstance(report, AlignmentReport):
            self.before.show_field(report.found_at.displacement(report.mask_shape), report.mask_shape)
            self.after.show_field(report.displacement(report.mask_shape), report.mask_shape)
            self.pose.show_report(report)
            self.tabs.setCurrentIndex(1)

    def theme_changed(self) -> None:
        """Restyle the plots."""
        for plot in (self.score, self.progress):
            restyle(plot)
        for field in (self.before, self.after):
            field.restyle()
        self.pose.restyle()
        self._draw_plots()

    # Inside --------------------------------------------------------------------------------------
    def _arrange(self) -> QWidget:
        picture = QWidget()
        column = QVBoxLayout(picture)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.spots, 1)
        foot = QHBoxLayout()
        foot.addWidget(self.spot_words, 1)
        foot.addWidget(self.before_button)
        foot.addWidget(self.now_button)
        column.addLayout(foot)
        plots = QSplitter()
        plots.addWidget(self.score)
        plots.addWidget(self.progress)
        search = QSplitter(Qt.Orientation.Vertical)
        search.addWidget(picture)
        search.addWidget(plots)
        search.setSizes([340, 240])
        search.setChildrenCollapsible(False)
        fields = QSplitter(Qt.Orientation.Vertical)
        fields.addWidget(self.before.plot)
        fields.addWidget(self.after.plot)
        self.tabs = QTabWidget()
        self.tabs.setDocumentMode(True)
        self.tabs.addTab(search, "Spots and scores")
        self.tabs.addTab(fields, "Displacement")
        self.tabs.addTab(self.pose, "Pose")
        return self.tabs

    def _looked_at(self, look: SpotLook) -> None:
        self._newest = look
        self._first = self._first or look
        if not look.of_whole_slm:  # sections' spots are another measure
            self._show_spots()
            return
        tried = _tried_most(look)
        if tried != self._tried:
            self._tried, self._scores = tried, []
        poses = [spot.pose for spot in look.spots]
        if tried:
            self._scores.append(
                [(float(getattr(p, tried)), float(b)) for p, b in zip(poses, look.brightness, strict=True)]
            )
        self._brightest.append(float(look.brightness.max()))
        self._draw_plots()
        self._show_spots()

    def _show_spots(self) -> None:
        look = self._first if self.before_button.isChecked() else self._newest
        if look is None:
            return
        # The square root shows spots and the speckle around them together.
        shown = np.sqrt(np.maximum(look.frame, 0.0))
        self.spots.show_image(shown, 0.0, float(max(np.percentile(shown, _BRIGHTEST), 1e-9)))
        best = int(np.argmax(look.brightness))
        ring, warning = pg.mkPen(colours().accent, width=1), pg.mkPen(colours().warning, width=2)
        pens = [warning if n == best else ring for n in range(len(look.spots))]
        self._rings.setData(x=look.columns + 0.5, y=look.rows + 0.5, size=14, brush=None, pen=pens)
        brightest = (
            f", the brightest at {look.brightness[best]:.0%} of the ideal" if look.of_whole_slm else ""
        )
        self.spot_words.setText(f"{len(look.spots)} spots{brightest}")
        self.spot_words.setToolTip("Each spot is a hypothesis about the mask's pose")

    def _draw_plots(self) -> None:
        dots = {"symbol": "o", "symbolSize": 5, "symbolPen": None}
        accent, dim = pg.mkBrush(colours().accent), pg.mkBrush(colours().line)
        older = [point for points in self._scores[:-1] for point in points]
        for curve, points, brush in (
            (self._older, older, dim),
            (self._points, self._scores[-1] if self._scores else [], accent),
        ):
            x, y = np.array(points, float).reshape(-1, 2).T
            curve.setData(x, y, pen=None, symbolBrush=brush, **dots)
        self.score.setLabel("bottom", _TRIED.get(self._tried, "hypothesis"))
        taken = np.arange(1, len(self._brightest) + 1)
        self._best.setData(taken, np.array(self._brightest), pen=curve_pen(), symbolBrush=accent, **dots)


def _tried_most(look: SpotLook) -> str:
    """Return the parameter that takes the most values in a picture; empty where none differs."""
    values = {name: {getattr(spot.pose, name) for spot in look.spots} for name in _TRIED}
    best = max(_TRIED, key=lambda name: len(values[name]))
    return best if len(values[best]) > 1 else ""
