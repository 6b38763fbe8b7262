"""A hologram on the screen: target and what counts in it, what an eye sees, the phase, the photograph.

What counts is a fovea to be dragged, or weights painted on the target. Arrow keys do both as well: they move
the fovea (Alt with Up and Down: its radius), or a brush for Space.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QPointF, Qt, Signal
from PySide6.QtWidgets import QWidget

from calibration_routines.display.hologram_photograph import Photographed
from gui.hologram_work import Computed, Progress
from gui.theme import colours
from gui.widgets.building import choice, fill, narrow, offer, split
from gui.widgets.image_view import ImageView, StretchedImage
from gui.widgets.plots import curve_pen, plot_widget
from gui.widgets.result_views import FactsView, ViewGrid
from instrument.bench.photograph import SPOILT
from instrument.display.hologram import square
from instrument.display.hologram_files import drawn_pattern, score_words
from instrument.files.errors import percent
from recon.arrays import Array, Float64Array
from recon.holography import HologramRecord, foveal_weights, painted_weights

WeightsMode = Literal["uniform", "fovea", "painted"]
Stroke = tuple[float, float, float, float]
WEIGHTS_SHAPE = (256, 256)
_STEP = 0.3
"""A stroke is a row of discs this part of their radius apart."""
_DIGITS = 3
_KEY_STEP = 0.02
"""Of the arrow keys, a fraction of the field; Shift and Ctrl as everywhere."""
_RADII = (0.02, 1.0)


class WeightsView(StretchedImage):
    """Shows a square field of view; coordinates are fractions of it, (0, 0) the top left corner.

    Signals
    -------
    changed
        The weights are others now.
    """

    changed = Signal()

    def __init__(self) -> None:
        super().__init__(name="Target, with what counts")
        self.mode: WeightsMode = "uniform"
        self.periphery = 0.1
        self.brush_radius = 0.06
        self.brush_weight = 1.0
        self.strokes: list[Stroke] = []
        self._size = 1
        self._shade: Any = pg.ImageItem()
        self._shade.setZValue(1)
        self.box.addItem(self._shade)
        self.fovea: Any = pg.CircleROI(
            (0.22, 0.22), radius=0.28, pen=pg.mkPen(colours().warning, width=2), movable=True
        )
        self.fovea.setZValue(2)
        self.fovea.sigRegionChanged.connect(self._fovea_moved)
        self.box.addItem(self.fovea)
        self.fovea.hide()
        self._painting = False
        self.graphics.viewport().installEventFilter(self)
        self.brush_at = (0.5, 0.5)
        """Where the keyboard's brush is, (y, x) in fractions of the field."""
        self._brush: Any = pg.QtWidgets.QGraphicsEllipseItem()
        self._brush.setPen(pg.mkPen(colours().accent, width=2))
        self._brush.setZValue(3)
        self._brush.hide()
        self.box.addItem(self._brush)
        self.arrows_pan = False
        self.keys.moved.connect(self._by_keys)
        self.keys.resized.connect(lambda _, down: self._resize(-down))
        self.keys.acted.connect(self._act)
        self.keys.entered.connect(self._place_brush)
        self.keys.left.connect(self._brush.hide)

    # What counts ---------------------------------------------------------------------------------
    def set_mode(self, mode: WeightsMode) -> None:
        """Let everything count alike, a fovea more, or what was painted."""
        self.mode = mode
        self.arrows_pan = mode == "uniform"
        self._place_brush()
        self.fovea.setVisible(mode == "fovea")
        self.box.setMouseEnabled(x=mode != "painted", y=mode != "painted")
        self._show_shade()
        self.changed.emit()

    @property
    def centre(self) -> tuple[float, float]:
        """The fovea's centre, (y, x) in fractions of the field."""
        middle = self.fovea.pos() + self.fovea.size() / 2
        return round(middle.y() / self._size, _DIGITS), round(middle.x() / self._size, _DIGITS)

    @property
    def radius(self) -> float:
        """The fovea's radius in fractions of the field."""
        return round(float(self.fovea.size().x()) / 2 / self._size, _DIGITS)

    def set_fovea(self, centre: tuple[float, float], radius: float) -> None:
        """Place the fovea: (y, x) and radius in fractions of the field."""
        size = self._size
        self.fovea.setPos(((centre[1] - radius) * size, (centre[0] - radius) * size), update=False)
        self.fovea.setSize((2 * radius * size, 2 * radius * size))

    def set_brush_radius(self, radius: float) -> None:
        """Set the brush's radius, a fraction of the field."""
        self.brush_radius = radius
        self._place_brush()

    def weights(self) -> Float64Array | None:
        """Return the weights over the field, or None where everything counts alike.

        Raises InputError when nothing counts.
        """
        if self.mode == "uniform":
            return None
        if self.mode == "fovea":
            return foveal_weights(
                WEIGHTS_SHAPE, centre=self.centre, radius=self.radius, periphery=self.periphery
            )
        return painted_weights(WEIGHTS_SHAPE, self.strokes, background=self.periphery)

    def set_periphery(self, weight: float) -> None:
        """Set the weight outside of the fovea, or where nothing is painted."""
        self.periphery = weight
        self._show_shade()
        self.changed.emit()

    def clear_strokes(self) -> None:
        """Take off all that was painted."""
        self.strokes = []
        self._show_shade()
        self.changed.emit()

    # Showing -------------------------------------------------------------------------------------
    def show_target(self, image: Array) -> None:
        """Show the target as it fills the square field, (height, width) in 0 to 1."""
        centre, radius = self.centre, self.radius
        self._size = max(image.shape)
        self.show_image(image, 0.0, 1.0, extent=(self._size, self._size))
        self.set_fovea(centre, radius)
        self._place_brush()
        self._show_shade()

    def _show_shade(self) -> None:
        """Darken what counts less."""
        if self.mode == "uniform" or self.image is None or (self.mode == "painted" and self._is_void()):
            self._shade.clear()
            return
        weights = self.weights()
        assert weights is not None
        shade = np.zeros((*weights.shape, 4), np.uint8)
        shade[..., 3] = np.round(170 * (1 - weights / weights.max()))
        self._shade.setImage(shade, levels=(0, 255))
        self._shade.setRect(0, 0, self._size, self._size)

    def _is_void(self) -> bool:
        return not self.strokes and self.periphery == 0

    def _fovea_moved(self) -> None:
        if self.mode == "fovea":
            self._show_shade()
            self.changed.emit()

    # Keys ----------------------------------------------------------------------------------------
    def _by_keys(self, across: float, down: float) -> None:
        """Move the fovea or the brush by steps of the arrow keys."""
        by = _KEY_STEP * down, _KEY_STEP * across
        if self.mode == "fovea":
            self.set_fovea(_inside(self.centre, by), self.radius)
        elif self.mode == "painted":
            self.brush_at = _inside(self.brush_at, by)
            self._place_brush()

    def _resize(self, steps: float) -> None:
        if self.mode == "fovea":
            least, most = _RADII
            self.set_fovea(self.centre, min(max(self.radius + _KEY_STEP * steps, least), most))

    def _act(self, paint: bool) -> None:
        """Paint where the brush is, or rub out."""
        if self.mode == "painted" and self.image is not None:
            self._erasing = not paint
            y, x = self.brush_at
            self._dab(QPointF(x * self._size, y * self._size))
            self.changed.emit()

    def _place_brush(self) -> None:
        (y, x), r, size = self.brush_at, self.brush_radius, self._size
        self._brush.setRect((x - r) * size, (y - r) * size, 2 * r * size, 2 * r * size)
        self._brush.setVisible(self.mode == "painted" and self.graphics.hasFocus())

    # Painting ------------------------------------------------------------------------------------
    def eventFilter(self, watched: Any, event: Any) -> bool:  # noqa: N802 - Qt's name
        """Paint with the left button, rub out with the right one."""
        if self.mode != "painted" or self.image is None or watched is not self.graphics.viewport():
            return False
        kind = event.type()
        if kind == event.Type.MouseButtonPress:
            self._painting = event.button() in (Qt.MouseButton.LeftButton, Qt.MouseButton.RightButton)
            self._erasing = event.button() == Qt.MouseButton.RightButton
        if kind in (event.Type.MouseButtonPress, event.Type.MouseMove) and self._painting:
            place = self.box.mapSceneToView(self.graphics.mapToScene(event.position().toPoint()))
            self._dab(place)
            return True
        if kind == event.Type.MouseButtonRelease and self._painting:
            self._painting = False
            self.changed.emit()
            return True
        return False

    def _dab(self, place: QPointF) -> None:
        """Add a disc, unless it would lie nearly on the last one."""
        y, x = (round(float(v) / self._size, _DIGITS) for v in (place.y(), place.x()))
        weight = 0.0 if self._erasing else self.brush_weight
        stroke = (y, x, self.brush_radius, weight)
        if self.strokes:
            last = self.strokes[-1]
            near = float(np.hypot(y - last[0], x - last[1])) < _STEP * self.brush_radius
            if near and last[2:] == stroke[2:]:
                return
        if -self.brush_radius < y < 1 + self.brush_radius and -self.brush_radius < x < 1 + self.brush_radius:
            self.strokes.append(stroke)
            self._show_shade()


