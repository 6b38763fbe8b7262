"""The live picture: the camera's frame with its levels, and what lies over it: cross-hair, line, region."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pyqtgraph as pg
from PySide6.QtCore import QObject, QPointF, QSignalBlocker, Signal
from PySide6.QtWidgets import QWidget

from drivers.frame import Frame
from gui.session import BenchSession
from gui.theme import NAMES, colours
from gui.widgets.building import button, choice, fill, in_row
from gui.widgets.image_view import ImageView, usual_levels, whole_steps
from gui.widgets.orientation import OrientationButton, follow_orientation
from gui.widgets.plots import HistogramPlot, curve_pen, plot_widget
from instrument.live.frame_view import (
    Counts,
    FrameFigures,
    histogram,
    line_profile,
    not_stretched,
    percentiles,
    sensor_roi,
)

Moved = Callable[[float, float], tuple[float, float] | None]
"""Gives where a place of the frame before, in its pixels, is in another frame; None: nowhere in it."""


class CrossHair(QObject):
    """Two lines through a pixel; a click moves them.

    Signals
    -------
    moved : int, int
        Column and row.
    """

    moved = Signal(int, int)

    def __init__(self, view: ImageView) -> None:
        super().__init__(view)
        self._view = view
        pen = pg.mkPen(colours().accent, width=1)
        self._lines: tuple[Any, Any] = (pg.InfiniteLine(angle=90, pen=pen), pg.InfiniteLine(angle=0, pen=pen))
        self.pixel: tuple[int, int] | None = None
        self.enabled = False
        for line in self._lines:
            line.setVisible(False)
            view.box.addItem(line, ignoreBounds=True)
        view.clicked.connect(self.move_to)

    def set_enabled(self, enabled: bool) -> None:
        """Show or hide it; shown first in the middle."""
        self.enabled = enabled
        for line in self._lines:
            line.setVisible(enabled)
        if enabled and self.pixel is None and self._view.image is not None:
            height, width = self._view.image.shape[:2]
            self.move_to(width // 2, height // 2)

    def follow(self, moved: Moved) -> None:
        """Move it with the sensor's pixels; to the middle where it would be out of the image."""
        assert self.pixel is not None
        place, self.pixel = moved(*(side + 0.5 for side in self.pixel)), None
        if not self.enabled:
            return  # it is shown in the middle when it is wanted again
        if place is None:
            self.set_enabled(True)
        else:
            self.pixel = int(place[0]), int(place[1])
            self.step(0, 0)

    def step(self, across: float, down: float) -> None:
        """Move it by so many pixels, at least one, and not out of the image."""
        if self.pixel is None or self._view.image is None:
            return
        height, width = self._view.image.shape[:2]
        column, row = (place + whole_steps(by) for place, by in zip(self.pixel, (across, down), strict=True))
        self.move_to(min(max(column, 0), width - 1), min(max(row, 0), height - 1))

    def move_to(self, column: int, row: int) -> None:
        """Move it to a pixel."""
        if self.enabled:
            self.pixel = (column, row)
            self._lines[0].setValue(column + 0.5)
            self._lines[1].setValue(row + 0.5)
            self.moved.emit(column, row)


_STEP_PX = 10.0
"""A step of the arrow keys for lines and regions; Ctrl makes it a pixel. The cross-hair goes by pixels."""
_LEAST_PX = 2.0


class _Overlay:
    """Something that is dragged over the image; ``item`` is None while it is hidden."""

    def __init__(self, view: ImageView) -> None:
        self._view = view
        self.item: Any = None

    def set_enabled(self, enabled: bool) -> None:
        """Show or hide it; each time it is shown where it begins."""
        if enabled and self.item is None and self._view.image is not None:
            height, width = self._view.image.shape[:2]
            self.item = self._made(width, height)
            self._view.box.addItem(self.item)
        elif not enabled and self.item is not None:
            self._view.box.removeItem(self.item)
            self.item = None

    def begin_anew(self) -> None:
        """Show it where it begins."""
        self.set_enabled(False)
        self.set_enabled(True)

    def _made(self, width: int, height: int) -> Any:
        raise NotImplementedError


