"""The mask's alignment: spots, score against hypothesis, displacement left, pose with error bars."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtWidgets import QButtonGroup, QHeaderView, QWidget

from calibration_routines.display.mask_alignment import AlignmentReport
from calibration_routines.display.spot_camera import SpotLook
from calibration_routines.procedure import Outcome
from calibration_routines.routine import routines
from gui.procedure_panel import ProcedurePanel
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.building import button, cell, fill, in_row, label, split, table, tabs
from gui.widgets.image_view import ImageView
from gui.widgets.orientation import follow_orientation
from gui.widgets.plots import curve_pen, dots, plot_widget
from instrument.files.errors import percent
from recon.arrays import Float64Array
from recon.holography.pose import NAMES

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

    handed_to = "holograms"
    use_words = "Compute holograms with it…"

    @classmethod
    def prepare(cls) -> None:
        """Import the routines."""
        list(routines.values())

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        own = [routine for routine in routines.values() if routine.command == "align"]
        super().__init__(session, own, "Align", parent)

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        self.spots = ImageView(name="Newest picture of spots")
        follow_orientation(self.session, "frames", self.spots.orient)
        yield
        self.spot_words = label("No picture yet.", "dim", yields=True)
        self.score: Any = plot_widget("hypothesis", "spot / ideal")
        yield
        self.progress: Any = plot_widget("frames with spots", "brightest spot / ideal")
        yield
        self.before = DisplacementPlot("Before")
        yield
        self.after = DisplacementPlot("After")
        yield
        self.pose = PoseView()
        yield
        yield from super().parts()
        self._older: Any = self.score.plot([], [])
        self._points: Any = self.score.plot([], [])
        self._best: Any = self.progress.plot([], [])
        self._rings: Any = pg.ScatterPlotItem()
        self.spots.box.addItem(self._rings)
        self.now_button = button("Now", "The newest picture of spots", checkable=True)
        tip = "The first picture of spots, before anything was known"
        self.before_button = button("Before", tip, checkable=True)
        which = QButtonGroup(self)
        which.addButton(self.now_button)
        which.addButton(self.before_button)
        self.now_button.setChecked(True)
        which.buttonClicked.connect(lambda _: self._show_spots())
        foot = in_row((self.spot_words, 1), self.before_button, self.now_button)
        picture = fill(QWidget(), (self.spots, 1), foot)
        search = split(picture, split(self.score, self.progress), sizes=[340, 240], down=True, firm=True)
        yield
        fields = split(self.before.plot, self.after.plot, down=True)
        self.tabs = tabs({"Spots and scores": search, "Displacement": fields, "Pose": self.pose})
        yield
        fill(self.right, self.tabs)
        yield
        self._first: SpotLook | None = None
        self._newest: SpotLook | None = None
        self._tried = ""
        self._scores: list[list[tuple[float, float]]] = []
        self._brightest: list[float] = []
        self.run.look.connect(self._looked_at)
        self._draw_plots()

    def began(self) -> None:
        """Clear the last alignment."""
        self._first = self._newest = None
        self._scores, self._brightest, self._tried = [], [], ""
        self.spots.clear()
        self._rings.clear()
        self.spot_words.setText("No picture yet.")
        self.now_button.setChecked(True)
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

    def restyle(self) -> None:
        """Take over another theme."""
        for field in (self.before, self.after):
            field.restyle()
        self._draw_plots()

    # Inside --------------------------------------------------------------------------------------
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
            f", the brightest at {percent(look.brightness[best])} of the ideal" if look.of_whole_slm else ""
        )
        self.spot_words.setText(f"{len(look.spots)} spots{brightest}")
        self.spot_words.setToolTip("Each spot is a hypothesis about the mask's pose")

    def _draw_plots(self) -> None:
        older = [point for points in self._scores[:-1] for point in points]
        for curve, points, colour in (
            (self._older, older, colours().line),
            (self._points, self._scores[-1] if self._scores else [], colours().accent),
        ):
            x, y = np.array(points, float).reshape(-1, 2).T
            curve.setData(x, y, pen=None, **dots(colour))
        self.score.setLabel("bottom", _TRIED.get(self._tried, "hypothesis"))
        taken = np.arange(1, len(self._brightest) + 1)
        self._best.setData(taken, np.array(self._brightest), pen=curve_pen(), **dots(colours().accent))


def _tried_most(look: SpotLook) -> str:
    """Return the parameter that takes the most values in a picture; empty where none differs."""
    values = {name: {getattr(spot.pose, name) for spot in look.spots} for name in _TRIED}
    best = max(_TRIED, key=lambda name: len(values[name]))
    return best if len(values[best]) > 1 else ""


_LONGEST = 0.12
"""Of the mask's width: the longest arrow."""


