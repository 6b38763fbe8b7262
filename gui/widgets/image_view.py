"""Images on the screen: shown with levels, stretched to their place, and walked over by arrow keys."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import QEvent, QObject, QPointF, QRectF, Qt, Signal
from PySide6.QtGui import QKeyEvent, QResizeEvent, QTransform
from PySide6.QtWidgets import QLabel, QWidget

from gui.theme import colours, grey_indices, indices_of, spares_hues, table
from gui.widgets.building import fill
from instrument.files.orientation import AS_IT_IS, Orientation
from instrument.live.frame_view import SATURATED, index_table, show_indices
from recon.arrays import Array

_MARGIN_PX = 8
_VEILED = 0.35
"""Opacity of an image that is not current."""
_PAN = 0.05
"""An arrow key moves what is shown by this part of it, where arrows mean nothing else."""


def usual_levels(image: Array) -> tuple[float, float]:
    """Return the values that an image is shown with: nearly the least and largest of every fourth pixel."""
    low, high = np.percentile(image[::4, ::4], (0.1, 99.9))
    counts = np.issubdtype(image.dtype, np.integer)  # a PSF's sum may be 1, and all of it below a hundredth
    return float(low), float(max(high, low + 1) if counts or high <= low else high)


def _alike(one: Array, other: Array) -> bool:
    """Return whether two pictures are the same; a row of most that are not tells it."""
    if one.shape != other.shape:
        return False
    middle = len(one) // 2
    return np.array_equal(one[middle], other[middle]) and np.array_equal(one, other)


class _TurnedGraphics(pg.GraphicsView):  # type: ignore[misc]
    """Graphics that are turned and mirrored as a whole: what lies over a picture goes with it."""

    def __init__(self, background: str) -> None:
        self.orientation = AS_IT_IS
        super().__init__(background=background)

    def orient(self, orientation: Orientation) -> None:
        """Turn and mirror what is shown."""
        self.orientation = orientation
        self.resizeEvent(None)

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802 - Qt's name
        """Give the scene the room that there is, its width along the picture's."""
        if self.closed:
            return
        width, height = self.width(), self.height()
        if self.orientation.quarters % 2:
            width, height = height, width
        self.setRange(QRectF(0, 0, width, height), padding=0, disableAutoPixel=False)

    def updateMatrix(self, propagate: bool = True) -> None:  # noqa: N802 - pyqtgraph's name
        """Turn what is shown, beside what pyqtgraph does."""
        super().updateMatrix(propagate)
        a, b, c, d = self.orientation.matrix
        self.setTransform(QTransform(a, c, b, d, 0, 0))


