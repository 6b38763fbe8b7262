"""A picture of a file on the screen: a page, a chart, a map; larger in a window of its own."""

from __future__ import annotations

from PySide6.QtCore import QRectF, Qt
from PySide6.QtGui import (
    QColor,
    QFocusEvent,
    QImage,
    QKeyEvent,
    QMouseEvent,
    QPainter,
    QPaintEvent,
    QPen,
    QPixmap,
)
from PySide6.QtWidgets import QDialog, QDialogButtonBox, QSizePolicy, QWidget

from gui.theme import LARGE_PT, colours, dress, spares_hues
from gui.widgets.building import fill

NO_PICTURE = "No picture yet."
_OF_THE_SCREEN = 0.9
_PAPER_IN_RED = QColor(150, 0, 0)
"""Darker than STOP."""


class Picture(QWidget):
    """Shows a pixmap, scaled down or up to the space there is; a click, or Enter, shows it larger.

    Parameters
    ----------
    larger : bool
        Whether there is a larger one to be had.
    """

    def __init__(self, parent: QWidget | None = None, *, larger: bool = True) -> None:
        super().__init__(parent)
        self._has_larger = larger
        self.setAccessibleName("Picture")
        self.pixmap = QPixmap()
        self._grey: QPixmap | None = None
        self._empty = NO_PICTURE
        self.setMinimumSize(160, 120)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)

    @property
    def lacks_px(self) -> int:
        """How much wider this would be for the picture in its own size; 0 where its height is in the way."""
        if self.pixmap.isNull():
            return 0
        shown = self.pixmap.size().scaled(
            self.pixmap.width(), self.height(), Qt.AspectRatioMode.KeepAspectRatio
        )
        return max(0, shown.width() - self.width())

    def show_pixmap(self, pixmap: QPixmap) -> None:
        """Show a picture; an empty one shows nothing."""
        self.pixmap, self._grey = pixmap, None
        opens = self._has_larger and not pixmap.isNull()
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus if opens else Qt.FocusPolicy.NoFocus)
        self.setToolTip("Click, or press Enter: larger, in a window of its own" if opens else "")
        self.setCursor(Qt.CursorShape.PointingHandCursor if opens else Qt.CursorShape.ArrowCursor)
        self.update()

    def show_larger(self) -> LargePicture | None:
        """Show the picture as large as the screen allows, in one window beside this; None: there is none."""
        if not self._has_larger or self.pixmap.isNull():
            return None
        there = (window for window in self.findChildren(LargePicture) if window.isVisible())
        window = next(there, None) or LargePicture(self)
        window.show_pixmap(self.pixmap)
        window.show()
        window.raise_()
        window.activateWindow()
        return window

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:  # noqa: N802 - Qt's name
        """Show the picture larger."""
        if event.button() == Qt.MouseButton.LeftButton and self.rect().contains(event.position().toPoint()):
            self.show_larger()

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802 - Qt's name
        """Show the picture larger."""
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter, Qt.Key.Key_Space):
            self.show_larger()
        else:
            super().keyPressEvent(event)

    def focusInEvent(self, event: QFocusEvent) -> None:  # noqa: N802 - Qt's name
        """Show the frame of what has the keyboard."""
        super().focusInEvent(event)
        self.update()

    def focusOutEvent(self, event: QFocusEvent) -> None:  # noqa: N802 - Qt's name
        """Take the frame away."""
        super().focusOutEvent(event)
        self.update()

    def _in_grey(self) -> QPixmap:
        """Return the picture without its hues, made once."""
        if self._grey is None:
            grey = self.pixmap.toImage().convertToFormat(QImage.Format.Format_Grayscale8)
            self._grey = QPixmap.fromImage(grey)
        return self._grey

    def clear(self, why: str = NO_PICTURE) -> None:
        """Show nothing but words."""
        self._empty = why
        self.show_pixmap(QPixmap())

    def paintEvent(self, _event: QPaintEvent) -> None:  # noqa: N802 - Qt's name
        """Draw the picture, or say that there is none."""
        if self.pixmap.isNull():
            painter = QPainter(self)
            painter.setPen(QColor(colours().dim))
            font = self.font()
            font.setPointSize(LARGE_PT)
            painter.setFont(font)
            painter.drawText(self.rect(), Qt.AlignmentFlag.AlignCenter, self._empty)
            painter.end()
            return
        size = self.pixmap.size().scaled(self.size(), Qt.AspectRatioMode.KeepAspectRatio)
        left, top = (self.width() - size.width()) / 2, (self.height() - size.height()) / 2
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.SmoothPixmapTransform)
        red = spares_hues(colours().colour_map)  # a page is white
        place, shown = QRectF(left, top, size.width(), size.height()), self._in_grey() if red else self.pixmap
        painter.drawPixmap(place, shown, QRectF(shown.rect()))
        if red:
            painter.setCompositionMode(QPainter.CompositionMode.CompositionMode_Multiply)
            painter.fillRect(place, _PAPER_IN_RED)
        if self.hasFocus():
            painter.setCompositionMode(QPainter.CompositionMode.CompositionMode_SourceOver)
            painter.setPen(QPen(QColor(colours().accent), 2))
            painter.drawRect(self.rect().adjusted(1, 1, -1, -1))
        painter.end()


class LargePicture(QDialog):
    """A picture in a window of its own, as large as the screen has room for; gone when it is closed.

    To be shown by ``show``: ``open`` and ``exec`` would keep clicks from STOP.
    """

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        dress(self)
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.setWindowTitle("Picture")
        self.picture = Picture(larger=False)
        self._close = close = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        close.button(QDialogButtonBox.StandardButton.Close).setToolTip(
            "Close this window (Esc, which stops, too)"
        )
        close.rejected.connect(self.reject)
        fill(self, (self.picture, 1), close, margins=(8, 8, 8, 8))

    def show_pixmap(self, pixmap: QPixmap) -> None:
        """Show a picture; the window takes its shape."""
        self.picture.show_pixmap(pixmap)
        room = self.screen().availableSize() * _OF_THE_SCREEN
        shown = pixmap.size().scaled(room, Qt.AspectRatioMode.KeepAspectRatio)
        below = self._close.sizeHint().height() + 24
        self.resize(shown.width() + 16, min(room.height(), shown.height() + below))