class DisplacementPlot:
    """Arrows from nodes over the mask, all lengthened by one factor, which the title says.

    Attributes
    ----------
    plot : pyqtgraph.PlotWidget
    """

    def __init__(self, words: str) -> None:
        self.plot: Any = plot_widget("mask pixels", "mask pixels")
        self.plot.setAspectLocked(True)
        self.plot.invertY(True)
        self.words = words
        self.title = ""
        self._arrows: Any = self.plot.plot([], [])
        self._tails: Any = self.plot.plot([], [])
        self.clear()

    def clear(self) -> None:
        """Show nothing."""
        self._arrows.setData([], [])
        self._tails.setData([], [])
        self._say(self.words)

    def show_field(self, field: Float64Array, mask_shape: tuple[int, int]) -> None:
        """Show a field.

        Parameters
        ----------
        field : ndarray, float64, (rows, columns, 2)
            ``(y, x)`` in mask pixels, on nodes from edge to edge.
        mask_shape : (int, int)
        """
        height, width = mask_shape
        y, x = np.meshgrid(
            np.linspace(0, height, field.shape[0]), np.linspace(0, width, field.shape[1]), indexing="ij"
        )
        size = np.hypot(field[..., 0], field[..., 1])
        factor = _LONGEST * width / max(float(size.max()), 1e-9)
        ends_x, ends_y = x + factor * field[..., 1], y + factor * field[..., 0]
        across = np.stack([x.ravel(), ends_x.ravel()], axis=1).ravel()
        down = np.stack([y.ravel(), ends_y.ravel()], axis=1).ravel()
        self._arrows.setData(across, down, connect="pairs", **self._lines())
        self._tails.setData(x.ravel(), y.ravel(), pen=None, **self._dots())
        rms = float(np.sqrt(np.mean(size**2)))
        self._say(f"{self.words}: {rms:.2f} mask pixels rms, {size.max():.2f} at most (drawn {factor:.0f}x)")
        self.plot.autoRange()

    def restyle(self) -> None:
        """Take over another theme."""
        self._say(self.title)
        self._arrows.setPen(self._lines()["pen"])
        self._tails.setSymbolBrush(self._dots()["symbolBrush"])

    def _lines(self) -> dict[str, Any]:
        return {"pen": pg.mkPen(colours().accent, width=1.5)}

    def _dots(self) -> dict[str, Any]:
        return dots(colours().text, 4)

    def _say(self, title: str) -> None:
        self.title = title
        self.plot.setTitle(title, color=colours().dim, size="9pt")


_PARAMETERS = {
    "shift_x": ("shift x", "mask px"),
    "shift_y": ("shift y", "mask px"),
    "roll_mrad": ("rotation", "mrad"),
    "scale": ("scale", ""),
    "cubic": ("distortion", "mask px"),
    "z_um": ("distance", "um"),
    "pitch_mrad": ("tilt x", "mrad"),
    "yaw_mrad": ("tilt y", "mrad"),
}
"""Of a pose: what people call them, and their units."""
_LATERAL = ("shift_x", "shift_y", "roll_mrad", "scale")
_AXIAL = ("z_um", "pitch_mrad", "yaw_mrad")


class PoseView(QWidget):
    """A table of the pose's parameters, and two plots of what is left with its uncertainty.

    The first plot says what a parameter moves at the mask's edge, in mask pixels: a hologram feels a tenth.
    The second has distance and tilts in their own units.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        tip = "Found before the stage moved; left for the model; standard uncertainty"
        self.table = table(["found", "left", "+-"], tip, row_px=23)
        self.table.setRowCount(len(NAMES))
        said = [_PARAMETERS[name] for name in NAMES]
        self.table.setVerticalHeaderLabels([f"{words} ({unit})".replace(" ()", "") for words, unit in said])
        self.table.horizontalHeader().setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        self.lateral: Any = plot_widget("", "at the mask's edge", y_unit="mask px")
        self.axial: Any = plot_widget("", "um, mrad")
        self.report: AlignmentReport | None = None
        fill(self, (self.table, 3), (in_row((self.lateral, 4), (self.axial, 3)), 2))

    def clear(self) -> None:
        """Show nothing."""
        self.report = None
        self.table.clearContents()
        self.lateral.clear()
        self.axial.clear()

    def show_report(self, report: AlignmentReport) -> None:
        """Show a pose."""
        self.report = report
        before, left = report.found_at.vector(), report.pose.vector()
        for number, values in enumerate(zip(before, left, report.error, strict=True)):
            for column, value in enumerate(values):
                text = f"{value:+.4g}" if column < 2 else f"{value:.2g}"
                self.table.setItem(number, column, cell(text, number=True))
        edge = max(report.mask_shape) / 2
        at_edge = {"roll_mrad": 1e-3 * edge, "scale": edge}
        self._draw(self.lateral, _LATERAL, np.array([at_edge.get(n, 1.0) for n in _LATERAL]))
        self._draw(self.axial, _AXIAL, np.ones(len(_AXIAL)))

    def restyle(self) -> None:
        """Take over another theme."""
        if self.report is not None:
            self.show_report(self.report)

    def _draw(self, plot: Any, names: tuple[str, ...], factors: Float64Array) -> None:
        report = self.report
        assert report is not None
        rows = [NAMES.index(name) for name in names]
        left, error = report.pose.vector()[rows] * factors, report.error[rows] * factors
        x = np.arange(len(names), dtype=float)
        plot.clear()
        plot.addItem(pg.InfiniteLine(angle=0, pos=0.0, pen=pg.mkPen(colours().line)))
        pen = pg.mkPen(colours().accent, width=2)
        plot.addItem(pg.ErrorBarItem(x=x, y=left, height=2 * error, beam=0.2, pen=pen))
        plot.plot(x, left, pen=None, **dots(colours().accent, 8))
        plot.getAxis("bottom").setTicks([list(zip(x, (_PARAMETERS[n][0] for n in names), strict=True))])
        plot.setXRange(-0.5, len(names) - 0.5)