class ImageView(QWidget):
    """Shows ``(height, width)`` or ``(height, width, 3)`` images of any number type.

    Integer images go through one look-up table from counts to 8-bit indices, made when levels change, and are
    shrunk on the way to what the screen can show, so that a frame costs one pass; saturated counts get an
    index (and colour) of their own, which survives the shrinking. The red map, made for a dark room, shows
    coloured images too: by the mean of their channels.

    Signals
    -------
    hovered : str
        Place and value under the mouse in words; empty outside.
    clicked : int, int
        Column and row of the pixel that was clicked.

    Attributes
    ----------
    keys : ArrowKeys
        While the view has the keyboard: ``+``, ``-`` and ``0`` zoom.
    arrows_pan : bool
        Whether arrow keys move what is shown; False where they mean something else.

    Parameters
    ----------
    colour_map : str, optional
        A name of ``colour_maps.NAMES``; None means the theme's.
    name : str
        For screen readers; what is written over and below the image is its description.
    """

    hovered = Signal(str)
    clicked = Signal(int, int)

    def __init__(self, colour_map: str | None = None, *, name: str = "Picture") -> None:
        super().__init__()
        pg.setConfigOptions(imageAxisOrder="row-major")
        self.graphics = _TurnedGraphics(colours().window)
        self.box: Any = pg.ViewBox(lockAspect=True, invertY=True, enableMenu=False)
        self.graphics.setCentralItem(self.box)
        self.item: Any = pg.ImageItem()
        self.box.addItem(self.item)
        self.drag_taker: Callable[[QPointF, QPointF], object] | None = None
        """Called instead of panning while the left button drags: start and present place, in pixels."""
        self._pan = self.box.mouseDragEvent
        self.box.mouseDragEvent = self._dragged
        self.image: Array | None = None
        self.naming = (0, 0, 1)
        """The sensor's column and row of the image's first pixel, and its pixels along one of the image's."""
        self._colour_map = colour_map or colours().colour_map
        self._placed: tuple[Any, ...] = ()
        self._mouse: QPointF | None = None
        """The last place of the mouse in the scene."""
        self._indices: npt.NDArray[np.uint8] = np.empty((0, 0), np.uint8)
        self._before: npt.NDArray[np.uint8] = np.empty((0, 0), np.uint8)
        """What the screen shows while the next is made."""
        self.extent = (1, 1)
        """Width and height of what is shown."""
        self._levels: tuple[float, float, int | None, tuple[int, int] | None] = (0.0, 1.0, None, None)
        """What the image is shown with: low, high, full scale, extent."""
        self._table_key: tuple[Any, ...] = ()
        self._table: npt.NDArray[np.uint8] = np.empty(0, np.uint8)
        fill(self, self.graphics)
        self._caution = QLabel(parent=self.graphics)
        self._caution.setObjectName("caution")
        self._caution.setWordWrap(True)
        self._caution.hide()
        self._caption = QLabel(parent=self.graphics)
        self._caption.setObjectName("caption")
        self._caption.setWordWrap(True)
        self._caption.hide()
        scene = self.graphics.scene()
        scene.sigMouseMoved.connect(self._moved)
        scene.sigMouseClicked.connect(self._mouse_clicked)
        self.setMinimumSize(160, 120)
        self.setFocusProxy(self.graphics)
        self.keys = ArrowKeys(self.graphics, name)
        self.arrows_pan = True
        self.keys.zoomed.connect(self._zoom)
        self.keys.moved.connect(self._pan_by_keys)

    @property
    def colour_map(self) -> str:
        """The colour map's name."""
        return self._colour_map

    def set_colour_map(self, name: str) -> None:
        """Choose another colour map."""
        before, self._colour_map = self._colour_map, name
        if self.image is None:
            return
        if self.image.ndim == 2:
            self.item.setLookupTable(table(name))
        elif spares_hues(before) != spares_hues(name):
            self.show_image(self.image, *self._levels)

    def orient(self, orientation: Orientation) -> None:
        """Turn and mirror what is shown; places under the mouse stay those of the picture."""
        if orientation != self.graphics.orientation:
            self.graphics.orient(orientation)
            self.keys.step_of = orientation.step_of
            self.whole()

    def restyle(self) -> None:
        """Take over the background and the colour map of the theme in use."""
        self.graphics.setBackground(colours().window)
        self.set_colour_map(colours().colour_map)

    def show_image(
        self,
        image: Array,
        low: float,
        high: float,
        full_scale: int | None = None,
        extent: tuple[int, int] | None = None,
    ) -> None:
        """Show an image.

        Parameters
        ----------
        image : ndarray
            ``(height, width)`` or ``(height, width, 3)``. Kept by reference until the next.
        low, high : float
            Values shown darkest and brightest.
        full_scale : int, optional
            Counts from here on are drawn in the colour of saturation.
        extent : (int, int), optional
            Width and height that the image is stretched over; by default its own, in pixels.
        """
        over = extent or (image.shape[1], image.shape[0])
        first = self.image is None or self.extent != over
        self.image, self.extent = image, over
        if first:
            self.whole()
        self._levels = (low, high, full_scale, extent)
        step = self._step(image)
        size = (image.shape[0] // step, image.shape[1] // step)
        mapped = image.ndim == 2 or spares_hues(self._colour_map)
        shape = size if mapped else (*size, *image.shape[2:])
        self._indices, self._before = self._before, self._indices
        if self._indices.shape != shape:
            self._indices = np.empty(shape, np.uint8)
        self._fill(image, low, high, full_scale, step)
        place = extent or (size[1] * step, size[0] * step)
        placed = (*place, *size, mapped and self._colour_map)
        if placed == self._placed and _alike(self._indices, self._before):
            return  # a dark picture after another: nothing to paint
        lut = table(self._colour_map) if mapped else None
        self.item.setImage(self._indices, autoLevels=False, levels=None, lut=lut)
        if placed[:-1] != self._placed[:-1]:
            self.item.setRect(QRectF(0, 0, *place))
        self._placed = placed

    def whole(self) -> None:
        """Show the whole image."""
        if self.image is not None:
            across, down = self.extent
            self.box.setRange(xRange=(0, across), yRange=(0, down), padding=0.01)

    @property
    def caution(self) -> str:
        """What is written over the image."""
        return self._caution.text()

    @property
    def caption(self) -> str:
        """What is written below the image: what it is of."""
        return self._caption.text()

    def set_caption(self, words: str) -> None:
        """Write at the image's lower edge what it is of: time, light, source."""
        if words != self.caption:
            self._caption.setText(words)
            self._caption.setVisible(bool(words))
            self._describe()
        room = max(self.graphics.width() - 2 * _MARGIN_PX, 1)
        self._caption.setFixedWidth(min(room, self._caption.fontMetrics().horizontalAdvance(words) + 24))
        self._caption.adjustSize()
        self._caption.move(_MARGIN_PX, self.graphics.height() - self._caption.height() - _MARGIN_PX)

    def caution_against(self, words: str, *, old: bool = False) -> None:
        """Write over the image why it is not what it seems; nothing where ``words`` are empty.

        ``old``: veil it as well, for it is of another time, or of something else than its surroundings say.
        """
        self.item.setOpacity(_VEILED if old and words else 1.0)
        if words != self.caution:
            self._caution.setText(words)
            self._caution.setVisible(bool(words))
            self._describe()
        margin = _MARGIN_PX
        width = max(self.graphics.width() - 2 * margin, 1)
        self._caution.setFixedWidth(min(width, self._caution.fontMetrics().horizontalAdvance(words) + 40))
        self._caution.adjustSize()
        self._caution.move(margin, margin)

    def _describe(self) -> None:
        self.graphics.setAccessibleDescription(". ".join(filter(None, (self.caution, self.caption))))

    def clear(self) -> None:
        """Show nothing."""
        self.image, self._placed = None, ()
        self.item.clear()
        self.set_caption("")
        self.caution_against("")

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Keep what is written where it stands."""
        super().resizeEvent(event)
        self.set_caption(self.caption)

    def _step(self, image: Array) -> int:
        """Return how many pixels along each axis fall on one of the screen."""
        room = self.graphics.range  # its width along the picture's, however it is turned
        width = max(1.0, room.width() * self.devicePixelRatioF())
        height = max(1.0, room.height() * self.devicePixelRatioF())
        (left, right), (top, bottom) = self.box.viewRange()
        across, down = image.shape[1] / self.extent[0], image.shape[0] / self.extent[1]
        step = int(min((right - left) * across / width, (bottom - top) * down / height))
        return max(1, min(step, int(image.shape[0]), int(image.shape[1])))

    def _fill(self, image: Array, low: float, high: float, full_scale: int | None, step: int) -> None:
        if image.ndim > self._indices.ndim:
            height, width = self._indices.shape
            shown = image[::step, ::step][:height, :width]
            self._indices[...] = grey_indices(shown, low, high)
            if full_scale is not None:
                self._indices[(shown >= full_scale).any(axis=2)] = SATURATED
            return
        if image.dtype in (np.uint8, np.uint16):
            key = (image.dtype, low, high, full_scale)
            if key != self._table_key:
                self._table, self._table_key = index_table(image.dtype, low, high, full_scale), key
            if image.ndim == 2:
                image = image.view()
                image.flags.writeable = False  # as a frame is: for another kind it would be compiled here
                show_indices(image, self._table, step, self._indices)
                return
            height, width = self._indices.shape[:2]
            np.take(self._table, image[::step, ::step][:height, :width], out=self._indices, mode="clip")
            if full_scale is not None:
                self._indices[(self._indices == SATURATED).any(axis=2)] = table("grey")[SATURATED]
            return
        height, width = self._indices.shape[:2]
        self._indices[...] = indices_of(image[::step, ::step][:height, :width], low, high)

    # Keys ----------------------------------------------------------------------------------------
    def _zoom(self, factor: float) -> None:
        if factor == 0:
            self.whole()
        else:
            self.box.scaleBy((1 / factor, 1 / factor))

    def _pan_by_keys(self, across: float, down: float) -> None:
        if self.arrows_pan:
            (left, right), (top, bottom) = self.box.viewRange()
            self.box.translateBy((_PAN * across * (right - left), _PAN * down * (bottom - top)))

    # The mouse -----------------------------------------------------------------------------------
    def pixel_at(self, place: QPointF) -> tuple[int, int] | None:
        """Return column and row of the pixel at a place of the scene; None outside the image."""
        if self.image is None:
            return None
        point = self.box.mapSceneToView(place)
        column, row = int(np.floor(point.x())), int(np.floor(point.y()))
        across, down = self.extent
        return (column, row) if 0 <= column < across and 0 <= row < down else None

    def named(self, x: float, y: float) -> tuple[float, float]:
        """Return what a place of the image is called: the sensor's pixel, for frames of a part of it."""
        left, top, binning = self.naming
        return left + x * binning, top + y * binning

    def describe(self, column: int, row: int) -> str:
        """Return a pixel's place and value in words."""
        value = self.value_at(column, row)
        words = " ".join(f"{v:.5g}" for v in np.atleast_1d(value))
        x, y = self.named(column, row)
        return f"x {x:.0f}  y {y:.0f}  value {words}"

    def value_at(self, column: int, row: int) -> Any:
        """Return the value that is shown at a place of the extent."""
        assert self.image is not None
        height, width = self.image.shape[:2]
        return self.image[row * height // self.extent[1], column * width // self.extent[0]]

    def under_mouse(self) -> str:
        """Return place and value under the mouse in words, as they are now; empty outside."""
        if self._mouse is None or not self.graphics.underMouse():
            return ""
        pixel = self.pixel_at(self._mouse)
        return "" if pixel is None else self.describe(*pixel)

    def _moved(self, place: QPointF) -> None:
        self._mouse = place
        pixel = self.pixel_at(place)
        self.hovered.emit("" if pixel is None else self.describe(*pixel))

    def _dragged(self, event: Any, axis: int | None = None) -> None:
        if self.drag_taker is None or event.button() != Qt.MouseButton.LeftButton:
            self._pan(event, axis=axis)
            return
        event.accept()
        start, now = event.buttonDownScenePos(), event.scenePos()
        self.drag_taker(self.box.mapSceneToView(start), self.box.mapSceneToView(now))

    def _mouse_clicked(self, event: Any) -> None:
        pixel = self.pixel_at(event.scenePos())
        if pixel is not None:
            self.clicked.emit(*pixel)


class StretchedImage(ImageView):
    """Shows images over another extent, in voxels: places under the mouse are voxels.

    Parameters
    ----------
    keep_aspect : bool
        Whether voxels are square on the screen; without, the image fills its place.
    """

    def __init__(self, *, keep_aspect: bool = True, name: str = "Picture") -> None:
        super().__init__(name=name)
        self.box.setAspectLocked(keep_aspect)

    def describe(self, column: int, row: int) -> str:
        """Return a voxel's place and value in words."""
        value = self.value_at(column, row)
        return f"{column}, {row}: {' '.join(f'{v:.5g}' for v in np.atleast_1d(value))}"


ARROWS: dict[int, tuple[int, int]] = {
    Qt.Key.Key_Left: (-1, 0),
    Qt.Key.Key_Right: (1, 0),
    Qt.Key.Key_Up: (0, -1),
    Qt.Key.Key_Down: (0, 1),
}
"""Columns and rows: down the screen is positive, as in an image."""
_ZOOM: dict[int, float] = {
    Qt.Key.Key_Plus: 1.25,
    Qt.Key.Key_Equal: 1.25,
    Qt.Key.Key_Minus: 0.8,
    Qt.Key.Key_0: 0.0,
}


def step_factor(event: QKeyEvent) -> float:
    """Return what a key's step is multiplied with: Shift makes it ten times as large, Ctrl a tenth."""
    if event.modifiers() & Qt.KeyboardModifier.ShiftModifier:
        return 10.0
    return 0.1 if event.modifiers() & Qt.KeyboardModifier.ControlModifier else 1.0


def whole_steps(steps: float) -> int:
    """Return whole pixels or voxels for a step by keys: at least one."""
    return int(math.copysign(max(1, round(abs(steps))), steps)) if steps else 0


class ArrowKeys(QObject):
    """Keys of a widget that shows a picture or plot; the widget takes the keyboard by Tab or a click.

    The steps are those of the stage: Shift makes them ten times as large, Ctrl a tenth.

    Parameters
    ----------
    widget : QWidget
        Where the keyboard is when the keys are pressed.
    name : str
        Of the widget, for screen readers.

    Signals
    -------
    moved : float, float
        Steps to the right and down of the picture, however it is turned.
    resized : float, float
        The same with Alt.
    acted : bool
        Space or Return (True); Backspace or Delete (False).
    zoomed : float
        Factor of ``+`` and ``-``; 0 for the key ``0``: show the whole.
    entered
        The widget has the keyboard now.
    left
        It has not any more.
    """

    moved = Signal(float, float)
    resized = Signal(float, float)
    acted = Signal(bool)
    zoomed = Signal(float)
    entered = Signal()
    left = Signal()

    def __init__(self, widget: QWidget, name: str) -> None:
        super().__init__(widget)
        widget.setAccessibleName(name)
        self.step_of: Callable[[float, float], tuple[float, float]] = lambda across, down: (across, down)
        """What a step to the right and down on the screen is in the picture."""
        widget.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        widget.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Take the keys that mean something here."""
        if event.type() is QEvent.Type.FocusIn:
            self.entered.emit()
        elif event.type() is QEvent.Type.FocusOut:
            self.left.emit()
        if event.type() is not QEvent.Type.KeyPress or not isinstance(event, QKeyEvent):
            return False
        key, held = event.key(), event.modifiers()
        if key in ARROWS:
            scale = step_factor(event)
            across, down = ARROWS[key]
            signal = self.resized if held & Qt.KeyboardModifier.AltModifier else self.moved
            signal.emit(*self.step_of(across * scale, down * scale))
            return True
        if held & (Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.AltModifier):
            return False  # shortcuts
        if key in _ZOOM:
            self.zoomed.emit(_ZOOM[key])
            return True
        if key in (Qt.Key.Key_Space, Qt.Key.Key_Return, Qt.Key.Key_Enter):
            self.acted.emit(True)
            return True
        if key in (Qt.Key.Key_Backspace, Qt.Key.Key_Delete):
            self.acted.emit(False)
            return True
        return False