def _inside(place: tuple[float, float], by: tuple[float, float]) -> tuple[float, float]:
    """Return a place moved, but not out of the field."""
    y, x = (round(min(max(p + d, 0.0), 1.0), _DIGITS) for p, d in zip(place, by, strict=True))
    return y, x


class HologramViews(QWidget):
    """Shows a hologram as it is computed, and what the camera saw of it.

    ``plane`` chooses the plane that is looked at; the panel has a place for it. It is there once its
    ``parts`` are made.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.computed: Computed | None = None

    def parts(self) -> Iterator[None]:
        """Make the views, with a ``yield`` after each."""
        self.target = WeightsView()
        self.target.graphics.setToolTip(
            "A fovea is dragged, or moved by arrow keys (Alt with Up and Down: its radius). Painting: left "
            "button or Space paints, right button or Backspace rubs out, arrow keys move the brush"
        )
        yield
        self.seen = ImageView(name="What is seen, computed")
        yield
        self.phase = ImageView(name="Phase")
        yield
        self.captured = ImageView(name="Photograph")
        yield
        self.plane = narrow(choice((), "The plane that is looked at", self._show_plane))
        self.plane.hide()
        self.metrics = FactsView()
        self.plot = plot_widget("iteration", "PSNR", y_unit="dB")
        self.plot.setMinimumSize(120, 80)
        self.plot.setToolTip("PSNR of the seen image, computed, as the optimiser goes")
        yield
        for view in (self.target, self.seen, self.phase, self.captured):
            view.setMinimumSize(70, 50)
        top = ViewGrid(
            [
                ("target, and what counts in it", self.target),
                ("seen by an eye (computed)", self.seen),
                ("on the SLM: phase, 0 to 2π (mirrors: light)", self.phase),
                ("photographed", self.captured),
            ]
        )
        below = split(self.metrics, self.plot, sizes=[480, 480])
        both = split(top, below, sizes=[560, 150], down=True)
        both.setStretchFactor(0, 4)
        fill(self, both)
        self._say_what_is_missing()

    def _say_what_is_missing(self) -> None:
        """Say in each view that is empty what fills it."""
        by_solver = "Preview or Compute fills this in"
        missing = {self.seen: by_solver, self.phase: by_solver, self.captured: "Show and photograph takes it"}
        for view, words in missing.items():
            view.set_caption("" if view.image is not None else words)

    def begin(self) -> None:
        """Call what is shown of the hologram before by its name, while another is computed."""
        for view in (self.seen, self.captured):
            view.caution_against("" if view.image is None else "Of the hologram before", old=True)
        self.phase.caution_against("In the making")

    def go_back(self) -> None:
        """Show the hologram before again, where the other did not come about."""
        for view in (self.seen, self.captured, self.phase):
            view.caution_against("")
        if self.computed is None:
            self.phase.clear()
        else:
            self._show_phase(self.computed)
        self._say_what_is_missing()

    def _show_phase(self, computed: Computed) -> None:
        self.phase.show_image(drawn_pattern(computed.result.hologram.slm[0]), 0.0, 2 * np.pi)
        self._draw_history(computed.result.hologram.history)

    def show_progress(self, progress: Progress) -> None:
        """Show the phase so far, and how good it is."""
        self.phase.show_image(progress.phase_rad, 0.0, 2 * np.pi)
        self._say_what_is_missing()
        self._draw_history(progress.history)

    def show_computed(self, computed: Computed) -> None:
        """Show a hologram that was computed; the photograph of the one before is gone."""
        self.computed = computed
        order = computed.order
        depths = [order.z_mm, *(z_mm for _, z_mm in order.further)]
        offer(self.plane, [(f"seen at {z_mm:g} mm", z_mm) for z_mm in depths])
        self.plane.setVisible(len(depths) > 1)
        self._show_plane(0)
        self.captured.clear()
        self.go_back()
        self.metrics.show_facts(_facts(computed))

    def show_photographed(self, photographed: Photographed, picture: str) -> None:
        """Show what the camera saw of it, and how close it is to the target."""
        assert self.computed is not None
        self.captured.show_image(np.maximum(square(photographed.capture.seen), 0), 0.0, 1.0)
        self._say_what_is_missing()
        warnings = []
        if photographed.capture.saturated_fraction > SPOILT:
            warnings.append(
                f"{percent(photographed.capture.saturated_fraction)} of the camera's pixels are saturated."
            )
        if self.computed.order.alignment is None:
            warnings.append(
                "Computed without an alignment of the mask: a mask out of place shows nothing of it."
            )
        facts = [
            ("Photographed", score_words(photographed.capture.scores)),
            ("Camera", f"registered to {photographed.camera_residual_px:.2f} px"),
            ("Picture", picture),
            *_facts(self.computed),
        ]
        self.metrics.show_facts(facts, warnings, simulated=photographed.simulated)

    def restyle(self) -> None:
        """Take over the theme's colours."""
        if self.computed is not None:
            self._draw_history(self.computed.result.hologram.history)

    def _show_plane(self, number: int) -> None:
        if self.computed is not None and number >= 0:
            self.seen.show_image(np.maximum(square(self.computed.result.seen[number]), 0), 0.0, 1.0)

    def _draw_history(self, history: Sequence[HologramRecord]) -> None:
        plot: Any = self.plot
        plot.clear()
        plot.plot([r.iteration for r in history], [r.psnr_db for r in history], pen=curve_pen(0))


def _facts(computed: Computed) -> list[tuple[str, str]]:
    result, display, order = computed.result, computed.display, computed.order
    last = result.hologram.history[-1]
    depths = [order.z_mm, *(z_mm for _, z_mm in order.further)]
    facts = [
        (f"Seen (computed){f' at {z_mm:g} mm' if len(depths) > 1 else ''}", score_words(scores))
        for z_mm, scores in zip(depths, result.scores, strict=True)
    ]
    stopped = f"after {last.iteration} iterations, {result.hologram.seconds:.1f} s"
    rows, columns = display.slm_shape
    return [
        *facts,
        ("Light", f"{percent(result.efficiency)} of what falls on the SLM reaches the field"),
        *(("Limited by", words) for words in result.limited_by),
        ("Stopped", f"{stopped}: {result.hologram.stop_reason}"),
        ("Expansion", f"{display.expansion}x on {columns} x {rows} pixels, {display.wavelength_nm:g} nm"),
        *(("Pattern", str(path)) for path in computed.patterns),
    ]
