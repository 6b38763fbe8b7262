"""A hologram on the screen: target and what counts in it, what an eye sees, the phase, the photograph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QComboBox, QSplitter, QVBoxLayout, QWidget

from calibration_routines.display.hologram_photograph import Photographed
from gui.hologram_work import Computed, Progress
from gui.theme import colours
from gui.widgets.entry import narrow
from gui.widgets.image_view import ImageView
from gui.widgets.plot import curve_pen, plot_widget, restyle
from gui.widgets.result_views import FactsView, ViewGrid
from gui.widgets.weights_view import WeightsView
from recon.holography import HologramRecord, Scores

_SATURATED = 1e-3
"""A larger part of the camera's pixels is worth a warning."""


class HologramViews(QWidget):
    """Shows a hologram as it is computed, and what the camera saw of it.

    ``plane`` chooses the plane that is looked at; the panel has a place for it.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.computed: Computed | None = None
        self.target = WeightsView()
        self.target.graphics.setToolTip(
            "A fovea is dragged, or moved by arrow keys (Alt with Up and Down: its radius). Painting: left "
            "button or Space paints, right button or Backspace rubs out, arrow keys move the brush"
        )
        self.seen, self.phase, self.captured = ImageView(), ImageView(), ImageView()
        self.plane = QComboBox()
        self.plane.setToolTip("The plane that is looked at")
        narrow(self.plane)
        self.plane.currentIndexChanged.connect(self._show_plane)
        self.plane.hide()
        self.metrics = FactsView()
        self.plot = plot_widget("iteration", "PSNR", y_unit="dB")
        self.plot.setMinimumSize(120, 80)
        self.plot.setToolTip("PSNR of the seen image, computed, as the optimiser goes")
        for view in (self.target, self.seen, self.phase, self.captured):
            view.setMinimumSize(70, 50)
        top = ViewGrid(
            [
                ("target, and what counts in it", self.target),
                ("seen by an eye (computed)", self.seen),
                ("phase on the SLM, 0 to 2π", self.phase),
                ("photographed", self.captured),
            ]
        )
        below = QSplitter(Qt.Orientation.Horizontal)
        below.addWidget(self.metrics)
        below.addWidget(self.plot)
        below.setSizes([480, 480])
        both = QSplitter(Qt.Orientation.Vertical)
        both.addWidget(top)
        both.addWidget(below)
        both.setStretchFactor(0, 4)
        both.setSizes([560, 150])
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(both)

    def show_progress(self, progress: Progress) -> None:
        """Show the phase so far, and how good it is."""
        self.phase.show_image(progress.phase_rad, 0.0, 2 * np.pi)
        self._draw_history(progress.history)

    def show_computed(self, computed: Computed) -> None:
        """Show a hologram that was computed; the photograph of the one before is gone."""
        self.computed = computed
        order = computed.order
        depths = [order.z_mm, *(z_mm for _, z_mm in order.further)]
        self.plane.blockSignals(True)
        self.plane.clear()
        self.plane.addItems([f"seen at {z_mm:g} mm" for z_mm in depths])
        self.plane.blockSignals(False)
        self.plane.setVisible(len(depths) > 1)
        self._show_plane(0)
        self.phase.show_image(computed.result.hologram.phase_rad[0], 0.0, 2 * np.pi)
        self.captured.clear()
        self._draw_history(computed.result.hologram.history)
        self.metrics.show_facts(_facts(computed))

    def show_photographed(self, found: Photographed, picture: str) -> None:
        """Show what the camera saw of it, and how close it is to the target."""
        assert self.computed is not None
        self.captured.show_image(np.maximum(found.capture.seen, 0), 0.0, 1.0)
        warnings = []
        if found.capture.saturated_fraction > _SATURATED:
            warnings.append(f"{found.capture.saturated_fraction:.1%} of the camera's pixels are saturated.")
        if self.computed.order.alignment is None:
            warnings.append(
                "Computed without an alignment of the mask: a mask out of place shows nothing of it."
            )
        facts = [
            ("Photographed", _scores(found.capture.scores)),
            ("Camera", f"registered to {found.camera_residual_px:.2f} px"),
            ("Picture", picture),
            *_facts(self.computed),
        ]
        self.metrics.show_facts(facts, warnings, simulated=found.simulated)

    def restyle(self) -> None:
        """Take over the theme's colours and colour map."""
        now = colours()
        for view in (self.target, self.seen, self.phase, self.captured):
            view.graphics.setBackground(now.window)
            view.set_colour_map(now.colour_map)
        restyle(self.plot)
        self.metrics.restyle()

    def _show_plane(self, number: int) -> None:
        if self.computed is not None and number >= 0:
            self.seen.show_image(np.maximum(self.computed.result.seen[number], 0), 0.0, 1.0)

    def _draw_history(self, history: Sequence[HologramRecord]) -> None:
        plot: Any = self.plot
        plot.clear()
        plot.plot([r.iteration for r in history], [r.psnr_db for r in history], pen=curve_pen(0))


def _facts(computed: Computed) -> list[tuple[str, str]]:
    result, display, order = computed.result, computed.display, computed.order
    last = result.hologram.history[-1]
    depths = [order.z_mm, *(z_mm for _, z_mm in order.further)]
    facts = [
        (f"Seen (computed){f' at {z_mm:g} mm' if len(depths) > 1 else ''}", _scores(scores))
        for z_mm, scores in zip(depths, result.scores, strict=True)
    ]
    stopped = f"after {last.iteration} iterations, {result.hologram.seconds:.1f} s"
    rows, columns = display.slm_shape
    return [
        *facts,
        ("Stopped", f"{stopped}: {result.hologram.stop_reason}"),
        (
            "Expansion",
            f"{display.expansion}x on {columns} x {rows} pixels, {display.wavelength_nm:g} nm",
        ),
        *(("Pattern", str(path)) for path in computed.patterns),
    ]


def _scores(scores: Scores) -> str:
    return (
        f"{scores.psnr_db:.2f} dB, SSIM {scores.ssim:.3f}; middle quarter {scores.crop_psnr_db:.2f} dB, "
        f"SSIM {scores.crop_ssim:.3f}"
    )