class ProfileLine(_Overlay):
    """A line whose ends are dragged, first across the middle; ``ends`` in pixels."""

    def _made(self, width: int, height: int) -> Any:
        ends = [[0.1 * width, 0.5 * height], [0.9 * width, 0.5 * height]]
        return pg.LineSegmentROI(ends, pen=pg.mkPen(colours().warning, width=1.5))

    def step(self, across: float, down: float, *, end_only: bool) -> None:
        """Move the line by steps of the arrow keys, or only its second end."""
        if self.item is None:
            return
        ends = self._places()
        moved = ends[1:] if end_only else ends
        dx, dy = _within(self._view, moved, moved, across, down)
        for end in moved:
            end.setX(end.x() + dx)
            end.setY(end.y() + dy)
        for handle, end in zip(self.item.handles, ends, strict=True):
            self.item.movePoint(handle["item"], end)

    def _places(self) -> list[Any]:
        return [
            self.item.mapToParent(self.item.mapFromItem(handle["item"], 0, 0)) for handle in self.item.handles
        ]

    def follow(self, moved: Moved) -> None:
        """Move its ends with the sensor's pixels; where one would be out of the image it begins anew."""
        places = [moved(end.x(), end.y()) for end in self._places()]
        there = [place for place in places if place is not None]
        if len(there) < len(places):
            self.begin_anew()
            return
        for handle, place in zip(self.item.handles, there, strict=True):
            self.item.movePoint(handle["item"], pg.Point(*place))

    @property
    def ends(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Start and end, x and y in pixels; None while hidden."""
        if self.item is None:
            return None
        first, second = self._places()  # not by the scene, which follows a frame of another size later
        return (first.x(), first.y()), (second.x(), second.y())


class RegionBox(_Overlay):
    """A rectangle dragged with the mouse: anew on the frame, or by its handles; ``rectangle`` in pixels.

    First over the middle half.
    """

    def set_enabled(self, enabled: bool) -> None:
        """Show or hide it; while it is shown, dragging on the frame draws it."""
        super().set_enabled(enabled)
        self._view.drag_taker = None if self.item is None else self.draw

    def _made(self, width: int, height: int) -> Any:
        box: Any = pg.RectROI(
            [0.25 * width, 0.25 * height],
            [0.5 * width, 0.5 * height],
            pen=pg.mkPen(colours().ok, width=1.5),
            sideScalers=True,
        )
        box.addScaleHandle([0, 0], [1, 1])
        return box

    def draw(self, start: QPointF, now: QPointF) -> None:
        """Make it the rectangle between two places of the frame, in pixels, cut off at the frame's edges."""
        if self.item is None or self._view.image is None:
            return
        height, width = self._view.image.shape[:2]
        left, right = sorted(min(max(place.x(), 0.0), width) for place in (start, now))
        top, bottom = sorted(min(max(place.y(), 0.0), height) for place in (start, now))
        if right - left >= 1 and bottom - top >= 1:
            self.item.setPos((left, top))
            self.item.setSize((right - left, bottom - top))

    def step(self, across: float, down: float, *, size_only: bool) -> None:
        """Move the rectangle by steps of the arrow keys, or its lower right corner."""
        if self.item is None:
            return
        width, height = self.item.size()
        place = self.item.pos()
        corner = place + pg.Point(width, height)
        dx, dy = _within(self._view, [corner if size_only else place], [corner], across, down)
        if size_only:
            self.item.setSize((max(_LEAST_PX, width + dx), max(_LEAST_PX, height + dy)))
        else:
            self.item.setPos(place + pg.Point(dx, dy))

    @property
    def rectangle(self) -> tuple[float, float, float, float] | None:
        """Left, top, width, height in pixels; None while hidden."""
        if self.item is None:
            return None
        place, size = self.item.pos(), self.item.size()
        return place.x(), place.y(), size.x(), size.y()


def _within(
    view: ImageView, first: Sequence[Any], last: Sequence[Any], across: float, down: float
) -> tuple[float, float]:
    """Return what steps of the arrow keys move places by, in pixels: not out of the image.

    ``first`` are the places that reach its left and upper edge, ``last`` the right and lower one.
    """
    if view.image is None:
        return 0.0, 0.0
    height, width = view.image.shape[:2]
    dx = min(_STEP_PX * across, width - max(place.x() for place in last))
    dy = min(_STEP_PX * down, height - max(place.y() for place in last))
    return max(dx, -min(place.x() for place in first)), max(dy, -min(place.y() for place in first))


LEVELS = {"full range": None, "0.1 – 99.9 %": (0.1, 99.9), "1 – 99 %": (1.0, 99.0), "by hand": None}
"""Percentiles of the counts shown darkest and brightest."""


_STRIDE = 16
"""Of the pixels that are looked at, along both sides: whether the light is another shows in a few."""
_DIM = 0.002
"""Of full scale: what noise and offsets may differ by."""
_MOVED = 0.1
"""Of the span of the levels: from here on a frame is shown again by its own."""


_PROFILE_PX = 110
"""The least that a profile is seen on: its numbers stand apart."""


class LivePicture(QWidget):
    """A frame with tools above it, the profile along a line below, and its histogram.

    ``histogram`` stands beside it: the panel has a place for it.

    Parameters
    ----------
    session : BenchSession

    Signals
    -------
    region_sent
        The region is to be sent to the camera.

    Attributes
    ----------
    frame : Frame or None
        What is shown.
    is_coarse : bool
        Whether a coarse picture of what will come is shown in its place.
    levels : (float, float)
        Counts shown darkest and brightest.
    """

    region_sent = Signal()

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.frame: Frame | None = None
        self._measured: Frame | None = None
        self._shape: tuple[int, ...] = ()
        """Of the frame that line, cross-hair and region were drawn on last."""
        self.is_coarse = False
        self.levels = (0.0, 1.0)
        self._session = session

    def parts(self) -> Iterator[None]:
        """Make the view and its tools."""
        session = self._session
        self.view = ImageView(name="Newest frame of the camera")
        self.view.keys.moved.connect(lambda across, down: self._by_keys(across, down, alt=False))
        self.view.keys.resized.connect(lambda across, down: self._by_keys(across, down, alt=True))
        self.view.keys.acted.connect(lambda send: self.region_sent.emit() if send else None)
        yield
        self.histogram = HistogramPlot()
        self.histogram.levels_dragged.connect(self._levels_by_hand)
        yield
        self.cross_hair = CrossHair(self.view)
        self.profile_line = ProfileLine(self.view)
        self.region_box = RegionBox(self.view)
        yield
        self.profile_plot = plot_widget("along the line", "counts", x_unit="pixels")
        self._profile_curve = self.profile_plot.plot([], [], pen=curve_pen(0))
        self.profile_plot.setMaximumHeight(170)
        self.profile_plot.setMinimumHeight(_PROFILE_PX)
        self.profile_plot.hide()
        yield
        self.colour_map = choice(NAMES, "Colour map; saturated pixels have a colour of their own")
        self.colour_map.setCurrentText(self.view.colour_map)
        self.colour_map.currentTextChanged.connect(self.view.set_colour_map)
        tip = (
            "Counts shown darkest and brightest: full range, percentiles (over a sixteenth of it), or dragged"
        )
        self.stretch = choice(LEVELS, tip)
        self.stretch.setCurrentIndex(1)
        self.stretch.currentTextChanged.connect(lambda _: self._stretch_chosen())
        self.cross_button = button(
            "✛", "Cross-hair: a click moves it, and arrow keys in the picture", checkable=True
        )
        self.cross_button.setAccessibleName("Cross-hair")
        self.profile_button = button(
            "Profile", "Counts along a line: drag its ends, or arrow keys (Alt: one end)", checkable=True
        )
        self.region_button = button(
            "Region",
            "Drag a region of interest, or arrow keys (Alt: its size; Return sends it)",
            checkable=True,
        )
        self.apply_region = button(
            "Send", "Send the region to the camera: top, left, height, width of the sensor", self.region_sent
        )
        self.apply_region.hide()
        for switch, what in (
            (self.cross_button, (self.cross_hair.set_enabled,)),
            (self.profile_button, (self.profile_line.set_enabled, self.profile_plot.setVisible)),
            (self.region_button, (self.region_box.set_enabled, self.apply_region.setVisible)),
        ):
            for switched in what:
                switch.toggled.connect(switched)
            switch.toggled.connect(lambda _: self._arrows_for())
        yield
        fit = button("Fit", "Show the whole image (wheel zooms, dragging moves)", self.view.whole)
        tip = "Turn and mirror what the camera sees, in every panel; files stay as the sensor has them."
        self.turn_button = OrientationButton(session, "frames", tip)
        follow_orientation(session, "frames", self.view.orient)
        tools = in_row(
            self.colour_map,
            self.stretch,
            self.cross_button,
            self.profile_button,
            self.region_button,
            self.apply_region,
            fit,
            self.turn_button,
            None,
            spacing=2,
        )
        fill(self, tools, (self.view, 1), self.profile_plot)

    def show_frame(self, frame: Frame) -> None:
        """Show a frame with the levels in use; in another light than the one before with its own."""
        self.frame, self.is_coarse = frame, False
        if (before := self._measured) is not None and before is not frame and _other_light(before, frame):
            self._measure(frame)
        naming, (top, left) = self.view.naming, frame.metadata.roi[:2]
        self.view.naming = (left, top, frame.metadata.binning)
        self.view.show_image(frame.image, *self.levels, frame.full_scale)
        if self.view.naming != naming or frame.image.shape[:2] != self._shape:
            self._follow(naming, frame)
            self._shape = frame.image.shape[:2]

    def show_coarse(self, counts: Counts, factor: int) -> None:
        """Show what a frame will show, of large pixels, where it will stand; it is no frame."""
        self.is_coarse = True
        height, width = (side * factor for side in counts.shape)
        full_scale = None
        if (frame := self.frame) is not None:
            height, width = frame.image.shape[:2]
            full_scale = frame.full_scale
        levels = usual_levels(counts)
        self.view.show_image(
            counts,
            *(levels if full_scale is None else not_stretched(levels, full_scale)),
            full_scale,
            (width, height),
        )

    def measure(self) -> None:
        """Make histogram, levels and profile of the frame that is shown, once."""
        if self.frame is None or self.frame is self._measured or self.is_coarse:
            return
        low, high = self.levels
        self._measure(self.frame)
        moved = max(abs(self.levels[0] - low), abs(self.levels[1] - high))
        if moved > _MOVED * (self.levels[1] - self.levels[0]):  # the next frame may be seconds away
            self.show_frame(self.frame)

    def restyle(self) -> None:
        """Take over the theme's colour map."""
        self.colour_map.setCurrentText(colours().colour_map)

    def under_cross(self) -> str:
        """Return place and value under the cross-hair in words; empty where there is none."""
        pixel, image = self.cross_hair.pixel, self.view.image
        if not self.cross_hair.enabled or pixel is None or image is None:
            return ""
        inside = pixel[1] < image.shape[0] and pixel[0] < image.shape[1]
        return f"✛ {self.view.describe(*pixel)}" if inside else ""

    def region_words(self) -> str:
        """Return the region in the sensor's pixels, as it would be sent; empty where none is drawn."""
        rectangle, frame = self.region_box.rectangle, self.frame
        if rectangle is None or frame is None:
            return ""
        return f"region {', '.join(map(str, sensor_roi(frame.metadata, *rectangle).as_tuple()))}"

    # Inside --------------------------------------------------------------------------------------
    def _follow(self, before: tuple[int, int, int], frame: Frame) -> None:
        """Leave line and cross-hair where they were on the sensor; outside, as a region, they begin anew."""
        height, width = frame.image.shape[:2]
        places = before, self.view.naming

        def moved(x: float, y: float) -> tuple[float, float] | None:
            (left, top, fine), (new_left, new_top, coarse) = places
            x, y = (x * fine + left - new_left) / coarse, (y * fine + top - new_top) / coarse
            return (x, y) if 0 <= x <= width and 0 <= y <= height else None

        if self.profile_line.item is not None:
            self.profile_line.follow(moved)
        if self.cross_hair.pixel is not None:
            self.cross_hair.follow(moved)
        if self.region_box.item is not None:
            self.region_box.begin_anew()

    def _measure(self, frame: Frame) -> None:
        self._measured = frame
        counts = histogram(frame.image)
        wanted = LEVELS[self.stretch.currentText()]
        if wanted is not None:
            self.levels = not_stretched(percentiles(counts, *wanted), frame.full_scale)
        elif self.stretch.currentText() == "full range":
            self.levels = (0.0, float(frame.full_scale))
        self.histogram.show_counts(counts, FrameFigures.of(counts, frame.full_scale), *self.levels)
        if (ends := self.profile_line.ends) is not None:
            self._profile_curve.setData(*line_profile(frame.image, *ends))
            (x0, y0), (x1, y1) = (self.view.named(*end) for end in ends)
            words = f"x {x0:.0f} y {y0:.0f} to x {x1:.0f} y {y1:.0f} of the sensor (pixels)"
            self.profile_plot.setLabel("bottom", words)

    def _stretch_chosen(self) -> None:
        if self.frame is not None and not self.is_coarse:  # at once, and where the frame is held as well
            self._measure(self.frame)
            self.show_frame(self.frame)

    def _levels_by_hand(self, low: float, high: float) -> None:
        self.levels = (low, high)
        with QSignalBlocker(self.stretch):
            self.stretch.setCurrentText("by hand")
        if self.frame is not None and not self.is_coarse:
            self.show_frame(self.frame)

    def _by_keys(self, across: float, down: float, *, alt: bool) -> None:
        """Move region, line or cross-hair, the first of them that is shown."""
        if self.region_box.item is not None:
            self.region_box.step(across, down, size_only=alt)
        elif self.profile_line.item is not None:
            self.profile_line.step(across, down, end_only=alt)
        elif self.cross_hair.enabled:
            self.cross_hair.step(across, down)

    def _arrows_for(self) -> None:
        """Give the arrow keys of the picture to what lies over it."""
        over = self.region_button, self.profile_button, self.cross_button
        self.view.arrows_pan = not any(button.isChecked() for button in over)
        if not self.view.arrows_pan:
            self.view.setFocus()


def _other_light(before: Frame, now: Frame) -> bool:
    """Whether a frame is so much brighter or darker that levels and histogram of the other are not its."""
    dark = now.metadata.black_level
    means = [float(frame.image[::_STRIDE, ::_STRIDE].mean()) - dark for frame in (before, now)]
    return abs(means[1] - means[0]) > 0.5 * max(min(means), 0.0) + _DIM * now.full_scale
